"""LED power from a white tile, against domes of the tests' own with small emitters added up point by point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from light_synthesis import Array, coverage
from tile_synthesis import TILE, dome, powers, summed_irradiance, turned, views_of

from coupole.calibration.light.irradiance import Emission, irradiance_per_flux, lambert_vector, led_corners_mm
from coupole.calibration.light.led_power import LedPower, calibrate_led_power, prior_of
from coupole.calibration.light.led_power_records import covariance_of
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_views import Positions, TileView
from coupole.errors import InputError

EXPOSURE_S = 0.01


def u_scale(found: LedPower) -> float:
    """Relative standard uncertainty of all powers together."""
    mean = np.nanmean(found.common[found.power > 0], axis=0)
    return float(np.sqrt(mean @ found.common_covariance @ mean))


def small_dome(seed: int = 1, count: int = 60) -> tuple[Positions, Array, np.random.Generator]:
    random = np.random.default_rng(seed)
    return dome(count, random), powers(count, random), random


def test_irradiance_has_the_reference_values() -> None:
    def seen_at(angle_deg: float) -> float:
        a = np.radians(angle_deg)
        return float(
            irradiance_per_flux([0, 0, 0], [0, 0, 1], 1000 * np.array([np.sin(a), 0, np.cos(a)]), [0, 0, -1])
        )

    assert seen_at(0) == pytest.approx(0.318304687, abs=5e-10)
    assert seen_at(30) == pytest.approx(0.238731440, abs=5e-10)
    assert seen_at(60) == pytest.approx(0.0795790963, abs=1e-10)
    view_factor = lambert_vector([0, 0, 0], led_corners_mm([0, 0, 7], [0, 0, -1]))[2] / (2 * np.pi)
    assert view_factor == pytest.approx(0.2394564705, abs=5e-11)


def test_the_paper_takes_the_emitters_cosine_twice() -> None:
    led = 1000 * np.array([np.sin(1), 0, np.cos(1)])
    once = irradiance_per_flux([0, 0, 0], [0, 0, 1], led, [0, 0, -1])
    twice = irradiance_per_flux([0, 0, 0], [0, 0, 1], led, [0, 0, -1], emission="paper")
    assert twice / once == pytest.approx(np.cos(1))


def test_irradiance_is_that_of_many_small_emitters() -> None:
    positions, _, _ = small_dome()
    normal = turned(10, 20) @ (0, 0, 1)
    exact = irradiance_per_flux([5, 3, 1], normal, positions.centres_mm, positions.normals)
    lit = exact > 0
    summed = summed_irradiance(np.array([5, 3, 1]), normal, positions.centres_mm, positions.normals)
    assert np.abs(summed[lit] / exact[lit] - 1).max() < 1e-5


def test_powers_lie_in_their_intervals(scale: Callable[[int, int], int]) -> None:
    off: list[float] = []
    for seed in range(scale(5, 100)):
        positions, power, random = small_dome(seed, 30)
        truth = replace_tile(random)
        tilts = tuple(map(tuple, random.normal(0, TILE.u_tilt_deg, (2, 2))))
        height_mm = float(random.normal(0, TILE.u_height_mm))
        views = views_of(positions, power, random, tilts_deg=tilts, height_mm=height_mm, truth=truth)
        found = calibrate_led_power(views, positions, TILE)
        error = np.log(found.power / power)
        against = error - error.mean()
        off += list(random.choice(against / found.u_against_mean(), 4))
        off.append(float(error.mean()) / u_scale(found))
    inside, rms = coverage(off)
    few = len(off) < 100
    assert inside >= (0.7 if few else 0.9)
    assert (0.3 if few else 0.8) < rms < (1.8 if few else 1.25)


def replace_tile(random: np.random.Generator) -> Tile:
    """A tile that is what its description says, within its uncertainty."""
    return TILE.model_copy(
        update={
            "reflectance": TILE.reflectance + TILE.u_reflectance * random.standard_normal(),
            "minnaert": TILE.minnaert + TILE.u_minnaert * random.standard_normal(),
        }
    )


def test_what_channels_share_of_one_tile_is_known_to_be_shared(scale: Callable[[int, int], int]) -> None:
    z: list[float] = []
    for seed in range(scale(8, 100)):
        positions, power, random = small_dome(seed, 30)
        truth, tilt = replace_tile(random), tuple(map(float, random.normal(0, TILE.u_tilt_deg, 2)))
        height_mm = float(random.normal(0, TILE.u_height_mm))
        found = {
            channel: calibrate_led_power(
                views_of(positions, power, random, tilts_deg=(tilt,), height_mm=height_mm, truth=truth),
                positions,
                TILE,
            )
            for channel in "RGB"
        }
        covariance = covariance_of(found, dict.fromkeys(found, prior_of(TILE)))
        means = np.array([one.power.mean() for one in found.values()])
        at = np.arange(3) * len(covariance) // 3
        u = np.sqrt(covariance[at, at])
        assert np.allclose(u / means, [u_scale(one) for one in found.values()], rtol=0.05)
        assert (covariance[np.ix_(at, at)] / np.outer(u, u) > 0.9).all()
        assert np.linalg.eigvalsh(covariance / np.outer(*[np.sqrt(np.diag(covariance))] * 2)).min() > -1e-9
        z.append(float((means.sum() - 3 * power.mean()) / np.sqrt(covariance[np.ix_(at, at)].sum())))
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.6


def test_a_tile_in_several_places_tells_its_tilt() -> None:
    positions, power, random = small_dome()
    tilts = ((0.2, -0.1), (-0.15, 0.1), (0.1, 0.2))
    found = calibrate_led_power(views_of(positions, power, random, tilts_deg=tilts), positions, TILE)
    u = np.sqrt(np.diag(found.common_covariance))
    at = [found.common_names.index(f"place{p}.tilt_{axis}_deg") for p in range(3) for axis in "xy"]
    assert (np.abs(found.departures[at] - np.ravel(tilts)) < 4 * u[at]).all()
    one = calibrate_led_power(views_of(positions, power, random), positions, TILE)
    assert (u[:2] < 0.8 * np.sqrt(np.diag(one.common_covariance))[:2]).all()


def changed(views: list[TileView], number: int, factor: Array | float) -> list[TileView]:
    views[number] = replace(views[number], signal=views[number].signal * factor)
    return views


def found_with(views: list[TileView], positions: Positions) -> LedPower:
    return calibrate_led_power(views, positions, TILE)


def test_a_dead_led_is_named() -> None:
    positions, power, random = small_dome()
    power[7] = 1e-3
    views = [replace(v, u_signal=np.full(v.signal.shape, 1.0)) for v in views_of(positions, power, random)]
    found = found_with(views, positions)
    assert found.power[7] == 0
    assert "LEDs that are dead, or hidden in every view: LED 7" in found.remarks


def test_a_shadow_on_the_tile_is_named_and_not_used() -> None:
    positions, power, random = small_dome()
    factor = np.ones((60, 9))
    factor[11, 6:] = 0.7
    found = found_with(changed(views_of(positions, power, random), 0, factor), positions)
    assert any("view p0c0: the tile is partly in shadow under LED 11" in remark for remark in found.remarks)
    assert abs(found.power[11] / power[11] - 1) < 4 * found.u()[11]


def test_an_led_that_the_arm_hides_in_one_view_is_not_dead() -> None:
    positions, power, random = small_dome()
    factor = np.ones((60, 9))
    factor[11] = 1e-4
    found = found_with(changed(views_of(positions, power, random), 0, factor), positions)
    assert any("view p0c0: the tile is wholly in shadow under LED 11" in remark for remark in found.remarks)
    assert abs(found.power[11] / power[11] - 1) < 4 * found.u()[11]


def test_a_saturated_tile_is_named_and_not_used() -> None:
    positions, power, random = small_dome()
    views = views_of(positions, power, random)
    views[1].saturation_mask[5] = True
    found = found_with(views, positions)
    assert any("view p0c1: the tile is saturated under LED 5" in remark for remark in found.remarks)


def test_a_tile_that_moved_between_views_is_named() -> None:
    positions, power, random = small_dome()
    first = views_of(positions, power, random)[:1]
    moved = views_of(positions, power, random, tilts_deg=((1.0, 0.3),))[1:]
    with pytest.raises(InputError, match=r"was moved: view p0c[01] sees it tilted by"):
        found_with([*first, *moved], positions)


@pytest.mark.parametrize("emission", ["lambertian", "paper"])
def test_behind_an_led_there_is_no_light(emission: Emission) -> None:
    led = ((0.0, 0.0, 1000.0), (0.0, 0.0, -1.0))
    assert irradiance_per_flux((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), *led, emission=emission) > 0.0
    assert irradiance_per_flux((0.0, 0.0, 1200.0), (0.0, 0.0, -1.0), *led, emission=emission) == 0.0
    assert irradiance_per_flux((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), *led, emission=emission) == 0.0
