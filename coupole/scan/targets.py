"""Tables of positioning targets (retro-reflective stickers) as text, from VXelements or spreadsheets.

No file of the real scanner was available, so many variants are read: comments; tabs, commas, semicolons or blanks
between columns; decimal commas; a line of headings; a name in the first column; normals in the last columns. An
ambiguous line is refused with its number.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError

_REMARK = re.compile(r"^\s*(#|//|;|%)")
_NUMBER = re.compile(r"^[+-]?(\d+([.]\d*)?|[.]\d+)([eE][+-]?\d+)?$")
_UNIT = re.compile(r"[\[(](?:mm|cm|m|um|µm|in)[\])]|\b(?:mm|cm|um|µm|inch|inches)\b|\bunits?\W+(?:m|in)\b", re.I)
"""Units in a heading. `m` and `in` are also words, so they count only in brackets or after `unit`."""
_COLUMNS = {3: "x y z", 4: "name x y z", 6: "x y z nx ny nz", 7: "name x y z nx ny nz"}
_UNIT_NORMAL_TOLERANCE = 0.02


@dataclass(frozen=True)
class Targets:
    """Centres [n, 3] in the file's unit, and `normals` [n, 3] of length 1 if the file has them."""

    names: tuple[str, ...]
    centers: NDArray[np.float64]
    normals: NDArray[np.float64] | None
    unit: str
    """Unit in the file; empty if there is none."""


def read_targets(path: Path) -> Targets:
    """Read a table of targets. Raises InputError with the number of an invalid or ambiguous line."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError:
        raise InputError(f"{path}: expected a table of targets; there is no such file") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected text (UTF-8); byte {error.start} is not UTF-8") from None
    rows: list[tuple[int, list[str]]] = []
    units: dict[str, int] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        words = _words(line, path, number)
        if _REMARK.match(line) or (not rows and not any(_NUMBER.match(word) for word in words[-3:])):
            for unit_word in _UNIT.findall(line):
                units.setdefault(_unit(unit_word), number)
            continue
        rows.append((number, words))
    if not rows:
        raise InputError(f"{path}: expected a line for each target; there is none")
    if len(units) > 1:
        raise InputError(f"{path}:{max(units.values())}: mixed units: {' and '.join(sorted(units))}")
    return _targets(path, rows, next(iter(units), ""))


def _unit(written_unit: str) -> str:
    name = re.split(r"\W+", written_unit.strip("[]()").lower())[-1]
    return {"µm": "um", "inch": "in", "inches": "in"}.get(name, name)


def _words(line: str, path: Path, number: int) -> list[str]:
    """Return a line's columns. A comma is a decimal comma if another separator is between the columns."""
    text = line.strip()
    if ";" in text or "\t" in text:
        words = [word.strip().replace(",", ".") for word in re.split(r"[;\t]+", text.rstrip(";\t"))]
    elif re.search(r"\d,\s", text) or ("," in text and " " not in text):
        words = [word.strip() for word in text.rstrip(",").split(",")]
        decimals = "." in text
        if not decimals and len(words) in (6, 8, 12, 14) and all(re.fullmatch(r"[+-]?\d+", w) for w in words[-6:]):
            raise InputError(
                f"{path}:{number}: `{text[:60]}` could be {len(words)} whole numbers or {len(words) // 2} with "
                "decimal commas; separate the columns by semicolons or tabs, or write decimal points"
            )
    else:
        words = [word.replace(",", ".") for word in text.split()]
    return words


def _targets(path: Path, rows: list[tuple[int, list[str]]], unit: str) -> Targets:
    first, columns = rows[0][0], len(rows[0][1])
    if columns not in _COLUMNS:
        expected_columns = "; ".join(f"{n} ({meaning})" for n, meaning in _COLUMNS.items())
        raise InputError(f"{path}:{first}: expected columns {expected_columns}; found {columns}")
    has_names = columns in (4, 7)
    names, numbers = [], np.empty((len(rows), columns - has_names))
    for row, (line, words) in enumerate(rows):
        if len(words) != columns:
            raise InputError(f"{path}:{line}: expected {columns} columns as in line {first}, found {len(words)}")
        names.append(words[0] if has_names else str(row + 1))
        for column, word in enumerate(words[has_names:]):
            if not _NUMBER.match(word):
                raise InputError(
                    f"{path}:{line}: expected a number in column {column + has_names + 1}, found `{word[:40]}`"
                )
            numbers[row, column] = float(word)
    if len(set(names)) < len(names):
        again = next(name for name in names if names.count(name) > 1)
        lines = [str(line) for (line, _), name in zip(rows, names, strict=True) if name == again]
        raise InputError(f"{path}:{lines[1]}: target `{again}` is in lines {' and '.join(lines)}")
    normals = _normals(path, rows, numbers[:, 3:]) if numbers.shape[1] == 6 else None
    return Targets(tuple(names), numbers[:, :3].copy(), normals, unit)


def _normals(path: Path, rows: list[tuple[int, list[str]]], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    wrong = np.flatnonzero(np.abs(lengths[:, 0] - 1.0) > _UNIT_NORMAL_TOLERANCE)
    if wrong.size:
        line, length = rows[wrong[0]][0], float(lengths[wrong[0], 0])
        raise InputError(
            f"{path}:{line}: expected a normal of length 1 in the last three columns, found {length:.4g}"
        )
    unit_normals: NDArray[np.float64] = normals / lengths
    return unit_normals
