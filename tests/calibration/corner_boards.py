"""Chess boards drawn without any code of the product, with corners that are known to 1e-4 px.

The board is drawn by the distances of its edges on a grid eight times finer than the pixels, in perspective,
spread by a blur of any form, and averaged over each pixel. The corners' places are those of the
blur's centre of gravity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from lazily import lazily
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

signal: Any = lazily("scipy.signal")
Floats = NDArray[np.float64]
FINE = 8
SIDE_PX, CORNERS, SQUARE_PX = 216, 6, 26.0
_FOCAL_PX = 2000.0
BLACK_DN, READ_DN, SHOT_DN = 200.0, 4.0, 0.3
"""Value of black; standard deviation of read noise; variance of shot noise over the value."""


@dataclass(frozen=True)
class Stratum:
    """One kind of picture."""

    name: str
    blur: str = "round 0.7"
    tilt_deg: float = 20.0
    white_dn: float = 3000.0
    pattern: str = "MONO"
    channel: Literal["green", "red", "blue"] = "green"


@dataclass(frozen=True)
class Drawn:
    """A board [H, W] in DN without noise, and where its corners are [36, 2]."""

    values: Floats
    corners: Floats


def blur_kernel(blur: str) -> Floats:
    """[k, k] on the fine grid, its centre of gravity in the middle to within a thousandth of a fine pixel."""
    kind, *sizes = blur.split()
    numbers_px = [float(size) for size in sizes]
    half = int(FINE * (3.0 * max(numbers_px) + 4.0))
    x, y = np.meshgrid(*2 * [np.arange(-half, half + 1) / FINE])
    if kind == "round":
        return _normal(x, y, numbers_px[0], numbers_px[0])
    if kind == "ellipse":
        along, across = _turned(x, y, 35.0)
        return _normal(along, across, numbers_px[0], numbers_px[1])
    if kind == "disk":
        disk = np.clip((numbers_px[0] - np.hypot(x, y)) * FINE + 0.5, 0.0, 1.0)
        return _spread(disk, 0.4, x, y)
    assert kind == "streak"
    # A spot that fades linearly along its length, about its centre of gravity at a third of it.
    length_px = numbers_px[0]
    kernel = np.zeros_like(x)
    for place in (np.arange(400) + 0.5) / 400:
        away = length_px * (place - 1.0 / 3.0)
        along, across = _turned(x, y, 35.0)
        kernel += (1.0 - place) * _normal(along - away, across, 0.6, 0.6)
    return np.asarray(kernel / kernel.sum())


def _turned(x: Floats, y: Floats, angle_deg: float) -> tuple[Floats, Floats]:
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return cos * x + sin * y, cos * y - sin * x


def _normal(x: Floats, y: Floats, sigma_x: float, sigma_y: float) -> Floats:
    kernel = np.exp(-0.5 * ((x / sigma_x) ** 2 + (y / sigma_y) ** 2))
    return np.asarray(kernel / kernel.sum())


def _spread(kernel: Floats, sigma: float, x: Floats, y: Floats) -> Floats:
    spread = signal.fftconvolve(kernel, _normal(x, y, sigma, sigma), mode="same")
    return np.asarray(spread / spread.sum())


def draw(stratum: Stratum, seed: int) -> Drawn:
    """A board of 6 x 6 inner corners, turned, tilted and shifted at random."""
    random = np.random.default_rng(seed)
    roll, about = random.uniform(0.0, 360.0, 2)
    turn = Rotation.from_euler("ZXZ", [about, stratum.tilt_deg, roll], degrees=True).as_matrix()
    middle = np.append(0.5 * (SIDE_PX - 1) + random.uniform(-0.5, 0.5, 2), 1.0)
    distance = _FOCAL_PX / SQUARE_PX
    to_pixels = np.array([[_FOCAL_PX, 0.0, middle[0]], [0.0, _FOCAL_PX, middle[1]], [0.0, 0.0, 1.0]])
    board_to_image = to_pixels @ np.column_stack([turn[:, 0], turn[:, 1], [0.0, 0.0, distance]])
    fine = (np.arange(SIDE_PX * FINE) + 0.5) / FINE - 0.5
    x, y = np.meshgrid(fine, fine)
    board = np.linalg.inv(board_to_image) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    u, v = (board[:2] / board[2]).reshape(2, *x.shape)
    light = _checks(u) * _checks(v)
    squares = 0.5 * (CORNERS + 1)
    light = np.where((np.abs(u) > squares) | (np.abs(v) > squares), 1.0, light)
    light = 0.5 + 0.5 * np.asarray(signal.fftconvolve(light, blur_kernel(stratum.blur), mode="same"))
    pixels = light.reshape(SIDE_PX, FINE, SIDE_PX, FINE).mean(axis=(1, 3))
    numbers = np.arange(CORNERS) - 0.5 * (CORNERS - 1)
    grid = np.stack([*np.meshgrid(numbers, numbers), np.ones((CORNERS, CORNERS))], axis=-1).reshape(-1, 3)
    corners = grid @ board_to_image.T
    return Drawn(BLACK_DN + (stratum.white_dn - BLACK_DN) * pixels, corners[:, :2] / corners[:, 2:])


def _checks(place: Floats) -> Floats:
    """-1 and 1 in turn, with an edge wherever a board's line passes; soft over a fine pixel."""
    nearest = np.rint(place - 0.5) + 0.5
    down, right = np.gradient(place)
    apart = (place - nearest) / np.hypot(down, right)
    sign = np.where(np.rint(place - 0.5) % 2 == 0, 1.0, -1.0)
    return np.asarray(sign * np.clip(2.0 * apart, -1.0, 1.0))


def with_noise(values: Floats, seed: int) -> Floats:
    """In whole DN, with read and shot noise."""
    noise = np.random.default_rng(seed).normal(size=values.shape) * np.sqrt(READ_DN**2 + SHOT_DN * values)
    return np.rint(values + noise)
