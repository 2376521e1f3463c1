"""Files with the lights of pictures: tables, `.lp`, and relight's `.dome` and `.relight`.

relight's JSON (its src/dome.cpp, image.cpp and project.cpp): `directions`, `positionsSphere` and `positions3d` are
lists of {x, y, z}, one for each picture that is not skipped; `lightConfiguration` tells which of them are valid.
Positions are in mm from the middle of the picture; here they only give directions.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, Problem
from coupole.intake.plain_data import json_of

Floats = NDArray[np.float64]

_PLACES = {"spherical": "positionsSphere", "lights3d": "positions3d"}
"""Keys of the lists of lights in relight's files, by `lightConfiguration`. For other configurations, and if that
list is empty, the lights are in `directions`."""
_MOST_DIGITS = 9
"""Largest number of digits in the count of lights."""


@dataclass(frozen=True)
class LightFile:
    """Lights as a file describes them."""

    directions: Floats
    """[n, 3] directions of any length, from the object to the light: x right, y up, z to the camera."""
    names: tuple[str, ...] = ()
    """Names of the pictures; empty if the file has none."""
    intensities: Floats | None = None
    """[n, 3] intensities by which values are divided."""
    srgb: bool = False
    """True if the file says that the pictures are encoded for displays."""
    lines: tuple[int, ...] = ()
    """Lines of the file that contain the directions; empty for JSON."""


def read_lights(path: Path) -> LightFile:
    """Read an `.lp`, `.dome` or `.relight` file, or a table of directions. Raises InputError with the line."""
    match path.suffix.lower():
        case ".lp":
            return read_lp(path)
        case ".dome":
            return _read_dome(path, _json_object(path))
        case ".relight":
            return _read_project(path)
        case _:
            lines, directions = _numbered_rows(path, (3,))
            return LightFile(directions, lines=lines)


def _read_project(path: Path) -> LightFile:
    project = _json_object(path)
    images, dome = project.get("images"), project.get("dome")
    if not isinstance(images, list) or not isinstance(dome, dict):
        refuse(path, "expected a project of relight, with `images` and `dome`")
    if not all(isinstance(image, dict) and isinstance(image.get("filename"), str) for image in images):
        refuse(path, "images: expected a `filename` in each")
    picture_numbers = [number for number, image in enumerate(images) if not image.get("skip", False)]
    lights = _read_dome(path, dome)
    count = len(lights.directions)
    if count not in (len(picture_numbers), len(images)):
        refuse(path, f"dome: {count} lights; {len(picture_numbers)} pictures are used of {len(images)}")
    rows = picture_numbers if count == len(images) else list(range(count))
    names = tuple(_last_part(images[number]["filename"]) for number in picture_numbers)
    for place, name in enumerate(names):
        if name in names[:place]:
            refuse(path, f"images: {_twice(name)}")
    intensities = None if lights.intensities is None else lights.intensities[rows]
    forced_colorspace = project.get("forcedInputColorspace")
    srgb = forced_colorspace == "srgb" or (forced_colorspace is None and project.get("iccProfileIsSRGB") is True)
    return LightFile(lights.directions[rows], names, intensities, srgb)


def _read_dome(path: Path, dome: dict[str, Any]) -> LightFile:
    places = _PLACES.get(str(dome.get("lightConfiguration", "")), "directions")
    key = places if dome.get(places) else "directions"
    directions = _vectors(path, dome, key, "xyz")
    if not len(directions):
        refuse(path, f"{key}: expected a list of lights, each with x, y and z; there is none")
    adjust = _vectors(path, dome, "ledAdjust", "rgb") if dome.get("ledAdjust") else None
    if adjust is not None and (len(adjust) != len(directions) or not np.all(adjust > 0)):
        refuse(path, f"ledAdjust: expected positive r, g, b for each light ({len(directions)})")
    return LightFile(directions, intensities=None if adjust is None else 1.0 / adjust)


def _vectors(path: Path, dome: dict[str, Any], key: str, axes: str) -> Floats:
    """[n, 3] vectors from a list of objects, or from lists of three numbers."""
    rows = dome.get(key, [])
    if not isinstance(rows, list):
        refuse(path, f"{key}: expected a list")
    vectors = np.zeros((len(rows), 3))
    for number, row in enumerate(rows):
        values = [row.get(axis) for axis in axes] if isinstance(row, dict) else row
        if not isinstance(values, list) or len(values) != 3 or not all(map(_is_number, values)):
            refuse(path, f"{key}, number {number}: expected {', '.join(axes)}; found {json.dumps(row)}")
        vectors[number] = values
    return vectors


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9


def _json_object(path: Path) -> dict[str, Any]:
    try:
        document = json_of(_text(path), str(path))
    except InputError as error:
        refuse(path, f"is no JSON: {error}")
    if not isinstance(document, dict):
        refuse(path, "expected a JSON object")
    return document


def _last_part(name: str) -> str:
    return Path(name.replace("\\", "/")).name


def _twice(name: str) -> str:
    return (
        f"two pictures are called {name}; pictures are looked for in one folder by the last part of their "
        "names: put all into one folder under different names, and write these names here"
    )


def read_rows(path: Path, lengths: Sequence[int]) -> NDArray[np.float64]:
    """[n, 3] numbers, one row from each line; a single number stands for three. Raises InputError with the
    line."""
    return _numbered_rows(path, lengths)[1]


def _numbered_rows(path: Path, lengths: Sequence[int]) -> tuple[tuple[int, ...], Floats]:
    lines, rows = [], []
    for line, text in enumerate(read_lines(path), start=1):
        if words := text.replace(",", " ").split():
            if len(words) not in lengths:
                refuse(path, f"{len(words)} values; expected {' or '.join(map(str, lengths))}", line)
            rows.append(np.resize([_number(path, line, word) for word in words], 3))
            lines.append(line)
    return tuple(lines), np.array(rows, dtype=np.float64).reshape(-1, 3)


def read_lp(path: Path) -> LightFile:
    """Read an .lp file: a count, then `name x y z` in each line. Raises InputError with the line."""
    names: list[str] = []
    rows = []
    lines = [(number, text) for number, text in enumerate(read_lines(path), start=1) if text.strip()]
    count = lines[0][1].strip() if lines else ""
    if not count.isdecimal() or len(count) > _MOST_DIGITS:
        refuse(path, "expected the number of lights", lines[0][0] if lines else 1)
    for line, text in lines[1:]:
        words = text.split()
        if len(words) < 4:
            refuse(path, "expected `name x y z`", line)
        name = _last_part(" ".join(words[:-3]))
        if name in names:
            refuse(path, _twice(name), line)
        names.append(name)
        rows.append([_number(path, line, word) for word in words[-3:]])
    if len(rows) != int(count):
        refuse(path, f"says {count} lights, has {len(rows)}", lines[0][0])
    directions = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return LightFile(directions, tuple(names), lines=tuple(line for line, _ in lines[1:]))


def read_lines(path: Path) -> list[str]:
    """Read the lines of a text in UTF-8, with or without a byte order mark. Raises InputError."""
    return _text(path).split("\n")


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        refuse(path, "is not text in UTF-8; save it as UTF-8")
    except OSError as error:
        refuse(path, f"cannot be read: {error.strerror or error}")


def _number(path: Path, line: int, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        refuse(path, f"{word!r} is not a number", line)
    return value


def refuse(path: Path, message: str, line: int = 0) -> NoReturn:
    """Raise InputError about a file."""
    raise InputError([Problem(str(path), line, 1 if line else 0, "", message)])
