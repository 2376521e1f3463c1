"""Cones of normals: wide where the fit's own spread is, and not known where there is no normal."""

from __future__ import annotations

import numpy as np
from picture_cases import lights_in_rings

from coupole.reflectance.normal_cones import cones_deg, spreads_deg
from coupole.reflectance.normal_fit import fit_materials

VIEW = np.array([0.0, 0.0, 1.0])


def matt_values(noise: float, count: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values [n, lights] of matt pixels with noise, their lights, and their normals."""
    random, lights = np.random.default_rng(1), lights_in_rings()
    normals = np.array([0.0, 0.0, 1.0]) + random.normal(0.0, 0.2, (count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    values = 0.1 * np.maximum(normals @ lights.T, 0.0)
    return np.maximum(values + random.normal(0.0, noise, values.shape), 0.0), lights, normals


def test_spreads_grow_with_noise_as_errors_do() -> None:
    medians, errors = [], []
    for noise in (1e-4, 1e-3):
        values, lights, normals = matt_values(noise)
        materials = fit_materials(values, lights, VIEW)
        medians.append([np.median(spread) for spread in spreads_deg(values, materials, lights, VIEW)])
        cosine = np.sum(materials.normals * normals, axis=1)
        errors.append(np.median(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))
    fit, jackknife = np.array(medians).T
    assert fit[1] > 1.3 * fit[0]  # the least that is unknown of a tilt is in both
    assert jackknife[1] > 4.0 * jackknife[0]
    assert 0.5 < fit[1] / errors[1] < 3.0


def test_cones_hold_normals_of_noisy_matt_pixels() -> None:
    values, lights, normals = matt_values(1e-3)
    materials = fit_materials(values, lights, VIEW)
    cones = cones_deg(*spreads_deg(values, materials, lights, VIEW))
    off_deg = np.degrees(np.arccos(np.clip(np.sum(materials.normals * normals, axis=1), -1.0, 1.0)))
    assert np.mean(off_deg <= cones) > 0.93
    assert np.median(cones) < 5.0


def test_a_stratum_has_the_quantile_of_its_own_jackknife() -> None:
    fit = np.repeat([0.1, 0.2, 0.4, 0.8, 1.6, 3.2], [5000, 5000, 5000, 3000, 1400, 600])
    cones = cones_deg(fit, 10.0 * fit)
    assert np.all(np.diff(cones) >= 0.0)
    of_all = np.quantile(10.0 * fit, 0.95)
    assert 1.0 < cones[0] < 1.0 + 0.1 * of_all  # drawn a little to what all have


def test_a_pixel_without_material_has_no_cone() -> None:
    values, lights, _ = matt_values(1e-3, 40)
    values[7] = 0.0
    cones = cones_deg(*spreads_deg(values, fit_materials(values, lights, VIEW), lights, VIEW))
    assert np.flatnonzero(np.isnan(cones)).tolist() == [7]
