"""Domes and white tiles of the tests' own: small emitters added up point by point, Minnaert's law written out.

No code of the processing's computes the light here.
"""

from __future__ import annotations

import numpy as np
from light_synthesis import Array

from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_views import Positions, TileView

TILE = Tile(reflectance=0.99, u_reflectance=0.005, minnaert=1.1, u_minnaert=0.03, u_tilt_deg=0.2)


def turned(x_deg: float, y_deg: float, z_deg: float = 0.0) -> Array:
    a, b, c = np.radians([x_deg, y_deg, z_deg])
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return np.asarray(z @ y @ x)


def dome(count: int, random: np.random.Generator) -> Positions:
    """LEDs over the upper half of a sphere of 1 m, looking to its middle."""
    up = random.uniform(0.25, 0.98, count)
    turn = random.uniform(0, 2 * np.pi, count)
    out = np.sqrt(1 - up**2)
    centres = 1000 * np.stack([out * np.cos(turn), out * np.sin(turn), up], axis=1)
    return Positions(np.arange(count), centres, -centres / 1000)


def summed_irradiance(point: Array, normal: Array, centres: Array, normals: Array) -> Array:
    """E/Phi in m^-2 by 8 x 8 small Lambertian emitters on each LED."""
    total = np.zeros(len(centres))
    for k, (centre, axis) in enumerate(zip(centres, normals, strict=True)):
        u = np.linalg.svd(axis[None])[2][1:]
        a, b = np.meshgrid(*[(np.arange(8) + 0.5) / 8 * 7 - 3.5] * 2)
        away = point - (centre + a.ravel()[:, None] * u[0] + b.ravel()[:, None] * u[1])
        far = np.linalg.norm(away, axis=1)
        total[k] = np.mean((away @ axis) * -(away @ normal) / far**4) / np.pi * 1e6
    return total


def views_of(
    positions: Positions,
    power: Array,
    random: np.random.Generator,
    *,
    tilts_deg: tuple[tuple[float, float], ...] = ((0.0, 0.0),),
    height_mm: float = 0.0,
    truth: Tile = TILE,
    noise: float = 1e-3,
    cameras: int = 2,
) -> list[TileView]:
    """What cameras see of the tile in each of its places; `tilts_deg` and `height_mm` tell how it lies otherwise
    than described."""
    found = []
    for place, tilt in enumerate(tilts_deg):
        pose = np.eye(4)
        pose[:3, :3] = turned(0, 0, 90 * place)
        normal = pose[:3, :3] @ turned(*tilt) @ (0, 0, 1)
        a, b = np.meshgrid(*[np.array([-15.0, 0.0, 15.0])] * 2)
        points = np.stack([a.ravel(), b.ravel(), np.zeros(9)], axis=1)
        for camera in range(cameras):
            eye = np.array([120.0 * (camera - 0.5), 40.0, 320.0])
            there = points + (points - eye) * (height_mm / (points - eye)[:, 2:])
            leds = positions.centres_mm, positions.normals
            lit = np.stack([summed_irradiance(point, normal, *leds) for point in there], 1)
            towards = positions.centres_mm[:, None] - there
            cos_in = towards @ normal / np.linalg.norm(towards, axis=2)
            cos_out = (eye - there) @ normal / np.linalg.norm(eye - there, axis=1)
            k = truth.minnaert
            f = truth.reflectance * (k + 1) / 2 / np.pi * (cos_in * cos_out) ** (k - 1)
            signal = f * lit * power[:, None]
            u = noise * signal
            seen = signal + u * random.standard_normal(signal.shape)
            saturated = np.zeros(len(power), bool)
            name = f"p{place}c{camera}"
            found.append(TileView(name, place, pose, points, eye, positions.ids, seen, u, saturated))
    return found


def powers(count: int, random: np.random.Generator) -> Array:
    return np.asarray(1e4 * np.exp(0.04 * random.standard_normal(count)))
