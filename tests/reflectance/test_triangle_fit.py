"""Normals and materials of triangles under near lights, from samples of a material that the fit does not have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coupole.reflectance.triangle_fit import TriangleSamples, fit_triangles, model_values, prior_stiffness

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


def noisy_case(views: int, noise: float = 0.01) -> tuple[TriangleSamples, np.ndarray]:
    """Samples of triangles whose mesh has turned normals, and the true normals."""
    random = np.random.default_rng(5)
    phi, theta = random.uniform(0, 2 * np.pi, 120), np.arccos(random.uniform(0.3, 1, 120))
    leds = 1000 * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    centres = np.concatenate([random.uniform(-60, 60, (COUNT, 2)), random.uniform(0, 20, (COUNT, 1))], axis=1)
    truth = unit(np.concatenate([random.normal(0, 0.2, (COUNT, 2)), np.ones((COUNT, 1))], axis=1))
    cameras = np.array([[0.0, 0.0, 400.0], [200.0, 0.0, 350.0]])[:views]
    view_of = np.repeat(np.arange(views), len(leds))
    led_mm = np.tile(leds, (views, 1))
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


@pytest.mark.parametrize("views", [1, 2])
def test_normals_come_nearer_to_the_truth_than_the_mesh(views: int) -> None:
    samples, truth = noisy_case(views)
    held = np.zeros(len(samples.led_mm), bool)
    held[::10] = True
    fitted = fit_triangles(samples, ~held, 30.0)
    rigid = fit_triangles(samples, ~held, None)
    np.testing.assert_allclose(rigid.normals, samples.normals)
    assert np.median(off_deg(samples.normals, truth)) > 2.5
    assert np.median(off_deg(fitted.normals, truth)) < 1.0
    assert off_deg(fitted.normals, truth).max() < 2.0

    def mae(materials: object) -> float:
        off = model_values(samples, materials)[:, held] - samples.values[:, held]  # type: ignore[arg-type]
        return float(np.nanmean(np.abs(off)))

    assert mae(fitted) < 0.5 * mae(rigid)


def test_a_camera_that_does_not_see_a_triangle_forbids_it_no_normal() -> None:
    samples, truth = noisy_case(1)
    behind = np.concatenate([samples.cameras_mm, [[0.0, 0.0, -500.0]]])
    some = np.ones(len(samples.led_mm), bool)
    fitted = fit_triangles(replace(samples, cameras_mm=behind), some, 30.0)
    np.testing.assert_allclose(fitted.normals, fit_triangles(samples, some, 30.0).normals, atol=1e-9)
    assert np.median(off_deg(fitted.normals, truth)) < 1.0


def test_a_normal_is_held_as_the_noise_of_the_scanner_tells() -> None:
    samples, _ = noisy_case(1)
    some = np.ones(len(samples.led_mm), bool)
    sure, unsure = fit_triangles(samples, some, 0.01), fit_triangles(samples, some, 30.0)
    moved = np.median(off_deg(sure.normals, samples.normals))
    assert moved < 0.2 * np.median(off_deg(unsure.normals, samples.normals))


def test_noise_of_vertices_turns_small_triangles_as_measured() -> None:
    random = np.random.default_rng(2)
    side_mm = 0.2
    corners = side_mm * np.array([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(3) / 2, 0]])
    moved = corners + random.normal(0, 0.003, (20_000, 3, 3))
    across = np.cross(moved[:, 1] - moved[:, 0], moved[:, 2] - moved[:, 0])
    tilt_x = (across / np.linalg.norm(across, axis=1, keepdims=True))[:, 0]
    stiffness = prior_stiffness(np.array([np.sqrt(3) / 4 * side_mm**2]), 3.0)[0]
    assert tilt_x.std() == pytest.approx(stiffness**-0.5, rel=0.03)


def test_too_few_samples_give_no_material() -> None:
    samples, _ = noisy_case(1)
    few = np.zeros(len(samples.led_mm), bool)
    few[:5] = True
    assert np.isnan(fit_triangles(samples, few, 30.0).alpha).all()
