"""Values of a chart's patches in the files of spectrophotometers and makers: CGATS text (ANSI CGATS.17) or CSV.

Each line has one patch: its name, and a spectrum (columns `SPECTRAL_NM400`, `SPECTRAL_400`, `nm400` or `400`), or
L*a*b* (`LAB_L LAB_A LAB_B`, `L a b`) or XYZ (`XYZ_X ...`, `X Y Z`; white has Y = 100). L*a*b* and XYZ are under
D50 for the 1931 observer. If a file has several forms, spectra are preferred.
"""

from __future__ import annotations

import csv
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from coupole.calibration.colour.colorimetry import xyz_of, xyz_of_spectra
from coupole.calibration.rotations import Floats
from coupole.errors import InputError, Problem, reason

Unit = Literal["auto", "percent", "fraction"]
_BAND = re.compile(r"(?:SPECTRAL_?(?:NM_?)?|NM_?|R_?)?(\d{3}(?:\.\d+)?)(?:_?NM)?", re.IGNORECASE)
_NAMES = ("SAMPLE_NAME", "SAMPLENAME", "SAMPLE_ID", "SAMPLEID", "NAME", "PATCH", "ID", "SAMPLE")
_LAB = (("LAB_L", "LAB_A", "LAB_B"), ("L", "A", "B"), ("L*", "A*", "B*"))
_XYZ = (("XYZ_X", "XYZ_Y", "XYZ_Z"), ("X", "Y", "Z"))
_LEAST_BANDS = 10
_FRACTION_AT_MOST, _PERCENT_AT_LEAST = 1.3, 2.5
_POSSIBLE = (-0.02, 1.5)


@dataclass(frozen=True)
class ChartValues:
    """Colours of patches by name."""

    xyz: Mapping[str, Floats]
    """[3] under D50, Y = 1 for the perfect white."""


def read_chart_values(path: Path, unit: Unit = "auto") -> ChartValues:
    """Return the values in a file. Raises InputError for a missing file, no table, a name that occurs twice, and a
    value that is not a number."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot read the values of the chart: {reason(error)}") from error
    fields, rows = _cgats(path, text) if "BEGIN_DATA_FORMAT" in text else _csv(path, text)
    upper = [field.strip().strip('"').upper() for field in fields]
    name_at = next((upper.index(column) for column in _NAMES if column in upper), None)
    if name_at is None:
        raise InputError(
            f"{path}: expected a column of names ({', '.join(_NAMES)}), found {', '.join(fields[:8])}"
        )
    names = [row[name_at].strip() for _, row in rows]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{path}: the patch {twice} is given twice; keep one line, or the mean of several")
    bands = [(float(match[1]), at) for at, field in enumerate(upper) if (match := _BAND.fullmatch(field))]
    if len(bands) >= _LEAST_BANDS:
        bands.sort()
        table = _numbers(path, rows, [at for _, at in bands])
        xyz = xyz_of_spectra(np.array([nm for nm, _ in bands]), reflectance_fractions(path, table, unit))
        return ChartValues(dict(zip(names, xyz, strict=True)))
    for columns, turn in ((_LAB, xyz_of), (_XYZ, lambda values: values / 100.0)):
        for column_names in columns:
            if all(column in upper for column in column_names):
                values = turn(_numbers(path, rows, [upper.index(column) for column in column_names]))
                return ChartValues(dict(zip(names, values, strict=True)))
    raise InputError(
        f"{path}: expected spectra ({_LEAST_BANDS} columns such as SPECTRAL_NM400 or more), LAB_L LAB_A LAB_B or "
        f"XYZ_X XYZ_Y XYZ_Z; found {', '.join(fields[:8])}"
    )


Rows = list[tuple[int, list[str]]]
"""Lines with their numbers."""


def _cgats(path: Path, text: str) -> tuple[list[str], Rows]:
    """Return the names of the fields, and the lines of data."""
    fields: list[str] = []
    rows: Rows = []
    part = ""
    tables = 0
    for number, line in enumerate(text.splitlines(), start=1):
        word = line.strip()
        if word in {"BEGIN_DATA_FORMAT", "BEGIN_DATA"}:
            part = word
            tables += word == "BEGIN_DATA"
        elif word in {"END_DATA_FORMAT", "END_DATA"}:
            part = ""
        elif word and not word.startswith("#") and part == "BEGIN_DATA_FORMAT":
            fields += word.split()
        elif word and not word.startswith("#") and part == "BEGIN_DATA":
            rows.append((number, _words(path, number, line)))
    if tables != 1 or not rows or not fields:
        raise InputError(f"{path}: expected one table between BEGIN_DATA and END_DATA, found {tables}")
    return fields, _of_width(path, rows, len(fields))


def _words(path: Path, number: int, line: str) -> list[str]:
    """Return the fields of a line of data, which are separated by tabs or blanks. Names may be in quotes."""
    if "\t" in line.strip():
        return [field.strip().strip('"') for field in line.strip().split("\t")]
    try:
        return shlex.split(line)
    except ValueError as error:
        raise _wrong(path, number, f"expected a second quotation mark after the first: {error}") from error


def _csv(path: Path, text: str) -> tuple[list[str], Rows]:
    lines = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if line.strip() and line[0] != "#"]
    if not lines:
        raise InputError(f"{path}: expected a table of the chart's values (CGATS or CSV), found none")
    mark = max("\t;,", key=lines[0][1].count)
    rows = [(number, next(csv.reader([line], delimiter=mark))) for number, line in lines]
    fields = rows[0][1]
    return fields, _of_width(path, rows[1:], len(fields))


def _of_width(path: Path, rows: Rows, width: int) -> Rows:
    for number, row in rows:
        if len(row) != width:
            raise _wrong(path, number, f"expected {width} fields as the heads say, found {len(row)}")
    return rows


def _numbers(path: Path, rows: Rows, columns: Sequence[int]) -> Floats:
    """Return [rows, columns] numbers."""
    table = np.empty((len(rows), len(columns)))
    for n, (number, row) in enumerate(rows):
        for m, column in enumerate(columns):
            try:
                table[n, m] = float(row[column].replace(",", "."))
            except ValueError as error:
                raise _wrong(path, number, f"expected a number, found {row[column]!r}") from error
    if not np.isfinite(table).all():
        raise InputError(f"{path}: expected finite numbers")
    return table


def reflectance_fractions(path: Path, table: Floats, unit: Unit) -> Floats:
    """Return the table as fractions. Raises InputError if the unit cannot be determined, or for values that no
    reflectance has."""
    peak = float(table.max())
    if unit == "auto" and _FRACTION_AT_MOST < peak < _PERCENT_AT_LEAST:
        raise InputError(
            f"{path}: the largest value, {peak:g}, may be percent or a fraction; say which with `unit` in the "
            "description"
        )
    scale = 0.01 if unit == "percent" or (unit == "auto" and peak >= _PERCENT_AT_LEAST) else 1.0
    values = table * scale
    if values.min() < _POSSIBLE[0] or values.max() > _POSSIBLE[1]:
        raise InputError(
            f"{path}: expected reflectances of {_POSSIBLE[0]:g} to {_POSSIBLE[1]:g}, found {values.min():g} to "
            f"{values.max():g}; correct `unit` in the description"
        )
    return values


def _wrong(path: Path, line: int, message: str) -> InputError:
    return InputError([Problem(str(path), line, 1, "", message)])
