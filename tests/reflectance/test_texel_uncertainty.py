"""Uncertainty of texels: errors that LEDs share, light from other surfaces, bent meshes, colours of squares."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from coupole.reflectance.extraction.sample_codes import REACHED
from coupole.reflectance.ggx import lobe, tangents
from coupole.reflectance.material_uncertainty import groups_of_leds
from coupole.reflectance.texels.grid_fit import of_all_pixels, without_slopes
from coupole.reflectance.texels.inter_reflection_error import covariance_of_inter_reflection
from coupole.reflectance.texels.neighbours import bend_around, lower_half, settle
from coupole.reflectance.texels.pixel_fit import Lights, PixelMaterials, Prior, fit_pixels

KD, KS, ALPHA = 0.12, 0.05, 0.3
NORMAL = np.array([0.0, 0.0, 1.0])


def dome(count: int) -> Lights:
    """LEDs on a half sphere of 800 mm, and a camera between them."""
    height = (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + math.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - height**2)
    places_mm = 800.0 * np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    group = groups_of_leds(places_mm, np.zeros(3))
    order = np.argsort(group, kind="stable")
    return Lights(np.arange(count), places_mm[order], group[order], np.array([60.0, 40.0, 330.0]))


def values_of(lights: Lights) -> np.ndarray:
    """[leds] f times the cosine of incidence of a horizontal pixel at the origin."""
    ways, view = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (lights.places_mm, lights.camera_mm))
    half = (ways + view) / np.linalg.norm(ways + view, axis=1, keepdims=True)
    lobes = [lobe(nl, view[2], nh, ALPHA)[0] for nl, nh in zip(ways[:, 2], half[:, 2], strict=True)]
    return np.asarray(ways[:, 2] * (KD + KS * np.array(lobes)))


def prior_of(count: int) -> Prior:
    return Prior(np.tile(NORMAL, (count, 1)), *(np.full(count, value) for value in (KD, KS, ALPHA)))


def fitted(values: np.ndarray, lights: Lights) -> PixelMaterials:
    places_mm = np.zeros((len(values), 3), np.float32)
    return fit_pixels(values.astype(np.float16), places_mm, lights, prior_of(len(values)), 1)


def tilts_off(fit: PixelMaterials) -> np.ndarray:
    """[n, 2] tilts from the fitted normals to the true normal."""
    steps = np.array([tangents(*normal) for normal in fit.normals])
    return np.asarray(np.einsum("nki,ni->nk", steps, NORMAL - fit.normals))


@pytest.mark.parametrize(("count", "u_group"), [(60, 0.08), (82, 0.15)])
def test_intervals_hold_errors_that_neighbouring_leds_share(count: int, u_group: float) -> None:
    """Eight groups and five unknowns: the fit follows each group, so residuals alone hold 91 to 93 % of tilts."""
    lights, random, pixels = dome(count), np.random.default_rng(1), 1500
    of_groups = random.standard_normal((pixels, lights.group.max() + 1))[:, lights.group]
    errors = u_group * of_groups + 0.02 * random.standard_normal((pixels, count))
    fit = fitted(values_of(lights) * (1 + errors), lights)
    u = np.sqrt(np.einsum("nii->ni", fit.covariance))
    assert 0.95 < np.mean(np.abs(tilts_off(fit)) < 1.96 * u[:, :2]) < 0.99
    assert 0.95 < np.mean(np.abs(fit.logs[:, 0] - math.log(KD)) < 1.96 * u[:, 2]) < 0.99


def view_with_shares(path: Path, lights: Lights, shares: np.ndarray) -> Any:
    """A view's file with shares of inter-reflection [triangles, leds] of horizontal triangles at the origin."""
    with h5py.File(path, "w") as file:
        file["centres_mm"] = np.zeros((len(shares), 3))
        file["codes"] = np.full(shares.shape, REACHED, np.uint8)
        file["inter_reflection"] = np.repeat(shares[..., None], 3, axis=2).astype(np.float16)
    return SimpleNamespace(path=path, triangles=np.arange(len(shares)), leds=np.arange(len(lights.columns)))


def test_a_normal_in_a_fold_is_as_uncertain_as_light_from_the_other_wall_turns_it(tmp_path: Path) -> None:
    lights = dome(60)
    shares = np.zeros((400, 60))
    shares[0] = np.where(lights.places_mm[:, 0] > 0.0, 0.3, 0.02)  # the wall faces these LEDs
    covariance = covariance_of_inter_reflection(
        view_with_shares(tmp_path / "v.h5", lights, shares), prior_of(400), lights
    )
    wrong = values_of(lights) * (1 + 0.2 * shares[0] / (1 - shares[0]))
    fit = fitted(wrong[None], lights)
    turned = np.linalg.norm(tilts_off(fit)[0])
    assert np.degrees(turned) > 0.3
    assert math.sqrt(np.trace(covariance[0, :2, :2])) == pytest.approx(turned, rel=0.3)
    assert math.sqrt(np.trace(covariance[1, :2, :2])) < 0.1 * turned


