"""Scans as text: PTX and PTS of Leica and others, and plain lines with x, y and z.

A PTX has one or more scans. Each has the numbers of its columns and rows, the scanner's position and axes (4
lines), a matrix of 4 lines, and a line for each ray. Points are rows, and the matrix is multiplied from their
right. The line of a ray has x, y, z, intensity and, if there are colours, red, green and blue. Rays that did not
return are `0 0 0`. A PTS has the number of points, then the same lines of points. A colour of 0, 0, 0 means no
colour (SpatialAnalyzer user's manual, "PTX", "PTS").
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.scan.mesh import Mesh, expect_finite, expect_records, expect_room
from coupole.scan.registration.scan_content import ScanContent, ScanSource

TEXT_SUFFIXES = (".xyz", ".txt", ".asc")
HEADED_SUFFIXES = (".ptx", ".pts")
_LEAST_BYTES_OF_A_LINE = 6
_PTX_LINES = 10
_RIGID = 1e-3
"""Largest deviation of a stated rotation from an orthogonal matrix."""

Floats = NDArray[np.float64]


def headed_sources(path: Path) -> Iterator[ScanSource]:
    """Return the scans of a PTX or PTS. Raises InputError with the line."""
    number, line = 0, 1
    with path.open("rb") as file:
        while True:
            at_byte = file.tell()
            head = file.readline()
            if not head.strip():
                if not head:
                    return
                line += 1
                continue
            file.seek(at_byte)
            name = path.name if number == 0 else f"{path.name}#{number + 1}"
            source = ScanSource(path, name, number, at_byte, line)
            count, lines, _ = _header(file, source)
            line_count = sum(1 for _ in islice(file, count))
            expect_records(path, f"scan {number + 1}, point", count, line_count)
            yield source
            number, line = number + 1, line + lines + count


def read_headed(source: ScanSource) -> ScanContent:
    """Read one scan of a PTX or PTS. Raises InputError with the line."""
    with source.path.open("rb") as file:
        file.seek(source.at_byte)
        count, lines, pose = _header(file, source)
        table = _table(source.path, islice(file, count), source.at_line + lines)
    expect_records(source.path, "point", count, len(table))
    came_back = np.any(table[:, :3] != 0, axis=1)
    return _content(source.path, table[came_back], pose, none_is_black=True)


def read_plain(path: Path) -> ScanContent:
    """Read lines with x, y, z and possibly more columns. With six or seven columns, the last three may be
    colours."""
    with path.open("rb") as file:
        return _content(path, _table(path, file, 1), None, none_is_black=False)


def _content(path: Path, table: Floats, pose: Floats | None, *, none_is_black: bool) -> ScanContent:
    with np.errstate(over="ignore"):  # numbers that float32 cannot hold become infinite, and are refused
        points = table[:, :3].astype(np.float32)
    expect_finite(path, points, "point {}")
    colours = _colours(table, none_is_black=none_is_black)
    return ScanContent(Mesh(points, np.zeros((0, 3), np.uint32)), colours, pose)


def _colours(table: Floats, *, none_is_black: bool) -> NDArray[np.uint8] | None:
    """Return the last three of six or seven columns if they are whole numbers of 0 to 255 and not all 0 or 1."""
    if table.shape[1] not in (6, 7) or not len(table):
        return None
    last = table[:, -3:]
    if not np.all((last >= 0) & (last <= 255) & (last == np.round(last))) or last.max() <= 1:
        return None
    there = np.any(last > 0, axis=1) if none_is_black else np.ones(len(last), bool)
    return np.column_stack([last, 255 * there]).astype(np.uint8)


def _header(file: BinaryIO, source: ScanSource) -> tuple[int, int, Floats | None]:
    """Return the number of points, the lines of the header, and the pose that a PTX states."""
    lines = _PTX_LINES if source.path.suffix.lower() == ".ptx" else 1
    rows = []
    for k in range(lines):
        text = file.readline(4096).decode("ascii", "replace")
        column_count = 1 if k < 2 else 3 if k < 6 else 4
        rows.append(_numbers(source, source.at_line + k, text, column_count))
    counts = [row[0] for row in rows[: 2 if lines > 1 else 1]]
    if any(count != round(count) or count < 1 for count in counts):
        raise InputError(f"{source.path}:{source.at_line}: expected a number of points, found {counts[0]:g}")
    count = int(np.prod(counts))
    expect_room(source.path, "points", count, _LEAST_BYTES_OF_A_LINE, source.path.stat().st_size)
    return count, lines, _pose(source, np.array(rows[6:])) if lines > 1 else None


def _numbers(source: ScanSource, line: int, text: str, wanted_count: int) -> list[float]:
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != wanted_count or not np.all(np.isfinite(numbers)):
        excerpt = text.strip()[:60] or "nothing"
        raise InputError(
            f"{source.path}:{line}: expected {wanted_count} number{'s' if wanted_count > 1 else ''} of the "
            f"header of scan "
            f"{source.number + 1}, found `{excerpt}`"
        )
    return numbers


def _pose(source: ScanSource, matrix: Floats) -> Floats:
    pose = matrix.T
    turn = pose[:3, :3]
    if (
        np.abs(turn @ turn.T - np.eye(3)).max() > _RIGID
        or np.linalg.det(turn) < 0
        or np.any(pose[3] != [0, 0, 0, 1])
    ):
        raise InputError(
            f"{source.path}:{source.at_line + 6}: expected the matrix of a rigid motion, with 0, 0, 0 and 1 last "
            "in its lines; this one scales or mirrors"
        )
    return pose


def _table(path: Path, lines: Iterator[bytes] | BinaryIO, first_line: int) -> Floats:
    """[n, columns] numbers of lines with equal numbers of columns. Raises InputError with the line."""
    reader = _Decoded(lines)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # no warning about missing lines: the caller counts them
            table = np.loadtxt(reader, dtype=np.float64, comments=("#", "//"), ndmin=2)
    except ValueError as error:
        line = first_line + reader.count - 1
        raise InputError(
            f"{path}:{line}: expected x, y and z first in each line, and the same count of numbers in all "
            f"lines, separated by blanks; found `{reader.last.strip()[:60]}`"
        ) from error
    if len(table) and table.shape[1] < 3:
        raise InputError(f"{path}:{first_line}: expected x, y and z in each line, found {table.shape[1]} numbers")
    return table if len(table) else np.zeros((0, 3))


class _Decoded:
    """Decoded lines; it knows which line was returned last."""

    def __init__(self, lines: Iterator[bytes] | BinaryIO) -> None:
        self._lines = iter(lines)
        self.count, self.last = 0, ""

    def __iter__(self) -> _Decoded:
        return self

    def __next__(self) -> str:
        self.last = next(self._lines).decode("ascii", "replace")
        self.count += 1
        return self.last
