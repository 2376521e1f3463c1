"""Tables of the MERL database, from their layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coupole.exchange.of_results.merl import SCALES, SIZE
from export_readers.lit_models import unit

MOST_LOST = 0.02


def evaluate(path: Path, light: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Return the nearest value, as the database's own reader does."""
    table = np.frombuffer(path.read_bytes(), "<f8", offset=12).reshape(3, *SIZE)
    half = unit(light + camera)
    theta_h, phi_h = np.arccos(half[:, 2]), np.arctan2(half[:, 1], half[:, 0])
    x = np.cos(phi_h) * light[:, 0] + np.sin(phi_h) * light[:, 1]
    y = -np.sin(phi_h) * light[:, 0] + np.cos(phi_h) * light[:, 1]
    z = np.cos(theta_h) * light[:, 2] + np.sin(theta_h) * x
    x = np.cos(theta_h) * x - np.sin(theta_h) * light[:, 2]
    theta_d, phi_d = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x) % np.pi
    at = (np.sqrt(theta_h / (np.pi / 2)) * 90, theta_d / (np.pi / 2) * 90, phi_d / np.pi * 180)
    rows = tuple(np.minimum(values.astype(int), most - 1) for values, most in zip(at, SIZE, strict=True))
    f = np.stack([table[channel][rows] * SCALES[channel] for channel in range(3)], axis=1)
    return np.asarray(np.pi * f * light[:, 2:])
