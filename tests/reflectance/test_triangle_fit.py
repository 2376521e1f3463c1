"""Normals and materials of triangles under near lights, from samples of a material that the fit does not have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from triangle_cases import noisy_case, off_deg

from coupole.reflectance.triangle_fit import fit_triangles, model_values, prior_stiffness


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
