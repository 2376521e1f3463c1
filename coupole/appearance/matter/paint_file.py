"""Paints by their K and S in a plain file. `coupole layer` writes it, and recipes and scene files read it.

The head is YAML in lines that begin with `#`. Below it are comma-separated columns, with a line of their names::

    # coupole: paint 1
    # name: azurite, coarse
    # unit: per mm
    # binder_index: 1.5
    wavelength_nm,K,S,u_K,u_S
    400,3.127,21.04,0.11,0.52

`unit` is `per mm`, `per layer` (the thickness was not known) or `relative` (to the scattering of a white). `u_K`
and `u_S` are standard uncertainties. These two columns, and all other columns, may be left out.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter.pigments import Pigment
from coupole.appearance.spectra.grid import STEP_NM, WAVELENGTHS_NM, Array
from coupole.errors import InputError, Problem, reason
from coupole.intake.plain_data import yaml_of

FIRST_LINE = "# coupole: paint 1"
ENDING = ".paint.csv"
Unit = Literal["per mm", "per layer", "relative"]
_COLUMNS = ("wavelength_nm", "K", "S")
_NM = (150.0, 3000.0)
_WIDEST_GAP_NM = 20.0


@dataclass(frozen=True, eq=False)
class PaintFile:
    """K and S of one paint with standard uncertainties; [n] at its own wavelengths."""

    name: str
    unit: Unit
    binder_index: float
    wavelengths_nm: Array
    """[n] wavelengths in rising order."""
    absorption: Array
    scattering: Array
    u_absorption: Array
    """Standard uncertainty of K; 0 if it is not known."""
    u_scattering: Array
    head_lines: Mapping[str, Any] = field(default_factory=dict)
    """Other lines of the head, about the measurement."""
    other: Mapping[str, Array] = field(default_factory=dict)
    """Further columns [n], such as the columns of four fluxes."""

    def on_grid(self) -> Pigment:
        """Return the paint as a pigment on 380 to 780 nm, linear between its wavelengths and constant beyond its
        ends."""
        return Pigment(
            self.name,
            *(np.interp(WAVELENGTHS_NM, self.wavelengths_nm, v) for v in (self.absorption, self.scattering)),
        )

    def covered_bands(self) -> NDArray[np.bool_]:
        """[81] True for bands that were measured."""
        nm = self.wavelengths_nm
        return np.asarray((nm[0] - STEP_NM / 2 <= WAVELENGTHS_NM) & (nm[-1] + STEP_NM / 2 >= WAVELENGTHS_NM))

    def uncertainties_on_grid(self) -> tuple[Array, Array]:
        """Standard uncertainties [81] of K and S."""
        u_on_grid = [
            np.interp(WAVELENGTHS_NM, self.wavelengths_nm, u) for u in (self.u_absorption, self.u_scattering)
        ]
        return u_on_grid[0], u_on_grid[1]


def encode(paint: PaintFile) -> str:
    """The file's text."""
    head = {"name": paint.name, "unit": paint.unit, "binder_index": paint.binder_index, **paint.head_lines}
    lines = [FIRST_LINE, *(f"# {line}" for line in _yaml(head).splitlines())]
    names = (*_COLUMNS, "u_K", "u_S", *paint.other)
    columns = (
        paint.wavelengths_nm,
        paint.absorption,
        paint.scattering,
        paint.u_absorption,
        paint.u_scattering,
        *paint.other.values(),
    )
    rows = [",".join(f"{value:.6g}" for value in row) for row in zip(*columns, strict=True)]
    return "\n".join([*lines, ",".join(names), *rows]) + "\n"


