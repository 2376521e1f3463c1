"""RAW frames of things that glow or are printed flat: supersampled, blurred, mosaicked, noisy, clipped."""

from __future__ import annotations

import numpy as np
from synthesis import Array

BLACK_DN, WHITE_DN = 64, 4095
COLOURS = {"R": 0.5, "G": 1.0, "B": 0.6}
_FINE = 5


def covered(shape: tuple[int, int], corners_px: Array) -> Array:
    """Share [H, W] of each pixel that a convex polygon [k, 2] covers (25 points in each)."""
    share = np.zeros(shape)
    low = np.maximum(np.floor(corners_px.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(corners_px.max(axis=0)).astype(int) + 2, shape[::-1])
    if (low >= high).any():
        return share
    steps = (np.arange(_FINE) - (_FINE - 1) / 2) / _FINE
    y = (np.arange(low[1], high[1])[:, None] + steps).ravel()[:, None]
    x = (np.arange(low[0], high[0])[:, None] + steps).ravel()[None]
    edges = np.roll(corners_px, -1, axis=0) - corners_px
    turn = np.sign(edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0])
    inside = np.ones(np.broadcast_shapes(x.shape, y.shape), bool)
    for corner, edge in zip(corners_px, edges, strict=True):
        inside &= turn * (edge[0] * (y - corner[1]) - edge[1] * (x - corner[0])) >= 0
    fine = inside.reshape(high[1] - low[1], _FINE, high[0] - low[0], _FINE)
    share[low[1] : high[1], low[0] : high[0]] = fine.mean(axis=(1, 3))
    return share


def defocused(picture: Array, diameter_px: float) -> Array:
    """Convolved with an even disk."""
    if diameter_px < 0.5:
        return picture
    reach = int(np.ceil(diameter_px / 2)) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disk = np.clip(diameter_px / 2 + 0.5 - np.hypot(x, y), 0.0, 1.0)
    from scipy.signal import fftconvolve

    return np.maximum(fftconvolve(picture, disk / disk.sum(), mode="same"), 0.0)


def raw(
    picture: Array, random: np.random.Generator, *, pattern: str = "GBRG", scale_dn: float = 3000.0
) -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    """A picture (1: `scale_dn` in green) as the sensor gives it: colours of their own, shot and read noise."""
    signal = picture * scale_dn
    for place, letter in enumerate(pattern if pattern != "MONO" else ""):
        signal[place // 2 :: 2, place % 2 :: 2] *= COLOURS[letter]
    noisy = signal + random.normal(size=picture.shape) * np.sqrt(9.0 + 0.3 * signal)
    return np.clip(np.rint(BLACK_DN + noisy), 0, WHITE_DN).astype(np.uint16)


def square(centre_px: Array, side_px: float, turn_deg: float = 20.0, squeeze: float = 0.8) -> Array:
    """Corners [4, 2] of a square that is seen under an angle."""
    turn = np.radians(turn_deg)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-squeeze * np.sin(turn), squeeze * np.cos(turn)]])
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float) * side_px / 2
    return np.asarray(centre_px) + corners @ axes
