"""Relit pictures for the eye: through CIE XYZ to sRGB (IEC 61966-2-1), with its profile.

In a relit picture, all channels are 1 where a white diffuser faces a light of strength 1. So it is balanced, and
the matrix of `coupole.exchange.camera_colour` converts it to the colour of the surface under daylight.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, StorageError, reason
from coupole.exchange.camera_colour import CameraColour
from coupole.exchange.srgb import srgb
from coupole.exchange.tiff_for_the_eye import srgb_profile, tiff_of
from coupole.storage.durable import write_synced

SUFFIXES = (".png", ".tif", ".tiff")


def refuse_unknown(path: Path) -> None:
    """Raise InputError if there is no writer for this kind of file."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"--to {path}: for the eye expected a name that ends in {', '.join(SUFFIXES)}")


def linear_colours(picture: NDArray[np.float32], colour: CameraColour) -> NDArray[np.float64]:
    """[h, w, 3] linear sRGB under daylight of a relit picture in the camera's channels; colours outside the gamut
    have values below 0."""
    from coupole.appearance.spectra.light import linear_srgb

    assert colour.xyz_from_balanced is not None
    return np.asarray(linear_srgb(picture.astype(np.float64) @ colour.xyz_from_balanced.T))


def write_for_the_eye(path: Path, linear: NDArray[np.float64], white: float, about: dict[str, Any]) -> None:
    """Write linear sRGB, completely or not at all: PNG of 8 bits or TIFF of 16 bits, with the profile of sRGB and
    `about`. The value `white` is shown as white. Brighter values, and colours outside the gamut, are clipped.

    Raises InputError for any other kind of file, StorageError if it cannot be written.
    """
    refuse_unknown(path)
    encoding, profile = srgb(linear / white), srgb_profile()
    if path.suffix.lower() == ".png":
        content = _png(np.rint(255.0 * encoding).astype(np.uint8), about, profile)
    else:
        content = tiff_of(np.rint(65535.0 * encoding).astype(np.uint16), about, profile)
    try:
        write_synced(path, content)
    except OSError as error:
        raise StorageError(f"{path}: {reason(error)}") from error


def _png(codes: NDArray[np.uint8], about: dict[str, Any], profile: bytes) -> bytes:
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    info = PngInfo()
    info.add_text("Description", json.dumps(about))
    buffer = io.BytesIO()
    Image.fromarray(codes).save(buffer, "PNG", icc_profile=profile, pnginfo=info)
    return buffer.getvalue()
