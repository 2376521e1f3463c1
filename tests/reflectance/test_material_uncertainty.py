"""Uncertainty of normals and materials, against what repeated noise and draws from the covariance give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from triangle_cases import COUNT, noisy_case, unit

from coupole.reflectance.ggx import tangents
from coupole.reflectance.material_uncertainty import covariances, groups_of, relative_uncertainty
from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples, fit_triangles, model_values

SCANNER_UM = 10.0
"""Turns triangles of 0.05 mm2 by some 4 degrees, as those of `noisy_case` are."""


def tilts(materials: TriangleMaterials, truth: np.ndarray) -> np.ndarray:
    """[n, 2] of the true normals along the tangents of the found ones."""
    along = np.array([tangents(*normal) for normal in materials.normals])
    found: np.ndarray = np.einsum("nki,ni->nk", along, truth - materials.normals)
    return found


def made_by(samples: TriangleSamples, materials: TriangleMaterials, noise: float, seed: int) -> TriangleSamples:
    """Samples of a material that the fit has, with relative noise."""
    made = model_values(samples, materials)
    made[made < 1e-3] = np.nan
    made *= np.random.default_rng(seed).normal(1.0, noise, made.shape)
    return replace(samples, values=made.astype(np.float32))


def test_normals_lie_in_their_intervals_though_the_material_is_another() -> None:
    inside = []
    for noise in (0.005, 0.05):
        samples, truth = noisy_case(2, noise=noise, leds=240)
        used = np.ones(len(samples.led_mm), bool)
        materials = fit_triangles(samples, used, SCANNER_UM)
        uncertain = covariances(samples, used, materials, SCANNER_UM, fitted_normals=True, middle_mm=np.zeros(3))
        sd = np.sqrt(np.einsum("nii->ni", uncertain.covariance)[:, :2])
        inside.append(np.mean(np.abs(tilts(materials, truth)) < 1.96 * sd))
    assert 0.88 < min(inside) < max(inside) < 1.0, inside


def test_materials_lie_in_their_intervals() -> None:
    samples, truth = noisy_case(1, leds=240)
    kd = np.random.default_rng(1).uniform(0.03, 0.2, (COUNT, 3))
    real = TriangleMaterials(truth, kd, 0.3 * kd[:, ::-1], np.full(COUNT, 0.25), np.zeros(COUNT))
    used = np.ones(len(samples.led_mm), bool)
    noisy = made_by(samples, real, 0.03, 4)
    found = fit_triangles(noisy, used, SCANNER_UM)
    uncertain = covariances(noisy, used, found, SCANNER_UM, fitted_normals=True, middle_mm=np.zeros(3))
    sd = np.sqrt(np.einsum("nii->ni", uncertain.covariance))
    for off, u in (
        (tilts(found, truth), sd[:, :2]),
        (np.log(found.kd / kd), uncertain.u_kd),
        (np.log(found.ks / real.ks), uncertain.u_ks),
        (np.log(found.alpha / 0.25), sd[:, 4]),
    ):
        assert 0.85 < np.mean(np.abs(off) < 1.96 * u) < 1.0
        assert 0.7 < np.sqrt(np.mean((off / u) ** 2)) < 1.4


def test_normals_that_are_held_make_materials_less_certain_as_their_turns_do() -> None:
    """Of triangles that are all alike but for their mesh's normals, held, off by what the scanner's noise is."""
    samples, truth = noisy_case(1, leds=240)
    alike = (np.tile([0.12, 0.1, 0.06], (COUNT, 1)), np.full((COUNT, 3), 0.03), np.full(COUNT, 0.25))
    used = np.ones(len(samples.led_mm), bool)
    made = made_by(samples, TriangleMaterials(truth, *alike, np.zeros(COUNT)), 1e-3, 6)
    found = fit_triangles(made, used, None)
    uncertain = covariances(made, used, found, SCANNER_UM, fitted_normals=False, middle_mm=np.zeros(3))
    off = np.log(found.kd.mean(axis=1) / alike[0].mean(axis=1))
    z = off / np.sqrt(uncertain.covariance[:, 2, 2])
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.5


def test_what_a_material_gives_is_as_uncertain_as_draws_of_it_tell() -> None:
    samples, _ = noisy_case(1, leds=60)
    used = np.ones(len(samples.led_mm), bool)
    found = fit_triangles(samples, used, SCANNER_UM)
    uncertain = covariances(samples, used, found, SCANNER_UM, fitted_normals=True, middle_mm=np.zeros(3))
    covariance = 1e-4 * uncertain.covariance  # small enough to be linear
    random = np.random.default_rng(9)
    along = np.array([tangents(*normal) for normal in found.normals])
    middle = model_values(samples, found).mean(axis=2)
    drawn = []
    for _ in range(400):
        step = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), random.normal(size=(COUNT, 5)))
        normals = unit(found.normals + np.einsum("nk,nki->ni", step[:, :2], along))
        kd, ks = (values * np.exp(step[:, 2 + n, None]) for n, values in enumerate((found.kd, found.ks)))
        other = TriangleMaterials(normals, kd, ks, found.alpha * np.exp(step[:, 4]), found.residual)
        drawn.append(model_values(samples, other).mean(axis=2))
    relative = relative_uncertainty(samples, found, covariance)
    seen = np.isfinite(relative) & (middle > 0.01)
    ratio = np.std(drawn, axis=0)[seen] / middle[seen] / relative[seen]
    assert 0.95 < np.median(ratio) < 1.05
    assert np.mean((ratio > 0.8) & (ratio < 1.25)) > 0.95


def test_black_and_unseen_triangles_are_uncertain_not_errors() -> None:
    samples, _ = noisy_case(1, leds=60)
    used = np.ones(len(samples.led_mm), bool)
    found = fit_triangles(samples, used, SCANNER_UM)
    found.kd[0], found.ks[1], found.kd[2], found.ks[2] = 0.0, 0.0, 0.0, 0.0
    found.alpha[3] = np.nan
    uncertain = covariances(samples, used, found, SCANNER_UM, fitted_normals=True, middle_mm=np.zeros(3))
    assert np.isnan(uncertain.covariance[3]).all()
    assert np.isfinite(uncertain.covariance[:3]).all()
    assert (uncertain.u_kd[[0, 2]] > 1).all()


def test_groups_are_of_one_view_and_of_leds_side_by_side() -> None:
    samples, _ = noisy_case(2, leds=240)
    group = groups_of(samples, np.zeros(3))
    assert len(np.unique(group)) == 16
    for number in np.unique(group):
        mine = group == number
        assert len(np.unique(samples.view_of[mine])) == 1
        ways = unit(samples.led_mm[mine])
        assert (ways @ unit(ways.mean(axis=0))).min() > np.cos(np.radians(50))


def test_uncertainties_do_not_depend_on_what_else_is_in_a_block() -> None:
    samples, _ = noisy_case(2, leds=240)
    used = np.ones(len(samples.led_mm), bool)
    found = fit_triangles(samples, used, SCANNER_UM)
    some = np.arange(10, 30)

    def of(block: TriangleSamples, materials: TriangleMaterials) -> np.ndarray:
        uncertain = covariances(block, used, materials, SCANNER_UM, fitted_normals=True, middle_mm=np.zeros(3))
        return uncertain.covariance

    np.testing.assert_array_equal(of(samples, found)[some], of(samples.of_triangles(some), found.at(some)))


def test_triangles_lit_from_one_side_are_as_uncertain_as_their_errors() -> None:
    """Few groups of LEDs say too little of what they share."""
    samples, truth = noisy_case(1, leds=1000)
    kd = np.tile([0.12, 0.1, 0.06], (COUNT, 1))
    real = TriangleMaterials(truth, kd, 0.3 * kd, np.full(COUNT, 0.25), np.zeros(COUNT))
    used = samples.led_mm @ unit(np.array([1.0, 0.2, 0.8])) > 800
    noisy = made_by(samples, real, 0.03, 8)
    found = fit_triangles(noisy, used, SCANNER_UM)
    uncertain = covariances(noisy, used, found, SCANNER_UM, fitted_normals=True, middle_mm=np.zeros(3))
    sd = np.sqrt(np.einsum("nii->ni", uncertain.covariance)[:, :2])
    assert np.mean(np.abs(tilts(found, truth)) < 1.96 * sd) > 0.9


def test_a_fit_that_ran_off_has_an_unknown_uncertainty_and_harms_no_other() -> None:
    samples, _ = noisy_case(2, leds=240)
    used = np.ones(len(samples.led_mm), bool)
    materials = fit_triangles(samples, used, SCANNER_UM)
    materials.normals[0] = np.nan
    found = covariances(samples, used, materials, SCANNER_UM, fitted_normals=True, middle_mm=np.zeros(3))
    assert np.isnan(found.covariance[0]).all()
    assert np.isfinite(found.covariance[1:]).all()
