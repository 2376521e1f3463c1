"""Measured frames of a result of runs, which a page shows beside the fit's prediction for the same LED.

A frame is projected on the object: for each place the page computes the pixel by a polynomial, which is fitted
here to the places that the view's pixels see.
"""

from __future__ import annotations

import math
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.exchange.look.look_blocks import Block, block_of
from coupole.exchange.srgb import srgb
from coupole.geometry import apply
from coupole.reflectance.new_light.pictured_surface import Surface, surface_of_view
from coupole.reflectance.run_result import FRAMES, RunResult, ViewSamples

Floats = NDArray[np.float64]

MOST_PX = 640
"""Greatest length of a frame's longer side."""
DEGREE = 5
_MOST_PLACES = 20_000
_WHITE_QUANTILE = 0.999


def frames_of_view(
    result: RunResult, view: ViewSamples, support_from_base: Floats
) -> tuple[dict[str, Any], list[Block]] | None:
    """Return the page's facts of a view and its frames, and the frames' pictures; None if the view has none."""
    path = result.folder / FRAMES / view.path.name
    if not path.exists():
        return None
    with h5py.File(path, "r") as file:
        shares, leds = file["share"][()].astype(np.float32), file["leds"][()]
    surface = surface_of_view(result, view)
    axes, lens = _lens(surface)
    size_px = np.array(shares.shape[2:0:-1])
    step = math.ceil(size_px.max() / MOST_PX)
    of_texture = size_px / (step * np.ceil(size_px / step))
    turn = support_from_base[:3, :3]
    frames, blocks = [], []
    for share, led in zip(shares, leds, strict=True):
        row = int(np.flatnonzero(view.leds == led)[0])
        if not np.isfinite(share).any():
            continue
        small = block_means(share, step)
        picture, peak = _srgb_codes(small if small.shape[2] == 3 else np.repeat(small, 3, axis=2))
        blocks.append(block_of(f"frame-{view.path.stem}-{led}", picture))
        full_scale = np.broadcast_to(np.nan_to_num(view.full_scales[row]), 3) / math.pi
        frames.append(
            {
                "led": int(led),
                "block": blocks[-1].name,
                "size_px": [picture.shape[1], picture.shape[0]],
                "peak": peak,
                "at_mm": apply(support_from_base, view.led_mm[row]).tolist(),
                "axis": (turn @ view.led_normals[row]).tolist(),
                "strength": full_scale.tolist(),
            }
        )
    about = {
        "name": view.view,
        "camera_mm": apply(support_from_base, surface.camera_mm).tolist(),
        "axes": (axes @ turn.T).tolist(),
        "lens": (lens * of_texture).tolist(),
        "frames": frames,
    }
    return (about, blocks) if frames else None


def _lens(surface: Surface) -> tuple[Floats, Floats]:
    """[3, 3] rows: axes of the camera, the last forward; and [21, 2] coefficients of x^i y^j (all j for one i,
    then the next i).

    They give column and row, as shares of the picture, from a direction's x and y where its z is 1.
    """
    rows, columns = np.nonzero(surface.triangle_of_pixel >= 0)
    some = slice(None, None, max(1, len(rows) // _MOST_PLACES))
    rows, columns = rows[some], columns[some]
    ways = surface.places_mm[rows, columns].astype(np.float64) - surface.camera_mm
    forward = ways.mean(axis=0) / np.linalg.norm(ways.mean(axis=0))
    right = np.cross([0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [1.0, 0.0, 0.0], forward)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    local = ways @ axes.T
    x, y = (local[:, :2] / local[:, 2:]).T
    design = np.stack([x**i * y**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=1)
    scale = np.abs(design).max(axis=0)
    height, width = surface.triangle_of_pixel.shape
    shares = np.stack([(columns + 0.5) / width, (rows + 0.5) / height], axis=1)
    coefficients = np.linalg.lstsq(design / scale, shares, rcond=None)[0]
    return axes, coefficients / scale[:, None]


def block_means(share: NDArray[np.float32], step: int) -> NDArray[np.float64]:
    """Means over step x step pixels with values in all channels; NaN where none has. The last row and column are
    means over the remaining pixels."""
    height, width = share.shape[:2]
    is_finite = np.isfinite(share).all(axis=2, keepdims=True)
    sums, counts = (
        np.add.reduceat(
            np.add.reduceat(values, range(0, height, step), axis=0, dtype=np.float64),
            range(0, width, step),
            axis=1,
        )
        for values in (np.where(is_finite, share, 0.0), is_finite)
    )
    return np.where(counts > 0, sums / np.maximum(counts, 1.0), np.nan)


def _srgb_codes(small: Floats) -> tuple[NDArray[np.uint8], float]:
    """[h, w, 3] codes in sRGB steps, from 1 to the returned peak; 0 where there is no value."""
    is_finite = np.asarray(np.isfinite(small).all(axis=2))
    peak = max(float(np.quantile(small[is_finite], _WHITE_QUANTILE)) if is_finite.any() else 1.0, 1e-9)
    encoding = srgb(np.where(is_finite[..., None], small, 0.0) / peak)
    return np.where(is_finite[..., None], 1.0 + np.rint(254.0 * encoding), 0.0).astype(np.uint8), peak
