"""Points along a line: a table whose first columns are positions and whose other columns are wavelengths.

The first line names the columns: perhaps `name`, then `position_mm` or `x_mm`, `y_mm`, `z_mm` (or `_cm`, `_m`),
then the wavelengths in nm.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.measured import Unit, decode_text
from coupole.appearance.spectra.spectra_library import LibrarySpectrum, parse_library, with_unique_names
from coupole.errors import InputError, Problem, reason

_POSITION = re.compile(r"(position|x|y|z)_(mm|cm|m)")
_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_SEPARATORS = "\t;,"
_NAME = "name"
_HEAD_BYTES = 65536


@dataclass(frozen=True, eq=False)
class LinePoints:
    """Spectra along a line."""

    spectra: tuple[LibrarySpectrum, ...]
    distances_mm: Array
    """[n] along the line, from its first point; rising."""
    positions_mm: Array
    """[n, axes] positions as in the table."""
    axes: tuple[str, ...]


def is_line(path: Path) -> bool:
    """Tell whether a file is a table of points with positions."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        lines = [line for line in decode_text(file.read(_HEAD_BYTES)).splitlines() if _has_words(line)]
    return bool(lines) and any(_POSITION.fullmatch(field) for field in _fields(lines[0]))


def read_line(path: Path, *, unit: Unit = "auto") -> LinePoints:
    """Read a table of points. Points keep their order if they have coordinates; with `position` they are sorted.

    Raises InputError, with file and line.
    """
    try:
        text = decode_text(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: {reason(error)}") from error
    lines = text.replace("\r", "").split("\n")
    head = next(number for number, line in enumerate(lines) if _has_words(line))
    separator = max(_SEPARATORS, key=lines[head].count)
    columns = [field.strip().strip('"').lower() for field in lines[head].split(separator)]
    places = [number for number, field in enumerate(columns) if _POSITION.fullmatch(field)]
    name_column = columns.index(_NAME) if _NAME in columns else None
    first = max([*places, -1 if name_column is None else name_column]) + 1
    axes = tuple(columns[number] for number in places)
    if len({axis.split("_")[0] for axis in axes}) < len(axes) or ("position" in {a.split("_")[0] for a in axes} and
                                                                  len(axes) > 1):  # fmt: skip
        raise _wrong(
            path, head, f"expected position_mm, or x_mm, y_mm and z_mm, once each; found {', '.join(axes)}"
        )
    factors = [_MM[axis.split("_")[1]] for axis in axes]
    rows, positions = [], []
    for number, line in enumerate(lines):
        fields = [field.strip() for field in line.split(separator)]
        if number < head or not _has_words(line):
            rows.append("")
        elif number == head:
            rows.append(separator.join([_NAME, *fields[first:]]))
        else:
            values = [_number(path, number, columns[place], fields, place) for place in places]
            positions.append([value * factor for value, factor in zip(values, factors, strict=True)])
            name = fields[name_column].strip('"') if name_column is not None else f"point {len(positions)}"
            rows.append(separator.join([f'"{name}"', *fields[first:]]))
    spectra = with_unique_names(parse_library("\n".join(rows), path, unit=unit))
    places_mm = np.array(positions)
    if len(spectra) != len(positions) or len(spectra) < 2:
        raise InputError(f"{path}: expected two or more points with spectra, found {len(positions)}")
    if axes[0].startswith("position"):
        order = np.argsort(places_mm[:, 0], kind="stable")
        spectra, places_mm = tuple(spectra[row] for row in order), places_mm[order]
    steps = np.linalg.norm(np.diff(places_mm, axis=0), axis=1)
    if np.any(steps <= 0.0):
        row = int(np.flatnonzero(steps <= 0.0)[0])
        raise _wrong(path, spectra[row + 1].line - 1,
                     f"expected another place than the place of {spectra[row].name}, found the same")  # fmt: skip
    return LinePoints(spectra, np.concatenate([[0.0], np.cumsum(steps)]), places_mm, axes)


def _has_words(line: str) -> bool:
    return bool(line.strip()) and not line.startswith("#")


def _fields(line: str) -> list[str]:
    return [field.strip().strip('"').lower() for field in line.split(max(_SEPARATORS, key=line.count))]


def _number(path: Path, line: int, column: str, fields: list[str], place: int) -> float:
    word = fields[place] if place < len(fields) else ""
    try:
        value = float(word.replace(",", "."))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise _wrong(path, line, f"{column}: expected a number, found {word!r}")
    return value


def _wrong(path: Path, line: int, message: str) -> InputError:
    return InputError([Problem(str(path), line + 1, 1, "", message)])
