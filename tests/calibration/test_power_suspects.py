"""What signals of a white tile say of causes that a plain calibration of LED power lacks."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from coupole.calibration.light.led_power import LedPower, calibrate_led_power
from coupole.calibration.light.led_power_records import covariance_of, power_limits, power_table
from coupole.calibration.light.power_between import Between
from coupole.calibration.light.power_left_out import views_left_out
from coupole.calibration.light.power_suspects import DIES, DRIFT, GLOSS, names_of
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_lobe import lobes_of
from coupole.calibration.light.tile_parts import STAIN
from coupole.calibration.light.tile_views import Angles

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from drawn_lights import TILE, DrawnPowers, draw_powers
from prove_led_power import judge_cell

LEDS = 60


@cache
def cell(cause: str, strength: float, seed: int = 1) -> DrawnPowers:
    return draw_powers(seed, LEDS, cause, strength)


@cache
def found(cause: str, strength: float, seed: int = 1) -> LedPower:
    drawn = cell(cause, strength, seed)
    return calibrate_led_power(drawn.views, drawn.positions, TILE)


def missed(power: LedPower) -> list[str]:
    return [limit.name for limit in power_limits({"G": power}, {}) if not limit.is_met]


@pytest.mark.parametrize(
    ("cause", "strength", "name"),
    [("gain", 0.01, DRIFT), ("gloss", 0.02, GLOSS), ("stain", 0.03, STAIN), ("dies", 5.0, DIES)],
)
def test_a_cause_is_named_with_its_remedy(cause: str, strength: float, name: str) -> None:
    power = found(cause, strength)
    assert name in names_of(power.causes, power.parts)
    assert any("powers and uncertainties account for it" in remark for remark in power.remarks)


def test_without_a_cause_none_is_named_and_uncertainties_stay_as_they_are() -> None:
    for seed in (1, 2, 3):
        drawn = cell("gain", 0.0, seed)
        plain = calibrate_led_power(drawn.views, drawn.positions, TILE, search=False)
        power = found("gain", 0.0, seed)
        assert not list(names_of(power.causes, power.parts))
        assert np.median(power.u_against_mean() / plain.u_against_mean()) < 1.1
        assert power.u_scale() / plain.u_scale() < 1.1


@pytest.mark.parametrize(("cause", "strength"), [("gain", 0.01), ("warming", 0.01)])
def test_intervals_hold_though_gain_or_light_drifts(cause: str, strength: float) -> None:
    judged = [judge_cell(seed, leds=LEDS, cause=cause, strength=strength) for seed in (1, 2, 3)]
    assert np.mean([one.plain.share for one in judged if one.plain is not None]) < 0.7
    assert np.mean([one.ours.share for one in judged if one.ours is not None]) > 0.85


def test_a_stain_lowers_the_tile_and_not_the_leds() -> None:
    """The stain takes 0.7 % of the light on average: as much as the certificate's uncertainty."""
    clean, stained = found("stain", 0.0), found("stain", 0.03)
    change = np.log(stained.power / clean.power)
    assert np.std(change) < 1e-4
    assert abs(change.mean()) < 2.0 * stained.parts.u_loss
    assert stained.u_scale() > 1.1 * clean.u_scale()


def test_tilted_dies_widen_each_power_by_their_fall_off() -> None:
    """Dies that lean by s about two axes: their light changes by about s over the distance, in each direction."""
    straight, tilted = found("dies", 0.0), found("dies", 5.0)
    assert straight.parts.fall_off_per_mm == 0.0
    assert tilted.parts.fall_off_per_mm == pytest.approx(np.radians(5.0) / 1500.0, rel=0.35)
    added = np.sqrt(np.median(tilted.u_own**2 - straight.u_own**2))
    assert added == pytest.approx(40.0 * tilted.parts.fall_off_per_mm, rel=0.1)