def test_light_from_around_makes_triangles_uncertain_that_were_estimated_to_get_none(tmp_path: Path) -> None:
    lights = dome(60)
    shares = np.where(np.arange(400)[:, None] % 2, 0.2, 0.0) + np.zeros(60)
    covariance = covariance_of_inter_reflection(
        view_with_shares(tmp_path / "v.h5", lights, shares), prior_of(400), lights
    )
    u_kd, u_tilt = np.sqrt(covariance[0, 2, 2]), np.sqrt(covariance[0, 0, 0])
    assert 0.027 < u_kd < 0.04  # 0.025, a fifth of the mean of 0 and 0.25, and the groups' part
    assert 0.05 < np.degrees(u_tilt) < 1.0


def test_without_inter_reflection_nothing_is_added(tmp_path: Path) -> None:
    lights = dome(40)
    view = view_with_shares(tmp_path / "v.h5", lights, np.zeros((3, 40)))
    with h5py.File(view.path, "r+") as file:
        del file["inter_reflection"]
    assert not covariance_of_inter_reflection(view, prior_of(3), lights).any()


def test_pixels_where_the_mesh_turns_stay_as_they_were_fitted() -> None:
    """Two facets of 20 degrees: pixels between them see both; all others are as their triangle."""
    side, u = 60, 0.004
    normals = np.zeros((side, side, 3), np.float32)
    normals[:, :30] = [0.0, 0.0, 1.0]
    normals[:, 30:] = [math.sin(0.35), 0.0, math.cos(0.35)]
    truth = np.zeros((side, side, 5))
    truth[:, 29, 0], truth[:, 30, 0] = 0.012, -0.012
    random = np.random.default_rng(2)
    deviation = (truth + u * random.standard_normal(truth.shape)).astype(np.float32)
    covariance = lower_half(np.broadcast_to(np.eye(5) * u**2, (*truth.shape, 5)))
    everywhere = np.ones((side, side), bool)
    settle(
        deviation, covariance, everywhere, np.zeros((side, side, 15), np.float32), bend_around(normals, everywhere)
    )
    off = np.abs(deviation - truth)[:, 29:31, 0]
    assert np.mean(off < 1.96 * np.sqrt(covariance[:, 29:31, 0])) > 0.9
    assert np.abs(deviation[:, :20, 0]).std() < 0.7 * u


OFFSETS = np.array([[-0.25, -0.25], [0.0, 0.0], [0.25, 0.25]])
"""Middles of the pixels of red, green and blue in squares of 2 x 2, in widths of a square."""


def test_paint_that_gets_lighter_is_no_colour() -> None:
    x, y = np.meshgrid(np.arange(30.0), np.arange(20.0))
    lightness = (0.08 * x - 0.05 * y).astype(np.float32)
    logs = lightness[..., None] + OFFSETS @ [0.08, -0.05]
    colours = (logs - np.log(np.exp(logs).mean(axis=-1, keepdims=True))).astype(np.float32)
    offsets = np.broadcast_to(OFFSETS, (20, 30, 3, 2)).astype(np.float32)
    level = without_slopes(colours, lightness, np.ones((20, 30), bool), offsets)
    assert np.abs(colours).max() > 0.005
    assert np.abs(level[1:-1, 1:-1]).max() < 2e-4


def test_kd_of_a_square_is_the_mean_over_its_pixels_and_not_over_its_channels() -> None:
    random = np.random.default_rng(3)
    paint = random.uniform(0.5, 1.5, (200, 4))  # red, green, green, blue
    of_channels = np.stack([paint[:, 0], paint[:, 1:3].mean(axis=1), paint[:, 3]], axis=1)
    own_colour = np.log(np.array([0.5, 0.35, 0.2]) / 0.35)
    kd = of_channels * 0.35 * np.exp(own_colour)
    grey = np.log(kd.mean(axis=1))
    colours = np.log(kd) - grey[:, None]
    more = of_all_pixels(
        colours.astype(np.float32), own_colour[None].astype(np.float32), np.array([0.25, 0.5, 0.25])
    )
    np.testing.assert_allclose(grey + more, np.log(0.35 * paint.mean(axis=1)), atol=1e-5)