def read_paint(path: Path) -> PaintFile:
    """Read the paint in a file. Raises InputError with file and line."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {reason(error)}") from error
    if not text.startswith(FIRST_LINE):
        raise _wrong(
            path, 1, f"expected `{FIRST_LINE}`, found {text[:40].splitlines()[:1]}; `coupole layer` writes it"
        )
    head, first, lines = _head(text, path)
    names = [name.strip() for name in lines[0].split(",")]
    if tuple(names[:3]) != _COLUMNS:
        raise _wrong(path, first, f"expected columns {', '.join(_COLUMNS)}, found {lines[0]!r}")
    table = _table(lines[1:], len(names), path, first + 1)
    columns = dict(zip(names, table.T, strict=True))
    nothing = np.zeros(len(table))
    _check(columns, path, first + 1)
    unit, index = head.pop("unit", None), head.pop("binder_index", None)
    if unit not in get_args(Unit):
        raise _wrong(path, 2, f"unit: expected {', '.join(get_args(Unit))}; found {unit!r}")
    if not isinstance(index, int | float) or not 1.0 <= index <= 3.0:
        raise _wrong(path, 2, f"binder_index: expected 1 to 3, found {index!r}; 1 stands for no glossy face")
    return PaintFile(
        str(head.pop("name", path.name.removesuffix(ENDING))),
        unit,
        float(index),
        columns.pop("wavelength_nm"),
        columns.pop("K"),
        columns.pop("S"),
        columns.pop("u_K", nothing),
        columns.pop("u_S", nothing),
        head,
        columns,
    )


def _head(text: str, path: Path) -> tuple[dict[str, Any], int, list[str]]:
    """Return the head, the number of the line of names, and all lines from this line on."""
    lines = text.splitlines()
    end = next((at for at, line in enumerate(lines) if line.strip() and not line.startswith("#")), len(lines))
    head_text = "\n".join(line[1:].strip(" ") for line in lines[1:end])
    try:
        head: Any = yaml_of(head_text, str(path), line=2)
    except InputError as error:
        first = error.problems[0]
        raise _wrong(path, 2, f"expected YAML in the lines that begin with #: {first.message}") from error
    if not isinstance(head, dict):
        raise _wrong(path, 2, "expected `name`, `unit` and `binder_index` in lines that begin with #")
    if end == len(lines):
        raise _wrong(path, end, f"expected columns {', '.join(_COLUMNS)}; the file ends here")
    return dict(head), end + 1, lines[end:]


def _table(lines: list[str], columns: int, path: Path, first: int) -> Array:
    rows = []
    for number, line in enumerate(lines, start=first):
        if not line.strip():
            continue
        fields = line.split(",")
        if len(fields) != columns:
            raise _wrong(path, number, f"expected {columns} numbers, found {len(fields)}")
        try:
            rows.append([float(value) for value in fields])
        except ValueError as error:
            raise _wrong(path, number, f"expected numbers: {error}") from error
        if not np.isfinite(rows[-1]).all():
            raise _wrong(path, number, "expected numbers, found a field that is not a number; leave the band out")
    if len(rows) < 3:
        raise _wrong(path, first, f"expected 3 or more bands, found {len(rows)}")
    return np.array(rows)


def _check(columns: Mapping[str, Array], path: Path, first: int) -> None:
    nm = columns["wavelength_nm"]
    for at, value in enumerate(nm):
        if not _NM[0] <= value <= _NM[1]:
            raise _wrong(
                path, first + at, f"expected a wavelength in nm, {_NM[0]:g} to {_NM[1]:g}, found {value:g}"
            )
        if at and not 0.0 < value - nm[at - 1] <= _WIDEST_GAP_NM:
            raise _wrong(
                path,
                first + at,
                f"expected rising wavelengths without gaps above {_WIDEST_GAP_NM:g} nm, found {value:g} after "
                f"{nm[at - 1]:g}",
            )
    for name in ("K", "S", "u_K", "u_S"):
        low = columns.get(name, np.zeros(1))
        if (wrong := np.flatnonzero(low < 0.0)).size or (name == "S" and not low.all()):
            at = int(wrong[0]) if wrong.size else int(np.flatnonzero(low == 0.0)[0])
            raise _wrong(
                path, first + at, f"{name}: expected {'more than ' if name == 'S' else ''}0, found {low[at]:g}"
            )


def _yaml(head: Mapping[str, Any]) -> str:
    from ruamel.yaml import YAML

    stream = io.StringIO()
    yaml = YAML()
    yaml.width = 1000
    yaml.dump(dict(head), stream)
    return stream.getvalue()


def _wrong(path: Path, line: int, message: str) -> InputError:
    return InputError([Problem(str(path), line, 1, "", message)])
