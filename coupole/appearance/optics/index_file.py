"""Complex indices from a user's file: YAML as on refractiveindex.info, or columns of wavelength, n and k.

YAML: `DATA`, a list of parts of type `tabulated nk`, `tabulated n`, `tabulated k`, `formula 1` or `2` (Sellmeier)
and `formula 5` (Cauchy), wavelengths in micrometres. Columns: wavelength, n and, unless it is transparent, k;
separated by blanks, tabs, semicolons or commas; lines that do not begin with a number are comments. Wavelengths
are micrometres if all are below 30, else nm.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from coupole.appearance.optics import indices
from coupole.appearance.spectra.grid import FIRST_NM, LAST_NM, WAVELENGTHS_NM, Array, Complex
from coupole.errors import InputError, Problem, reason
from coupole.intake.plain_data import yaml_of

_YAML = {".yml", ".yaml"}
_MICROMETRES_BELOW = 30.0
_HIGHEST = 20.0
_WIDEST_GAP_NM = 80.0
"""Widest allowed gap in tables: Johnson and Christy's lines are up to 65 nm apart."""
_SELLMEIER, _SELLMEIER_2, _CAUCHY = "formula 1", "formula 2", "formula 5"


def read_index(path: Path) -> Complex:
    """n + i k [81]; k is 0 where the file has none. Between the lines of the file, values are linear in the
    wavelength.

    Raises InputError with the file and, if possible, the line; also if the file does not cover 380 to 780 nm.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {reason(error)}") from error
    index = _of_yaml(text, path) if path.suffix.lower() in _YAML else _of_columns(text, path, 1)
    if not np.all((index.real > 0.0) & (index.real < _HIGHEST) & (index.imag >= 0.0) & (index.imag < _HIGHEST)):
        raise InputError(
            f"{path}: expected n and k below {_HIGHEST:g}; found n "
            f"{index.real.min():g} to {index.real.max():g}, "
            f"k {index.imag.min():g} to {index.imag.max():g}; check the order of the columns"
        )
    return index


def _of_yaml(text: str, path: Path) -> Complex:
    document: Any = yaml_of(text, str(path))
    parts = document.get("DATA") if isinstance(document, dict) else None
    if not isinstance(parts, list) or not all(isinstance(part, dict) for part in parts):
        raise InputError(f"{path}: expected a list `DATA` as in the files of refractiveindex.info; found none")
    n: Array | None = None
    k: Array | None = None
    for part in parts:
        kind = str(part.get("type"))
        if kind == "tabulated nk":
            index = _of_columns(str(part.get("data", "")), path, _line_of(text, "data:"))
            n, k = index.real, index.imag
        elif kind == "tabulated n":
            n = _of_columns(str(part.get("data", "")), path, _line_of(text, "data:")).real
        elif kind == "tabulated k":
            k = _of_columns(str(part.get("data", "")), path, _line_of(text, "data:")).real
        elif kind in (_SELLMEIER, _SELLMEIER_2, _CAUCHY):
            n = _of_formula(kind, part, path)
        else:
            raise InputError(
                f"{path}: expected tabulated nk, n or k, or {_SELLMEIER}, {_SELLMEIER_2} or {_CAUCHY}; "
                f"found {kind!r}; give a table"
            )
    if n is None:
        raise InputError(f"{path}: expected an index n; found k only")
    return np.asarray(n + 1j * (np.zeros_like(n) if k is None else k))


def _of_formula(kind: str, part: dict[str, Any], path: Path) -> Array:
    try:
        numbers = [float(word) for word in str(part["coefficients"]).split()]
        limits_nm = [1e3 * float(word) for word in str(part["wavelength_range"]).split()]
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: {kind}: expected `coefficients` and `wavelength_range`: {error}") from error
    if not numbers or len(numbers) % 2 == 0 or len(limits_nm) != 2:
        raise InputError(f"{path}: {kind}: expected an odd number of coefficients and two limits of wavelength")
    # Formulas are smooth: those of glasses and polymers begin at the mercury line at 404.7 or 435.8 nm.
    if limits_nm[0] > FIRST_NM + _WIDEST_GAP_NM or limits_nm[1] < LAST_NM - _WIDEST_GAP_NM:
        raise _not_covered(path, limits_nm[0], limits_nm[1])
    first, pairs = numbers[0], list(zip(numbers[1::2], numbers[2::2], strict=True))
    if kind == _CAUCHY:
        um = WAVELENGTHS_NM * 1e-3
        return np.asarray(first + sum(c * um**power for c, power in pairs))
    terms = [(b, c**2 if kind == _SELLMEIER else c) for b, c in pairs]
    return indices.sellmeier(terms, first).real


def _of_columns(text: str, path: Path, first_line: int) -> Complex:
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=first_line):
        fields = [field for field in re.split(r"[\s;,]+", line.strip()) if field]
        if not fields or not re.match(r"[+\-.\d]", fields[0]):
            continue
        try:
            rows.append([float(field) for field in fields])
        except ValueError as error:
            raise _wrong(path, number, f"expected wavelength, n and k with decimal points: {error}") from error
        if len(rows[-1]) not in (2, 3) or len(rows[-1]) != len(rows[0]):
            count = len(rows[0]) if len(rows[0]) in (2, 3) else 3
            raise _wrong(path, number, f"expected {count} numbers, found {len(rows[-1])}")
        if min(rows[-1]) < 0.0 or rows[-1][0] == 0.0:
            raise _wrong(
                path, number, f"expected a wavelength above 0, and n and k of at least 0; found {min(rows[-1]):g}"
            )
        if len(rows) > 1 and rows[-1][0] <= rows[-2][0]:
            raise _wrong(path, number, f"expected rising wavelengths, found {rows[-1][0]:g} after {rows[-2][0]:g}")
    if len(rows) < 2:
        raise InputError(f"{path}: expected lines of wavelength, n and k; found {len(rows)}")
    table = np.array(rows)
    nm = table[:, 0] * (1e3 if table[-1, 0] < _MICROMETRES_BELOW else 1.0)
    if nm[0] > FIRST_NM + 1e-6 or nm[-1] < LAST_NM - 1e-6:
        raise _not_covered(path, nm[0], nm[-1])
    gaps = np.diff(nm) * ((nm[1:] > FIRST_NM) & (nm[:-1] < LAST_NM))
    if gaps.max() > _WIDEST_GAP_NM:
        at = int(np.argmax(gaps))
        raise InputError(f"{path}: has no value between {nm[at]:g} and {nm[at + 1]:g} nm; give a finer table")
    columns = [np.interp(WAVELENGTHS_NM, nm, column) for column in table[:, 1:].T]
    return np.asarray(columns[0] + 1j * (columns[1] if len(columns) > 1 else 0.0))


def _line_of(text: str, key: str) -> int:
    """Return the line after the first line that has a key."""
    lines = text.splitlines()
    return next((number for number, line in enumerate(lines, start=2) if line.strip().startswith(key)), 1)


def _not_covered(path: Path, first_nm: float, last_nm: float) -> InputError:
    return InputError(
        f"{path}: expected an index from {FIRST_NM:g} to {LAST_NM:g} nm, found {first_nm:g} to {last_nm:g} nm; "
        "nothing is extrapolated: give one of visible light"
    )


def _wrong(path: Path, line: int, message: str) -> InputError:
    return InputError([Problem(str(path), line, 1, "", message)])
