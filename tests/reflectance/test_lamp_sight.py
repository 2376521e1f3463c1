"""Shadows, penumbrae and irradiance on triangles, held against a ball's shadow and Lambert's formula."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from test_seen_surface import sheet

from coupole.calibration.light.irradiance import irradiance_per_flux
from coupole.calibration.light.tile_views import Positions
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.extraction.lamp_sight import (
    Facets,
    lamp_codes,
    lit_on,
    neighbours_of,
)
from coupole.reflectance.extraction.sample_codes import AWAY, PENUMBRA, REACHED, SHADED

BALL_MM, RADIUS_MM = np.array([0.0, 0.0, 60.0]), 12.0
LEDS_MM = np.array([[0.0, 0.0, 1000.0], [700.0, 0.0, 700.0], [-300.0, 600.0, 800.0], [0.0, 0.0, -500.0]])


def scene_with_ball() -> tuple[np.ndarray, np.ndarray]:
    """Corners of a flat sheet, then of a ball over it; the sheet's rows of vertices."""
    flat = sheet(60, 160.0)
    flat[..., 2] = 0.0
    u, v = np.meshgrid(np.linspace(0, np.pi, 65), np.linspace(0, 2 * np.pi, 129), indexing="ij")
    points = BALL_MM + RADIUS_MM * np.stack([np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), np.cos(u)], axis=-1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    ball = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3)
    return flat, ball


def distance_to_axis_mm(points: np.ndarray, led: np.ndarray) -> np.ndarray:
    """Of the ball's centre from the segments between points [n, 3] and an LED."""
    way = led - points
    share = np.clip(np.sum((BALL_MM - points) * way, axis=1) / np.sum(way**2, axis=1), 0, 1)
    return np.linalg.norm(points + share[:, None] * way - BALL_MM, axis=1)


def test_shadow_and_penumbra_are_where_the_ball_throws_them() -> None:
    flat, ball = scene_with_ball()
    centres, normals = flat.mean(axis=1), np.tile([0.0, 0.0, 1.0], (len(flat), 1))
    _, rows = np.unique(flat.reshape(-1, 3).round(6), axis=0, return_inverse=True)
    sides = neighbours_of(rows.reshape(-1, 3).astype(np.uint32))
    towards = -LEDS_MM / np.linalg.norm(LEDS_MM, axis=1, keepdims=True)
    leds = Positions(np.arange(4), LEDS_MM, towards)
    mesh, facets = PacketMesh(np.concatenate([flat, ball])), Facets(centres, normals, sides)
    with ThreadPoolExecutor(2) as pool:
        codes = lamp_codes(mesh, facets, leds, pool).T
    assert (codes[:, 3] == AWAY).all()  # below the sheet
    for led in range(3):
        off_mm = distance_to_axis_mm(centres, LEDS_MM[led])
        half_mm = 0.5 * 7.0 * np.sqrt(2) * 60.0 / np.linalg.norm(LEDS_MM[led])  # the LED's corner, at the ball
        assert (codes[off_mm < RADIUS_MM - 0.1, led] == SHADED).all()
        assert (codes[off_mm > RADIUS_MM + 4.0, led] == REACHED).all()
        lit = codes[:, led] == REACHED
        assert off_mm[lit].min() > RADIUS_MM - 0.1 + 0.5 * half_mm  # none lies in the penumbra
        assert (codes[:, led] == PENUMBRA).any()


def test_irradiance_is_that_of_the_square() -> None:
    random = np.random.default_rng(1)
    points = random.normal(0, 60, (40, 3))
    leds = 1000.0 * np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, -0.8, 0.6]])
    axes = -leds / 1000.0 + random.normal(0, 0.1, leds.shape)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for paper in (False, True):
        found = lit_on(points, leds, axes, paper)
        for led in range(3):
            facing = leds[led] - points
            facing /= np.linalg.norm(facing, axis=1, keepdims=True)
            emission = "paper" if paper else "lambertian"
            square = irradiance_per_flux(points, facing, leds[led], axes[led], emission=emission)
            np.testing.assert_allclose(found[:, led], square, rtol=5e-5)


def test_neighbours_share_a_side() -> None:
    triangles = np.array([[0, 1, 2], [2, 1, 3], [3, 4, 2]], np.uint32)
    assert neighbours_of(triangles).tolist() == [[-1, 1, -1], [0, -1, 2], [-1, -1, 1]]
