"""relight's planes for browsers: `info.json` and JPEGs of three planes each, as OpenLIME reads them.

A plane's value is (code / 255 - bias) scale. The JPEGs store red, green and blue directly, which Adobe's marker
states: the channels are coefficients, and a conversion to luminance and chroma would mix them.
"""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from coupole.exchange.rti import light_functions
from coupole.exchange.rti.lit_views import LitView, Picture, Said
from coupole.exchange.rti.plane_codes import PlaneCode, eight_bits, of_principal_parts, of_terms
from coupole.storage.durable import write_synced

BASES = ("bilinear", "rbf", "ptm", "hsh")
PLANES = (27, 18)
"""Allowed numbers of principal components for `bilinear` and `rbf`."""
QUALITY = 95
_MOST_SAMPLES = 30_000_000
"""Greatest number of pixel values from which principal components are computed."""


def write(view: LitView, folder: Path, basis: str, planes: int, say: Said) -> tuple[list[Path], float]:
    """Write a view. Return the files, and their rms error against the view's own pictures, in steps of 8 bits.

    Raises InputError if there are too few lights for the basis.
    """
    some = view.some_pixels(max(1000, _MOST_SAMPLES // (3 * len(view))))
    samples = view.samples(some, say)
    code = _code(view, samples, basis, planes)
    values = code.planes_of(view, say)
    low, high = values.min(axis=(0, 1)), values.max(axis=(0, 1))
    scale = np.maximum(high - low, 1e-6).astype(np.float64)
    bias = -low / scale
    paths, decodings = [], []
    for number in range(values.shape[2] // 3):
        channels = slice(3 * number, 3 * number + 3)
        content = rgb_jpeg(eight_bits(values[..., channels], low[channels], scale[channels]))
        decodings.append(np.asarray(Image.open(io.BytesIO(content))).reshape(-1, 3)[some].copy())
        paths.append(folder / f"plane_{number}.jpg")
        write_synced(paths[-1], content)
    misses_dn = code.misses_dn(samples, (np.concatenate(decodings, axis=1) / 255.0 - bias) * scale)
    material = {"scale": scale.tolist(), "bias": bias.tolist()}
    if code.ranges:
        material["range"] = list(code.ranges)
    about = {
        "width": view.size_px[0],
        "height": view.size_px[1],
        "format": "jpg",
        "quality": QUALITY,
        **({"pixelSizeInMM": view.pixel_mm} if view.pixel_mm else {}),
        **code.about,
        "materials": [material],
        "origin": view.origin,
        "misses_dn": round(misses_dn, 2),
    }
    write_synced(folder / "info.json", json.dumps(about) + "\n")
    return [*paths, folder / "info.json"], misses_dn


def _code(view: LitView, samples: Picture, basis: str, planes: int) -> PlaneCode:
    match basis:
        case "ptm":
            return of_terms(light_functions.ptm(view.directions), basis)
        case "hsh":
            return of_terms(light_functions.hsh(view.directions), basis)
        case _:
            return of_principal_parts(samples, view.directions, basis, planes)


def rgb_jpeg(codes: NDArray[np.uint8]) -> bytes:
    """JPEG of [h, w, 3] without conversion of colours, with full resolution of each channel."""
    content = io.BytesIO()
    Image.fromarray(codes).save(content, "JPEG", quality=QUALITY, subsampling=0, keep_rgb=True)
    return content.getvalue()
