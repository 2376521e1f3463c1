"""A frame as TIFF for the eye: demosaiced, white-balanced, converted through CIE XYZ to sRGB (IEC 61966-2-1), 16
bits, with its profile."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

import coupole
from coupole.errors import InputError
from coupole.exchange.camera_colour import CameraColour
from coupole.exchange.demosaiced import PATTERNS, demosaiced
from coupole.exchange.exported_frame import Picture
from coupole.exchange.srgb import srgb

_PARAMETRIC = b"para\0\0\0\0\0\x03\0\0"
_SRGB_NAME, _LINEAR_NAME = ("sRGB built-in".encode("utf-16-be"), "sRGB, linear ".encode("utf-16-be"))


def encode(picture: Picture, colour: CameraColour, *, linear: bool) -> bytes:
    """Return the whole file.

    The value 1 is the camera's range above black, in the frame's own exposure, of the channel that is brightest
    for white. The other channels are clipped at the same level, so that saturated pixels are white. Raises
    InputError for a camera without colours.
    """
    from coupole.appearance.spectra.light import linear_srgb

    if picture.pattern not in PATTERNS:
        raise InputError(f"--for-the-eye: the camera's pattern is {picture.pattern}; it has no colours")
    assert colour.xyz_from_balanced is not None
    signal = picture.pixels.astype(np.float64) - picture.black_dn
    top = float(picture.white_dn - picture.black_dn)
    mosaic = np.rint(np.clip(signal / top, 0.0, 1.0) * 65535).astype(np.uint16)
    channels = demosaiced(mosaic, picture.pattern).astype(np.float64) / 65535.0
    white_balance = np.minimum(channels / colour.neutral(picture.about.get("led")), 1.0)
    rgb = np.clip(linear_srgb(white_balance @ colour.xyz_from_balanced.T), 0.0, 1.0)
    codes = np.rint(65535.0 * (rgb if linear else srgb(rgb))).astype(np.uint16)
    about = {**picture.about, "colour": colour.origin, "linear": linear}
    return tiff_of(codes, about, linear_profile() if linear else srgb_profile())


def tiff_of(codes: NDArray[np.uint16], about: dict[str, Any], profile: bytes) -> bytes:
    """Return the whole file of a picture [h, w, 3], red, green, blue, with an ICC profile; `about` is its
    description."""
    import tifffile

    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        codes,
        photometric="rgb",
        description=json.dumps(about),
        software=f"coupole {coupole.__version__}",
        metadata=None,
        iccprofile=profile,
    )
    return buffer.getvalue()


def srgb_profile() -> bytes:
    """Return the ICC profile of sRGB that LittleCMS makes."""
    from PIL import ImageCms

    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def linear_profile() -> bytes:
    """Return a profile with the same primaries and the identity as curve: (a x + b)^g from d on, below it c x
    (ICC.1, type 3)."""
    profile = bytearray(srgb_profile().replace(_SRGB_NAME, _LINEAR_NAME))
    ones = np.array([1, 1, 0, 1, 0], ">i4") << 16
    place = profile.find(_PARAMETRIC)
    while place >= 0:
        first = place + len(_PARAMETRIC)
        profile[first : first + 20] = ones.astype(">i4").tobytes()
        place = profile.find(_PARAMETRIC, first)
    profile[84:100] = bytes(16)  # the profile's checksum, which is not computed
    return bytes(profile)
