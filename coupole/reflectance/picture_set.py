"""Pictures of one view under distant lights of known direction, as in RTI domes and photometric stereo.

Axes: x to the right of the picture, y up, z to the camera. The camera is taken as infinitely distant.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.light_files import read_lights, read_lines, read_rows, refuse

PICTURES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
ORDER_FILE = "filenames.txt"
FEWEST_LIGHTS = 6
"""Least number of lights, because a normal and a material have six unknowns."""


@dataclass(frozen=True)
class PictureSet:
    """Set of pictures as the files describe it; the pictures themselves are read one at a time."""

    files: tuple[Path, ...]
    directions: NDArray[np.float64]
    """[lights, 3] unit vectors from the object to the light."""
    intensities: NDArray[np.float64]
    """[lights, 3] intensities by which values are divided."""
    mask: NDArray[np.bool_]
    """[h, w] True for pixels that are fitted."""
    full_scale: int
    """Largest value that a picture can hold."""
    srgb: bool = False
    """True if files are encoded for displays; their values are decoded to 16 bit."""
    uncalibrated_run: str = ""
    """The run that these pictures come from, with nominal lights; empty for other pictures."""
    simulated: bool | None = None
    """True if the pictures were simulated; None if this is not known."""

    def __len__(self) -> int:
        return len(self.files)

    @property
    def pixels(self) -> int:
        return int(np.count_nonzero(self.mask))

    def raw_values(self, number: int) -> NDArray[Any]:
        """[pixels, 3] linear values of one picture inside the mask, row by row.

        Raises InputError if the picture differs from the first one in size or depth.
        """
        picture = read_picture(self.files[number])
        if self.srgb:
            picture = linear_of_srgb(picture)
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
    folder: Path, lights: Path, *, intensities: Path | None = None, mask: Path | None = None, srgb: bool = False
) -> PictureSet:
    """Read the set in a folder; `lights` is any file that `read_lights` accepts. `srgb` tells that the pictures
    are encoded for displays; the file of lights may say so too.

    Raises InputError with file and line.
    """
    if not folder.is_dir():
        refuse(folder, "is not a folder of pictures")
    light_file = read_lights(lights)
    directions = light_file.directions
    names = light_file.names or _names_in(folder, {path.resolve() for path in (mask,) if path is not None})
    if len(names) != len(directions):
        refuse(lights, f"has {len(directions)} lights, {folder} has {len(names)} pictures; expected equal numbers")
    if len(names) < FEWEST_LIGHTS:
        refuse(lights, f"has {len(names)} lights; at least {FEWEST_LIGHTS} are needed")
    files = tuple(folder / name for name in names)
    for path in files:
        if not path.is_file():
            refuse(lights if light_file.names else folder / ORDER_FILE, f"names {path}: no such file")
    lengths = np.linalg.norm(directions, axis=1)
    for number, length in enumerate(lengths):
        if length < 1e-6:
            line = light_file.lines[number] if light_file.lines else 0
            refuse(lights, f"the direction of light number {number} (from 0), of {names[number]}, is 0 0 0", line)
    first = read_picture(files[0])
    srgb = srgb or light_file.srgb
    factors = light_file.intensities if light_file.intensities is not None else np.ones((len(files), 3))
    if intensities is not None:
        factors = read_rows(intensities, (1, 3))
    if len(factors) != len(files) or not np.all(factors > 0):
        refuse(intensities or lights, f"expected {len(files)} lines of positive intensities, got {len(factors)}")
    return PictureSet(
        files,
        directions / lengths[:, None],
        np.broadcast_to(factors, (len(files), 3)),
        _read_mask(mask, first.shape[:2]),
        65535 if srgb else int(np.iinfo(first.dtype).max),
        srgb,
    )


def linear_of_srgb(picture: NDArray[Any]) -> NDArray[np.uint16]:
    """Return linear values, full scale 65535, from sRGB codes (IEC 61966-2-1)."""
    most = int(np.iinfo(picture.dtype).max)
    codes = np.arange(most + 1) / most
    linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    table = np.rint(65535.0 * linear).astype(np.uint16)
    values: NDArray[np.uint16] = table[picture]
    return values


def _names_in(folder: Path, other_files: set[Path]) -> tuple[str, ...]:
    order = folder / ORDER_FILE
    if order.is_file():
        return tuple(" ".join(read_lines(order)).split())
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
    return tuple(path.name for path in paths if path.resolve() not in other_files and path.stem != "mask")


def read_picture(path: Path) -> NDArray[Any]:
    """[h, w, 3] red, green, blue, uint8 or uint16; a grey picture is repeated three times. Raises InputError."""
    import cv2

    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        refuse(path, "is not a readable picture; expected PNG, TIFF or JPEG")
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
