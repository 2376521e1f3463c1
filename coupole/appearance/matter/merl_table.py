"""Measured materials of the MERL database, or files of its format: 90 x 90 x 180 values by half angle, difference
angle and its azimuth (Matusik and others, A data-driven reflectance model, 2003).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from coupole.appearance.matter.brdf import Brdf
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

_STEPS = (90, 90, 180)
_BYTES = 12 + 3 * 8 * 90 * 90 * 180
_SCALES = (1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0)
"""Scales of the database: a value is the stored number times the scale of its colour."""


def read_merl(path: Path) -> Brdf:
    """[..., 3] per steradian, linear between the middles of steps. Below the horizon nothing is stored; there the
    last value above it is used. Raises InputError for another kind of file."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read the material: {error.strerror}") from error
    if len(data) != _BYTES or tuple(np.frombuffer(data, "<i4", 3)) != _STEPS:
        raise InputError(
            f"{path}: expected a material of the MERL database, {_BYTES} bytes that begin with 90, 90, 180; found "
            f"{len(data)} bytes"
        )
    planes = np.frombuffer(data, "<f8", offset=12).reshape(3, *_STEPS) * np.reshape(_SCALES, (3, 1, 1, 1))
    if not np.isfinite(planes).all():
        raise InputError(f"{path}: contains values that are not numbers; fetch or export it anew")
    for step in range(1, _STEPS[1]):
        planes[:, :, step] = np.where(planes[:, :, step] < 0.0, planes[:, :, step - 1], planes[:, :, step])
    around = np.concatenate([planes[..., -1:], np.maximum(planes, 0.0), planes[..., :1]], axis=3)
    return partial(_looked_up, planes=np.maximum(around, 0.0))


def _looked_up(wi: Array, wo: Array, *, planes: NDArray[np.float64]) -> Array:
    half = wi + wo
    half = half / np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
    cosine_h, sine_h = half[..., 2], np.hypot(half[..., 0], half[..., 1])
    is_tilted = sine_h > 1e-9
    cosine_p = np.where(is_tilted, half[..., 0] / np.maximum(sine_h, 1e-12), 1.0)
    sine_p = np.where(is_tilted, half[..., 1] / np.maximum(sine_h, 1e-12), 0.0)
    along = cosine_p * wi[..., 0] + sine_p * wi[..., 1]
    y = cosine_p * wi[..., 1] - sine_p * wi[..., 0]
    x = cosine_h * along - sine_h * wi[..., 2]
    z = sine_h * along + cosine_h * wi[..., 2]
    at = (
        np.sqrt(np.arctan2(sine_h, cosine_h) / (0.5 * np.pi)) * _STEPS[0] - 0.5,
        np.arctan2(np.hypot(x, y), z) / (0.5 * np.pi) * _STEPS[1] - 0.5,
        (np.arctan2(y, x) % np.pi) / np.pi * _STEPS[2] + 0.5,  # one step is repeated before the first
    )
    places = np.stack(np.broadcast_arrays(*at))
    values = [map_coordinates(plane, places, order=1, mode="nearest") for plane in planes]
    above = (wi[..., 2] > 0.0) & (wo[..., 2] > 0.0)
    return np.where(above[..., None], np.stack(values, axis=-1), 0.0)
