"""Pictures of a colour chart with linear values, from any camera and converter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.colour.chart_pictures import PlainPicture
from coupole.errors import InputError, reason
from coupole.exchange.bracket.photographs import PLAIN, read_raw
from coupole.exchange.srgb import linear_from_srgb

RAW = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".3fr", ".iiq"}
"""Suffixes of raw files that are searched in a folder; a named file may have another suffix."""
_JPEG = {".jpg", ".jpeg"}
_MOST_PICTURES = 60


def pictures_at(paths: Sequence[Path], without: Path | None = None) -> list[Path]:
    """Return the picture files, or all pictures of one folder except one. Raises InputError if there are none."""
    if len(paths) == 1 and paths[0].is_dir():
        kinds = PLAIN | RAW | {".exr"}
        files = sorted(path for path in paths[0].iterdir() if path.suffix.lower() in kinds)
        pictures = [path for path in files if without is None or path.resolve() != without.resolve()]
        if not pictures:
            raise InputError(
                f"{paths[0]}: expected a run, or a folder with pictures of the chart (TIFF, PNG, EXR, RAW)"
            )
        if len(pictures) > _MOST_PICTURES:
            raise InputError(
                f"{paths[0]}: has {len(pictures)} pictures; expected at most {_MOST_PICTURES} of the chart"
            )
        return pictures
    for path in paths:
        if path.is_dir():
            raise InputError(f"{path}: expected runs, or pictures, or one folder of pictures")
        if not path.is_file():
            raise InputError(f"{path}: there is no such run or picture")
    return list(paths)


def read_chart_photograph(path: Path, *, srgb: bool = False) -> PlainPicture:
    """Read one picture. With `srgb`, its codes have the transfer curve of IEC 61966-2-1, and are decoded.

    An OpenEXR may have the channels `saturated` and `dark` of `coupole bracket`. Raises InputError if it is not a
    picture, if it has one channel, if a JPEG is declared linear, or if a linear file is declared encoded.
    """
    suffix = path.suffix.lower()
    if suffix in PLAIN:
        return _plain(path, srgb=srgb)
    if srgb:
        raise InputError(f"{path}: --srgb is for PNG, TIFF and JPEG; OpenEXR and raw files are linear")
    if suffix == ".exr":
        from coupole.exchange.bracket.merged_files import read_known

        values = read_known(path)
        return PlainPicture(path.name, values, _unknown(values))
    values = read_raw(path)
    full = np.asarray((values >= 1.0).any(axis=2), np.bool_)
    return PlainPicture(path.name, values, full, 65536)


def _plain(path: Path, *, srgb: bool) -> PlainPicture:
    import cv2

    if path.suffix.lower() in _JPEG and not srgb:
        raise InputError(
            f"{path}: a JPEG is encoded for displays, not linear. Give RAW, a linear TIFF of 16 bit or OpenEXR, "
            "merge several exposures with `coupole bracket`, or give --srgb if the JPEG has "
            "sRGB's curve and no other"
        )
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {reason(error)}") from error
    picture = cv2.imdecode(content, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH) if content.size else None
    if picture is None or picture.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(f"{path}: expected a picture of 8 or 16 bits or of floating point; cannot be decoded")
    if picture.ndim == 2:
        raise InputError(f"{path}: has one channel; expected red, green and blue")
    colours: NDArray[Any] = picture[..., ::-1]
    if colours.dtype == np.float32:
        if srgb:
            raise InputError(f"{path}: --srgb is for 8 and 16 bits; floating point is linear")
        return PlainPicture(path.name, np.ascontiguousarray(colours), _unknown(colours))
    most = int(np.iinfo(colours.dtype).max)
    values = _linear(most, srgb=srgb)[colours]
    return PlainPicture(path.name, values, (colours == most).any(axis=2), most + 1)


def _linear(most: int, *, srgb: bool) -> NDArray[np.float32]:
    """[most + 1] linear values, 0 to 1, of the codes."""
    codes = np.arange(most + 1) / most
    return np.asarray(linear_from_srgb(codes) if srgb else codes, np.float32)


def _unknown(values: NDArray[Any]) -> NDArray[np.bool_]:
    """[h, w] True if a channel has no number."""
    return np.asarray(~np.isfinite(values).all(axis=2), np.bool_)
