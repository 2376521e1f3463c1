"""Pictures of one view under distant lights of known direction, as RTI domes and photometric stereo have them.

Axes: x to the right of the picture, y up, z to the camera, which is taken as far away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, Problem

PICTURES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
ORDER_FILE = "filenames.txt"
FEWEST_LIGHTS = 6
"""A normal and a material have six unknowns."""


@dataclass(frozen=True)
class PictureSet:
    """What the files say; the pictures themselves are read one by one."""

    files: tuple[Path, ...]
    directions: NDArray[np.float64]
    """[lights, 3] unit vectors from the object to the light."""
    intensities: NDArray[np.float64]
    """[lights, 3] by which values are divided."""
    mask: NDArray[np.bool_]
    """[h, w] what is fitted."""
    full_scale: int
    """Largest value that a file can hold."""
    uncalibrated_run: str = ""
    """The run that these are pictures of, with nominal lights; empty for others."""

    def __len__(self) -> int:
        return len(self.files)

    @property
    def pixels(self) -> int:
        return int(np.count_nonzero(self.mask))

    def raw_values(self, number: int) -> NDArray[Any]:
        """[pixels, 3] of one picture, those of the mask in the order of rows, as the file has them.

        Raises InputError if it differs from the first picture in size or depth.
        """
        picture = read_picture(self.files[number])
        if picture.shape[:2] != self.mask.shape or picture.dtype != self.dtype:
            refuse(self.files[number], _differs(picture, self.mask.shape, self.dtype))
        return picture[self.mask]

    @property
    def dtype(self) -> Any:
        return np.dtype(np.uint8 if self.full_scale < 256 else np.uint16)


def _differs(picture: NDArray[Any], shape: tuple[int, ...], dtype: Any) -> str:
    height, width = picture.shape[:2]
    return (
        f"has {width} x {height} pixels of {8 * picture.dtype.itemsize} bit; the first picture has "
        f"{shape[1]} x {shape[0]} of {8 * np.dtype(dtype).itemsize}"
    )


def read_pictures(
    folder: Path, lights: Path, *, intensities: Path | None = None, mask: Path | None = None
) -> PictureSet:
    """The set in a folder; `lights` is an .lp file, or one with a direction in each line.

    Raises InputError that names file and line.
    """
    if not folder.is_dir():
        refuse(folder, "is no folder of pictures")
    names, directions = read_lp(lights) if lights.suffix.lower() == ".lp" else ([], read_rows(lights, (3,)))
    if not names:
        names = _names_in(folder, {path.resolve() for path in (mask,) if path is not None})
    if len(names) != len(directions):
        refuse(lights, f"has {len(directions)} lights, {folder} has {len(names)} pictures; expected as many")
    if len(names) < FEWEST_LIGHTS:
        refuse(lights, f"has {len(names)} lights; at least {FEWEST_LIGHTS} are needed")
    files = tuple(folder / name for name in names)
    for path in files:
        if not path.is_file():
            refuse(
                lights if lights.suffix.lower() == ".lp" else folder / ORDER_FILE, f"names {path}: no such file"
            )
    lengths = np.linalg.norm(directions, axis=1)
    for line, length in enumerate(lengths, start=1):
        if length < 1e-6:
            refuse(lights, "a light's direction has no length", line)
    first = read_picture(files[0])
    factors = read_rows(intensities, (1, 3)) if intensities else np.ones((len(files), 3))
    if len(factors) != len(files) or not np.all(factors > 0):
        refuse(intensities or lights, f"expected {len(files)} lines of positive intensities, got {len(factors)}")
    return PictureSet(
        files,
        directions / lengths[:, None],
        np.broadcast_to(factors, (len(files), 3)),
        _read_mask(mask, first.shape[:2]),
        int(np.iinfo(first.dtype).max),
    )


def _names_in(folder: Path, others: set[Path]) -> list[str]:
    order = folder / ORDER_FILE
    if order.is_file():
        return order.read_text(encoding="utf-8").split()
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
    return [path.name for path in found if path.resolve() not in others and path.stem != "mask"]


def read_picture(path: Path) -> NDArray[Any]:
    """[h, w, 3] red, green, blue, uint8 or uint16; a grey picture three times. Raises InputError."""
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        refuse(path, "is no picture that can be read; expected PNG, TIFF or JPEG")
    if picture.dtype not in (np.uint8, np.uint16):
        refuse(path, f"has values of type {picture.dtype}; expected 8 or 16 bit")
    if picture.ndim == 2:
        return np.repeat(picture[..., None], 3, axis=2)
    return np.ascontiguousarray(picture[..., 2::-1])


def _read_mask(path: Path | None, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    if path is None:
        return np.ones(shape, dtype=bool)
    mask: NDArray[np.bool_] = read_picture(path).max(axis=2) > 0
    if mask.shape != shape:
        refuse(path, f"has {mask.shape[1]} x {mask.shape[0]} pixels, the pictures {shape[1]} x {shape[0]}")
    if not mask.any():
        refuse(path, "is black everywhere: nothing to fit")
    return mask


def read_rows(path: Path, lengths: Sequence[int]) -> NDArray[np.float64]:
    """[n, 3] numbers, one row a line; a single number stands for three. Raises InputError with the line."""
    rows = []
    for line, text in enumerate(_lines(path), start=1):
        if words := text.replace(",", " ").split():
            if len(words) not in lengths:
                refuse(path, f"{len(words)} values; expected {' or '.join(map(str, lengths))}", line)
            rows.append(np.resize([_number(path, line, word) for word in words], 3))
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def read_lp(path: Path) -> tuple[list[str], NDArray[np.float64]]:
    """Names of pictures and directions [n, 3] of an .lp file: a count, then `name x y z` in each line."""
    names, rows = [], []
    lines = [(number, text) for number, text in enumerate(_lines(path), start=1) if text.strip()]
    if not lines or not lines[0][1].strip().isdecimal():
        refuse(path, "expected the number of lights", lines[0][0] if lines else 1)
    for line, text in lines[1:]:
        words = text.split()
        if len(words) < 4:
            refuse(path, "expected `name x y z`", line)
        names.append(Path(" ".join(words[:-3]).replace("\\", "/")).name)
        rows.append([_number(path, line, word) for word in words[-3:]])
    if len(rows) != int(lines[0][1]):
        refuse(path, f"says {lines[0][1].strip()} lights, has {len(rows)}", lines[0][0])
    return names, np.array(rows, dtype=np.float64)


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError([Problem(str(path), 0, 0, "", f"cannot be read: {error}")]) from error


def _number(path: Path, line: int, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        refuse(path, f"{word!r} is no number", line)
    return value


def refuse(path: Path, message: str, line: int = 0) -> NoReturn:
    """Raise InputError about a file."""
    raise InputError([Problem(str(path), line, 1 if line else 0, "", message)])
