"""Triangles under near lights, of a material that no fit has: Lambert with Cook and Torrance's lobe."""

from __future__ import annotations

import numpy as np

from coupole.reflectance.triangle_fit import TriangleSamples

KD, KS, SLOPE = np.array([0.12, 0.1, 0.06]), 0.06, 0.3
COUNT, TURNED_DEG = 60, 4.0


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def beckmann(normal: np.ndarray, light: np.ndarray, view: np.ndarray) -> np.ndarray:
    """[..., 3] reflectance times n l, with Cook and Torrance's masking."""
    half = unit(light + view)
    nl, nv, nh = (np.maximum(np.sum(normal * v, axis=-1), 1e-6) for v in (light, view, half))
    vh = np.sum(view * half, axis=-1)
    d = np.exp((1 - 1 / nh**2) / SLOPE**2) / (np.pi * SLOPE**2 * nh**4)
    g = np.minimum(1.0, np.minimum(2 * nh * nv / vh, 2 * nh * nl / vh))
    return nl[..., None] * (KD + (KS * d * g / (4 * nl * nv))[..., None])


def noisy_case(views: int, noise: float = 0.01, leds: int = 120) -> tuple[TriangleSamples, np.ndarray]:
    """Samples of triangles whose mesh has turned normals, and the true normals."""
    random = np.random.default_rng(5)
    phi, theta = random.uniform(0, 2 * np.pi, leds), np.arccos(random.uniform(0.3, 1, leds))
    places = 1000 * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    centres = np.concatenate([random.uniform(-60, 60, (COUNT, 2)), random.uniform(0, 20, (COUNT, 1))], axis=1)
    truth = unit(np.concatenate([random.normal(0, 0.2, (COUNT, 2)), np.ones((COUNT, 1))], axis=1))
    cameras = np.array([[0.0, 0.0, 400.0], [200.0, 0.0, 350.0]])[:views]
    view_of = np.repeat(np.arange(views), leds)
    led_mm = np.tile(places, (views, 1))
    light = unit(led_mm[None] - centres[:, None])
    view = unit(cameras[view_of][None] - centres[:, None])
    values = beckmann(truth[:, None], light, view)
    values[np.sum(truth[:, None] * light, axis=-1) < 0.05] = np.nan
    values *= random.normal(1.0, noise, values.shape)
    turn = np.radians(TURNED_DEG) / np.sqrt(2)
    mesh = unit(truth + turn * random.normal(size=truth.shape))
    areas = np.full(COUNT, 0.05)
    return TriangleSamples(values.astype(np.float32), led_mm, view_of, cameras, centres, mesh, areas), truth


def off_deg(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.sum(found * truth, axis=1), -1, 1)))
