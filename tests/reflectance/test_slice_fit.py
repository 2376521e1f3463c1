"""Slices: bases against SciPy's, fits against NumPy's least squares, and a lobe that none of them has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import sph_harm_y
from triangle_cases import noisy_case, unit

from coupole.reflectance.least_squares import factorise, gram, one_thread, solve, sums
from coupole.reflectance.slice_basis import COUNT, HARMONICS, RADIAL, RESIDUAL, Basis, centres, fewer, functions
from coupole.reflectance.slice_fit import fit_slices, slice_values
from coupole.reflectance.triangle_fit import TriangleSamples, fit_triangles, model_values

HELD_OUT = np.arange(300) % 10 == 4


@pytest.fixture(scope="module")
def shiny() -> TriangleSamples:
    return noisy_case(1, leds=300)[0]


def rows(basis: Basis, directions: np.ndarray) -> np.ndarray:
    found = np.empty((COUNT, len(directions)))
    functions(basis.harmonic, *np.ascontiguousarray(directions.T), found)
    return found.T


def spread_directions(count: int) -> np.ndarray:
    return unit(np.random.default_rng(3).normal(size=(count, 3)))


def test_harmonics_are_those_of_scipy() -> None:
    directions = spread_directions(40)
    polar, azimuth = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    for degree in range(10):
        for order in range(-degree, degree + 1):
            known = (
                sph_harm_y(degree, abs(order), polar, azimuth) * (-1.0) ** order
            )  # without Condon and Shortley's
            part = known.imag if order < 0 else known.real
            wanted = part * (np.sqrt(2) if order else 1.0)
            mine = rows(HARMONICS, directions)[:, degree * (degree + 1) + order]
            np.testing.assert_allclose(mine, wanted, atol=1e-12, err_msg=f"{degree}, {order}")


def test_radial_functions_are_distances_and_a_plane() -> None:
    directions = spread_directions(7)
    found = rows(RADIAL, directions)
    np.testing.assert_allclose(found[:, :-4], -np.linalg.norm(directions[:, None] - centres(), axis=2))
    np.testing.assert_allclose(found[:, -4:], np.column_stack([np.ones(7), directions]))
    assert (centres()[:, 2] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(centres(), axis=1), 1.0)


def test_least_squares_are_those_of_numpy() -> None:
    random = np.random.default_rng(2)
    rows, values, penalty = random.normal(size=(9, 40)), random.normal(size=(2, 40)), random.uniform(0.1, 1, 9)
    product, factor, found = np.zeros((9, 9)), np.zeros((9, 9)), np.empty((2, 9))
    with one_thread():
        gram(rows, product)
        assert factorise(product, penalty, factor)
        sums(rows, values, found)
        solve(factor, found)
    stacked = np.vstack([rows.T, np.diag(np.sqrt(penalty))])
    wanted = np.linalg.lstsq(stacked, np.vstack([values.T, np.zeros((9, 2))]))[0]
    np.testing.assert_allclose(found, wanted.T, rtol=1e-9)
    gram(np.ascontiguousarray(rows[:, :3]), product)
    assert not factorise(product, np.zeros(9), factor)  # fewer samples than unknowns


@pytest.mark.parametrize("basis", [HARMONICS, RADIAL])
def test_a_fit_is_the_least_squares_solution_in_the_slices_frame(shiny: TriangleSamples, basis: Basis) -> None:
    """By NumPy, for one triangle and channel: rows times cosine, the frame written out anew."""
    found = fit_slices(shiny, ~HELD_OUT, (basis, None))[0]
    t, channel = 7, 1
    normal, towards = shiny.normals[t], unit(shiny.cameras_mm[0] - shiny.centres_mm[t])
    x = unit(towards - normal * (normal @ towards))
    light = unit(shiny.led_mm - shiny.centres_mm[t]) @ np.column_stack([x, np.cross(normal, x), normal])
    values = shiny.values[t, :, channel]
    good = np.isfinite(values) & ~HELD_OUT & (light[:, 2] > 0)
    design = rows(basis, light[good]) * light[good, 2:]
    stacked = np.vstack([design, np.diag(np.sqrt(basis.penalty))])
    wanted = np.linalg.lstsq(stacked, np.append(values[good], np.zeros(COUNT)))[0]
    made = rows(basis, light[good]) @ np.stack([found[t, channel], wanted], axis=1)
    np.testing.assert_allclose(made[:, 0], made[:, 1], rtol=1e-3, atol=1e-5)


def test_what_a_slice_gives_is_what_was_fitted_and_never_negative(shiny: TriangleSamples) -> None:
    for basis in (HARMONICS, RADIAL):
        found = fit_slices(shiny, ~HELD_OUT, (basis, None))[0]
        made = slice_values(shiny, found, basis)
        assert (made >= 0).all()
        assert (slice_values(shiny, -found, basis) == 0).mean() > 0.9
        off = (made - shiny.values)[:, ~HELD_OUT]
        assert np.nanmean(np.abs(off)) < 0.02 * np.nanmean(shiny.values)
    below = replace(shiny, values=shiny.values[:, :1], led_mm=-shiny.led_mm[:1], view_of=shiny.view_of[:1])
    assert (slice_values(below, fit_slices(shiny, ~HELD_OUT, (RADIAL, None))[0], RADIAL) == 0).all()


def test_a_material_with_what_it_leaves_is_nearer_than_either(shiny: TriangleSamples) -> None:
    """Under lights that no fit has seen, and for a lobe that none has."""
    material = fit_triangles(shiny, ~HELD_OUT, 30.0)
    model = model_values(shiny, material)
    under = replace(
        shiny,
        values=shiny.values[:, HELD_OUT],
        led_mm=shiny.led_mm[HELD_OUT],
        view_of=shiny.view_of[HELD_OUT],
    )
    made = {"ggx": model[:, HELD_OUT]}
    for name, basis in (("sh", HARMONICS), ("rbf", RADIAL)):
        made[name] = slice_values(under, fit_slices(shiny, ~HELD_OUT, (basis, None))[0], basis)
    left, radial = fit_slices(shiny, ~HELD_OUT, (RESIDUAL, model), (RADIAL, None))
    np.testing.assert_array_equal(radial, fit_slices(shiny, ~HELD_OUT, (RADIAL, None))[0])
    made["both"] = slice_values(under, left, RESIDUAL, model[:, HELD_OUT])
    off = {name: float(np.nanmean(np.abs(values - under.values))) for name, values in made.items()}
    assert off["both"] < min(off["ggx"], off["sh"], off["rbf"]), off


def test_fewer_coefficients_are_low_degrees_and_some_of_the_centres(shiny: TriangleSamples) -> None:
    low, few = fewer(HARMONICS, 16), fewer(RADIAL, 16)
    for basis, free in ((low, np.arange(COUNT) < 16), (few, few.penalty < 1.0)):
        assert free.sum() == 16
        found = fit_slices(shiny, ~HELD_OUT, (basis, None))[0]
        share = np.abs(found).max(axis=(0, 1)) / np.abs(found).max()
        assert (share[~free] < 1e-6).all()
        assert (share[free] > 1e-6).all()
    np.testing.assert_array_equal(fewer(RADIAL, COUNT).penalty, RADIAL.penalty)
    np.testing.assert_array_equal(fewer(HARMONICS, COUNT).penalty, HARMONICS.penalty)


def test_channels_with_other_samples_and_triangles_with_too_few(shiny: TriangleSamples) -> None:
    values = shiny.values.copy()
    values[0, 100:] = np.nan
    values[0, 10:, 2] = np.nan
    values[1, :, 1] = np.nan
    values[2] = np.nan
    values[3, ::3, 1] = np.nan
    some = replace(shiny, values=values)
    found = fit_slices(some, ~HELD_OUT, (RADIAL, None), threads=1)[0]
    known = np.isfinite(found).all(axis=2)
    assert known[:4].tolist() == [[True, True, False], [True, False, True], [False] * 3, [True] * 3]
    for channel in range(3):
        alone = fit_slices(replace(shiny, values=values[..., [channel]]), ~HELD_OUT, (RADIAL, None))[0]
        np.testing.assert_allclose(alone[:, 0], found[:, channel], rtol=1e-5, atol=1e-7)


def test_a_model_that_leaves_everything_holds_coefficients_no_more_than_none() -> None:
    samples, _ = noisy_case(1)
    used = np.ones(len(samples.led_mm), bool)
    alone, of_the_rest = fit_slices(samples, used, (RADIAL, None), (RESIDUAL, np.zeros_like(samples.values)))
    np.testing.assert_allclose(of_the_rest[..., :COUNT], alone, rtol=1e-5, atol=1e-5)


def test_a_fit_that_another_needs_too_changes_no_bit(shiny: TriangleSamples) -> None:
    """The fit to the samples themselves is made once, for both, and made anew for other channels and ridges."""
    values = shiny.values.copy()
    values[::2, ::3, 1] = np.nan
    some = replace(shiny, values=values)
    model = model_values(some, fit_triangles(some, ~HELD_OUT, 30.0))
    alone = fit_slices(some, ~HELD_OUT, (RESIDUAL, model), threads=1)[0]
    for other in (RADIAL, fewer(RADIAL, 16)):
        _, together = fit_slices(some, ~HELD_OUT, (other, None), (RESIDUAL, model), threads=1)
        np.testing.assert_array_equal(together, alone)
