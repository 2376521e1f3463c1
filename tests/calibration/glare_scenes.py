"""Pictures of black traps in a white card, and of other scenes, with the glare of the simulated camera and the
sensor of the tests: nothing that calibration shares."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from light_runs import Taken, write_light_run
from light_synthesis import Array, TrueSensor

from sim.optics.glare import Glare

PX_PER_MM = 2.0
SIZE_PX = (384, 288)
SHAPE = (SIZE_PX[1], SIZE_PX[0])
SENSOR = TrueSensor(SHAPE, prnu=0.005, dark_e_per_s=30.0)
CHANNELS = np.array([[1, 2], [0, 1]])
"""Of the Bayer pattern GBRG."""
EXPOSURE_US = 8000
WHITE_E = 0.6 * 4031 * 3.2
_TRAPS_MM = tuple(
    (x, y, (12, 28, 12, 20, 12, 20, 12, 28, 12)[3 * row + column])
    for row, y in enumerate((-46, 0, 46))
    for column, x in enumerate((-64, 0, 64))
)
"""Middle from that of the card, and side."""
_VIEWS_MM = ((0, 0), (18, 12), (-18, 6), (6, -12), (100, 0), (-100, 0), (0, 78), (0, -78))
"""Shift of the camera over the card; in the last four views it ends near the middle of the picture."""


def card_views(trap_share: float = 3e-4) -> list[Array]:
    """[h, w] light of a card of 240 x 180 mm in each view over white, without glare."""
    x_mm, y_mm = _places_mm()
    falloff = 1.0 - 0.3 * (x_mm**2 + y_mm**2) / (96.0**2 + 72.0**2)
    views = []
    for camera_x_mm, camera_y_mm in _VIEWS_MM:
        x, y = x_mm + camera_x_mm, y_mm + camera_y_mm
        picture = np.where((np.abs(x) < 120) & (np.abs(y) < 90), 1.0, 0.1)
        for trap_x, trap_y, side in _TRAPS_MM:
            picture[np.maximum(np.abs(x - trap_x), np.abs(y - trap_y)) < side / 2] = trap_share
        views.append(picture * falloff)
    return views


def black_beside_white() -> dict[str, Array]:
    """[h, w] light over white of scenes that no calibration has seen; black is 0."""
    x, y = _places_mm()
    away = np.hypot(x + 20, y - 6)
    disk = np.where(away < 50, 1.0, 0.05)
    disk[away < 12] = 0.0
    patch = np.full(SHAPE, 0.3)
    patch[(np.abs(x) < 50) & (np.abs(y + 10) < 35)] = 1.0
    patch[(np.abs(x + 10) < 15) & (np.abs(y + 8) < 12)] = 0.0
    return {"disk": disk, "half": np.where(x < -5, 0.0, 1.0), "patch": patch}


def _places_mm() -> tuple[Array, Array]:
    """x and y [h, w] of the pixels on the card below the camera."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    return (columns - (SIZE_PX[0] - 1) / 2) / PX_PER_MM, (rows - (SIZE_PX[1] - 1) / 2) / PX_PER_MM


def with_glare(light: Array, glare: Glare | None) -> Array:
    """[h, w] mean electrons of light over white."""
    sharp = (WHITE_E * light).astype(np.float32)
    return np.asarray(sharp if glare is None else glare.over(sharp, CHANNELS), np.float64)


def card_run(
    folder: Path, glare: Glare | None, seed: int = 1, *, views: int | None = None, scale: float = 1.0
) -> Path:
    """A run of the card's views with dark frames, noise and all; `scale` is that of the light."""
    random = np.random.default_rng([seed, 34])
    frames = []
    for number, light in enumerate(card_views()[:views]):
        light_e = scale * with_glare(light, glare)
        shots = [(f"panel1/e0/r{i}" if i else "panel1/e0", light_e) for i in range(3)]
        shots += [(f"dark{i}/e0", np.zeros(SHAPE)) for i in range(4)]
        frames += [
            Taken(f"v{number}/{shot}", EXPOSURE_US, np.eye(4), SENSOR.frame(mean_e, EXPOSURE_US * 1e-6, random))
            for shot, mean_e in shots
        ]
    return write_light_run(folder, frames)