@pytest.mark.parametrize(
    ("cause", "strength", "limit"),
    [("gain", 0.04, "drift"), ("wave", 0.03, "unsteady"), ("gloss", 0.08, "lobe"), ("stain", 0.1, "stain")],
)
def test_a_cause_that_is_too_large_misses_its_limit(cause: str, strength: float, limit: str) -> None:
    assert limit in missed(found(cause, strength))
    assert not missed(found("gain", 0.0))


@pytest.mark.parametrize("geometry", ["0/h", "0/45"])
def test_a_lobe_does_not_change_what_the_certificate_states(geometry: str) -> None:
    """0/45 by its one direction; 0/h by a sum over the hemisphere."""
    tile = Tile(geometry=geometry, minnaert=1.0)
    if geometry == "0/45":
        at_45 = np.cos(np.radians(22.5))
        angles = Angles(*(np.array([value]) for value in (1.0, np.sqrt(0.5), at_45, at_45)))
        assert lobes_of(angles, tile) == pytest.approx(np.zeros((1, 12)), abs=1e-9)
        return
    observation = (np.arange(2000) + 0.5) / 2000
    half = np.cos(0.5 * np.arccos(observation))
    change = lobes_of(Angles(np.ones(2000), observation, half, half), tile)
    assert 2.0 * np.mean(change * observation[:, None], axis=0) == pytest.approx(np.zeros(12), abs=2e-4)


def test_views_left_out_move_the_powers_as_a_calibration_without_them_would() -> None:
    """One LED in two views: each view left out moves it by half of their difference."""
    y, led = np.array([1.0, 1.2, 2.0, 2.0]), np.array([0, 0, 1, 1])
    observed = Between(np.zeros(4), np.zeros((4, 1)), np.ones(4), led, 2, np.ones(1))
    left_out = views_left_out(y, observed, ["a", "b", "a", "b"])
    assert left_out.u == pytest.approx([0.05, 0.05])
    assert left_out.ratio(np.full(2, 0.025)) == pytest.approx(2.0)
    once = Between(np.zeros(2), np.zeros((2, 1)), np.ones(2), np.array([0, 1]), 2, np.ones(1))
    assert views_left_out(y[[0, 2]], once, ["a", "a"]).ratio(np.full(2, 0.025)) == 0.0


def test_views_that_contradict_each_other_without_a_cause_are_refused() -> None:
    drawn = cell("gain", 0.0)
    odd = drawn.views[1]
    random = np.random.default_rng(3)
    moved = replace(odd, signal=odd.signal * np.exp(0.01 * random.standard_normal((len(odd.leds), 1))))
    views = (drawn.views[0], moved, *drawn.views[2:])
    assert "scatter" in missed(calibrate_led_power(views, drawn.positions, TILE))


def test_the_table_has_the_figures_of_causes_in_every_channel() -> None:
    powers = {"R": found("warming", 0.01), "G": found("gain", 0.0)}
    covariance = covariance_of(powers, dict.fromkeys(powers, np.array([0.1, 0.1, 0.5, 0.005 / 0.99, 0.05])))
    sigmas = np.sqrt(np.diag(covariance))
    assert len(covariance) == 2 * (1 + len(powers["R"].common_names))
    assert np.linalg.eigvalsh(covariance / np.outer(sigmas, sigmas)).min() > -1e-9
    header = power_table(powers, dict.fromkeys(range(LEDS), 25.0)).splitlines()[1].split(",")
    assert {"d_cause1_R", "d_cause1_G", "d_minnaert_G"} <= set(header)


def test_uncertainties_follow_from_the_shared_figures_and_their_covariance() -> None:
    """The figures that are kept, and those that count as the LEDs' own, have the variance of all modes."""
    power = found("warming", 0.01)
    joint, count = power.causes.error.joint_covariance, 5
    slopes = np.hstack([power.common[:, :count], -power.causes.mean_modes])
    whole = np.einsum("ni,ij,nj->n", slopes, joint, slopes)
    kept = power.u() ** 2 - power.u_own**2
    assert kept / (whole + power.parts.u_loss**2) == pytest.approx(np.ones(LEDS), abs=0.02)
