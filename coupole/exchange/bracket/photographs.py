"""The photographs of a bracket: values from 0 to 1, with exposure times from EXIF or from the user."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError

_EXIF, _TIME, _APERTURE, _ISO = 34665, 33434, 33437, 34855
PLAIN = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}
"""Suffixes of photographs that are not raw files."""
_LEAST_RATIO = 1.2


@dataclass(frozen=True)
class Photographs:
    """Photographs of one scene, in the order of increasing exposure time."""

    paths: tuple[Path, ...]
    values: NDArray[np.float32]
    """[photographs, h, w, 3] red, green, blue as stored, divided by the largest value that the file can hold."""
    exposure_s: NDArray[np.float64]
    """[photographs]."""
    levels: int
    """Number of levels that a value can have."""
    raw: bool
    """True if the values are those of a sensor, without a transfer curve; a pixel is then a cell of 2 x 2."""


def read_photographs(paths: Sequence[Path], exposure_s: Sequence[float] | None = None) -> Photographs:
    """Read photographs. Raises InputError for files that cannot be read, of several kinds or sizes, or without a
    known exposure."""
    if len(paths) < 2:
        raise InputError(f"bracket: expected two photographs or more, found {len(paths)}")
    if exposure_s is not None and len(exposure_s) != len(paths):
        raise InputError(
            f"--exposure-s: expected a time for each of {len(paths)} photographs, found {len(exposure_s)}"
        )
    pictures = [read_photograph(path) for path in paths]
    exif_tags = [_exif(path) for path in paths] if exposure_s is None else [{_TIME: time} for time in exposure_s]
    for number, label in ((_APERTURE, "apertures"), (_ISO, "ISO numbers")):
        settings = {tags.get(number) for tags in exif_tags}
        if len(settings) > 1:
            raise InputError(f"bracket: expected photographs that differ in time alone; found {label} {settings}")
    if untold := [str(path) for path, tags in zip(paths, exif_tags, strict=True) if not tags.get(_TIME)]:
        raise InputError(
            f"{untold[0]}: has no exposure time in its EXIF; give the times of all photographs with --exposure-s"
        )
    shapes = {
        (values.shape, levels, path.suffix.lower() in PLAIN)
        for path, (values, levels) in zip(paths, pictures, strict=True)
    }
    if len(shapes) > 1:
        raise InputError(f"bracket: expected photographs of one size and kind; found {sorted(map(str, shapes))}")
    times = np.array([float(tags[_TIME]) for tags in exif_tags])
    order = np.argsort(times, kind="stable")
    times = times[order]
    if np.any(times <= 0.0) or times[-1] / times[0] < _LEAST_RATIO:
        raise InputError(
            f"bracket: expected exposure times in steps of 2 to 4, found {times.tolist()} s; take other "
            "photographs"
        )
    return Photographs(
        tuple(paths[k] for k in order),
        np.stack([pictures[k][0] for k in order]),
        times,
        pictures[0][1],
        raw=paths[0].suffix.lower() not in PLAIN,
    )


def read_photograph(path: Path) -> tuple[NDArray[np.float32], int]:
    """[h, w, 3] values as stored, divided by the largest value, and the number of levels. Raises InputError."""
    if path.suffix.lower() not in PLAIN:
        return read_raw(path), 65536
    import cv2

    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    picture = cv2.imdecode(content, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH) if content.size else None
    if picture is None or picture.dtype not in {np.dtype(np.uint8), np.dtype(np.uint16)}:
        raise InputError(f"{path}: expected a photograph of 8 or 16 bits (JPEG, PNG, TIFF), or a raw file")
    most = 255 if picture.dtype == np.uint8 else 65535
    return (picture[..., ::-1] / np.float32(most)).astype(np.float32), most + 1


def read_raw(path: Path) -> NDArray[np.float32]:
    """[h, w, 3] the sensor's values minus black, divided by white minus black, of each cell of 2 x 2 pixels;
    greens are averaged. Raises InputError."""
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            picture: Any = raw.postprocess(
                half_size=True,
                gamma=(1.0, 1.0),
                no_auto_bright=True,
                adjust_maximum_thr=0.0,
                output_bps=16,
                user_wb=[1.0, 1.0, 1.0, 1.0],
                output_color=rawpy.ColorSpace.raw,
                user_flip=0,
            )
    except (rawpy.LibRawError, OSError) as error:
        raise InputError(f"{path}: expected JPEG, PNG, TIFF, or a raw file that LibRaw reads; {error}") from error
    return np.asarray(picture, np.float32) / np.float32(65535.0)


def _exif(path: Path) -> dict[int, float]:
    """Read time, aperture and ISO, as far as they exist."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            tags = image.getexif()
    except (OSError, UnidentifiedImageError):
        return _exif_of_raw(path)
    inner = tags.get_ifd(_EXIF)
    values = {number: inner.get(number, tags.get(number)) for number in (_TIME, _APERTURE, _ISO)}
    return {number: float(value) for number, value in values.items() if value is not None}


def _exif_of_raw(path: Path) -> dict[int, float]:
    """Read time, aperture and ISO of raw files that are built as TIFF."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            inner = file.pages[0].tags[_EXIF].value  # type: ignore[union-attr]
    except (OSError, KeyError, ValueError, tifffile.TiffFileError):
        return {}
    names = {_TIME: "ExposureTime", _APERTURE: "FNumber", _ISO: "ISOSpeedRatings"}
    values = {number: inner.get(name) for number, name in names.items()}
    return {number: _ratio(value) for number, value in values.items() if value is not None}


def _ratio(value: Any) -> float:
    return (
        float(value[0]) / float(value[1])
        if isinstance(value, tuple) and len(value) == 2
        else float(np.ravel(value)[0])
    )
