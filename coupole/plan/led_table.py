"""The LED table of the dome: position, direction and flux of each LED."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.errors import InputError, Problem
from coupole.intake.input_files import InputFiles

COLUMNS = ("id", "board", "x_mm", "y_mm", "z_mm", "nx", "ny", "nz", "flux_lm")

_FARTHEST_MM, _BRIGHTEST_LM = 20_000.0, 1e6
_MOST_BYTES = 16 * 1024**2


@dataclass(frozen=True)
class LedTable:
    """LEDs in the order of the file, with positions and unit normals [n, 3] in the base frame."""

    ids: NDArray[np.int64]
    boards: NDArray[np.int64]
    positions_mm: NDArray[np.float64]
    normals: NDArray[np.float64]
    flux_lm: NDArray[np.float64]

    def illuminance_lux(self, points_base_mm: ArrayLike, *, emission: str = "lambertian") -> NDArray[np.float64]:
        """Return the illuminance [points, leds] on a surface that faces each LED. This is the maximum at a point.

        E = Phi / (pi d^2) cos(emission angle) for a small Lambertian emitter; `paper` takes the cosine twice
        (Lucat et al. 2025, Eq. 2). Points are [points, 3] in mm in the base frame.
        """
        from_led = np.asarray(points_base_mm, dtype=np.float64)[:, None, :] - self.positions_mm[None, :, :]
        distance_mm = np.linalg.norm(from_led, axis=2)
        cosine = np.einsum("pij,ij->pi", from_led, self.normals) / distance_mm
        cosine = np.where(cosine > 0.0, cosine, 0.0) ** (2 if emission == "paper" else 1)
        lux: NDArray[np.float64] = self.flux_lm / np.pi / (distance_mm * 1e-3) ** 2 * cosine
        return lux

    def rows(self, ids: ArrayLike) -> NDArray[np.int64]:
        """Return the rows of the table that hold these LED ids. Raises KeyError for an id that is missing."""
        row_of_id = {int(led): row for row, led in enumerate(self.ids)}
        return np.array([row_of_id[int(led)] for led in np.asarray(ids).ravel()], np.int64)


def read_led_table(path: Path, files: InputFiles | None = None) -> LedTable:
    """Read a dome's CSV (`#` comments, then a header, then one LED a line), from `files` if they are given. Raises
    InputError with all problems."""
    files = InputFiles() if files is None else files
    try:
        if (size_bytes := path.stat().st_size if path not in files else 0) > _MOST_BYTES:
            raise InputError(f"{path}: expected an LED table of at most {_MOST_BYTES} bytes, found {size_bytes}")
        return _parse_table(files.read_bytes(path).decode("utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError([Problem(str(path), 0, 0, "", f"cannot read the LED table: {error}")]) from error


@lru_cache(maxsize=4)
def _parse_table(text: str, path: str) -> LedTable:
    """Return the table of this text. Its arrays are read-only, because a session reads its dome several times."""
    problems: list[Problem] = []
    rows: list[list[float]] = []
    first_line_of_id: dict[int, int] = {}

    def wrong(line: int, message: str, key: str = "") -> None:
        problems.append(Problem(path, line, 1 if line else 0, key, message))

    lines = enumerate(text.splitlines(), 1)
    numbered_lines = [(n, line) for n, line in lines if line.strip() and not line.startswith("#")]
    header = numbered_lines[0] if numbered_lines else (0, "")
    if tuple(field.strip() for field in header[1].split(",")) != COLUMNS:
        wrong(header[0], f"expected the header `{','.join(COLUMNS)}`, found `{header[1]}`")
        raise InputError(problems)
    for line, fields in numbered_lines[1:]:
        try:
            values = [float(field) for field in next(csv.reader([fields]))]
        except (ValueError, csv.Error) as error:
            wrong(line, str(error))
            continue
        if len(values) != len(COLUMNS) or not all(map(math.isfinite, values)):
            wrong(line, f"expected {len(COLUMNS)} finite numbers, found {len(values)} fields")
            continue
        led = int(values[0])
        if led in first_line_of_id:
            wrong(line, f"LED {led} is already defined in line {first_line_of_id[led]}", "id")
        for key, message in _mistakes(values):
            wrong(line, message, key)
        first_line_of_id.setdefault(led, line)
        rows.append(values)
    if not rows and not problems:
        wrong(header[0], "expected at least one LED after the header")
    if problems:
        raise InputError(problems)
    table = np.array(rows)
    normals = table[:, 5:8] / np.linalg.norm(table[:, 5:8], axis=1, keepdims=True)
    arrays = table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:5], normals, table[:, 8]
    for array in (table, *arrays):
        array.flags.writeable = False
    return LedTable(*arrays)


def _mistakes(values: list[float]) -> Iterator[tuple[str, str]]:
    """Yield columns and messages of impossible values of one LED."""
    for key, value, most in (("id", values[0], 65534), ("board", values[1], 65535)):
        if value != int(value) or not 0 <= value <= most:
            yield key, f"expected an integer from 0 to {most}, found {value:g}"
    if max(map(abs, values[2:5])) > _FARTHEST_MM:
        place = ", ".join(f"{value:g}" for value in values[2:5])
        yield "x_mm, y_mm, z_mm", f"expected mm, at most {_FARTHEST_MM:g} on each axis, found {place}"
    norm = math.hypot(*values[5:8])
    if abs(norm - 1.0) > 1e-3:
        yield "nx, ny, nz", f"expected a unit normal, found one of length {norm:.4f}"
    if not 0 < values[8] <= _BRIGHTEST_LM:
        yield "flux_lm", f"expected a flux in lm, above 0 and at most {_BRIGHTEST_LM:g}, found {values[8]:g}"
