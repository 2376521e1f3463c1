"""The MERL database's format: 90 x 90 x 180 values of f by half angle, difference angle and its azimuth (Matusik
and others, A data-driven reflectance model, 2003; layout of the database's reader)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from coupole.exchange.of_results.material_tables import Material, materials_of
from coupole.exchange.of_results.measured_surface import Floats, MeasuredSurface
from coupole.storage.durable import write_synced

SIZE = (90, 90, 180)
"""Number of steps of theta_h, theta_d and phi_d. phi_d covers 180 degrees, because light and viewer may be
exchanged."""
SCALES = (1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0)
"""Factors by which a reader multiplies red, green and blue."""


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """Write `NAME.binary` for each material; the value for directions below the surface is -1."""
    paths = []
    for material in materials_of(surface):
        paths.append(folder / f"{material.name}.binary")
        write_synced(paths[-1], encode(material))
    return paths


def encode(material: Material) -> bytes:
    return encode_reflectance(material.reflectance)


def encode_reflectance(reflectance: Callable[[Floats, Floats], Floats]) -> bytes:
    """Encode a function of unit directions [n, 3] to light and viewer, which returns 1/sr [n, 3], by its values in
    the middle of each step."""
    theta_h = 0.5 * np.pi * ((np.arange(SIZE[0]) + 0.5) / SIZE[0]) ** 2
    theta_d = 0.5 * np.pi * (np.arange(SIZE[1]) + 0.5) / SIZE[1]
    phi_d = np.pi * (np.arange(SIZE[2]) + 0.5) / SIZE[2]
    h, d, phi = (angle.ravel() for angle in np.meshgrid(theta_h, theta_d, phi_d, indexing="ij"))
    # The light in a frame whose pole is the half vector, turned about y to the half vector's direction.
    about_half = np.stack([np.sin(d) * np.cos(phi), np.sin(d) * np.sin(phi), np.cos(d)], axis=1)
    ways_in, ways_out = about_half.copy(), about_half * [-1.0, -1.0, 1.0]
    for ways in (ways_in, ways_out):
        x, z = ways[:, 0].copy(), ways[:, 2].copy()
        ways[:, 0], ways[:, 2] = x * np.cos(h) + z * np.sin(h), z * np.cos(h) - x * np.sin(h)
    values = np.array(reflectance(ways_in, ways_out))
    values[(ways_in[:, 2] <= 0.0) | (ways_out[:, 2] <= 0.0)] = -1.0
    planes = np.where(values < 0.0, values, values / SCALES)
    return np.array(SIZE, "<i4").tobytes() + planes.T.astype("<f8").tobytes()
