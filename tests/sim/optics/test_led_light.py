"""The simulated LEDs: spectrum, own flux, temperature, age, flicker, death."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from sim.optics.led_light import (
    STEADY,
    Flashes,
    LedModel,
    LedSpectrum,
    camera_weights,
    channel_factors,
    led_flux_factor,
    led_power,
    own_flux_factor,
    spectral_power,
)

MODEL = LedModel(seed=5)


def test_a_flash_depends_on_seed_led_and_flash_alone() -> None:
    first = led_flux_factor(MODEL, 17, 3, 31.0)
    led_flux_factor(MODEL, 18, 4, 40.0)
    assert led_flux_factor(MODEL, 17, 3, 31.0) == first
    assert (
        len({led_flux_factor(LedModel(seed=s), led, f, 31.0) for s in (5, 6) for led in (1, 2) for f in (1, 2)})
        == 8
    )


def test_leds_scatter_about_their_table_as_the_model_says() -> None:
    own = np.log([own_flux_factor(MODEL, led) for led in range(1080)])
    assert own.mean() == pytest.approx(0.0, abs=4 * MODEL.flux_spread / np.sqrt(1080))
    assert own.std() == pytest.approx(MODEL.flux_spread, rel=0.08)


def test_flashes_of_one_led_scatter_about_its_own_flux_as_the_model_says() -> None:
    flashes = np.array([led_flux_factor(MODEL, 3, f, MODEL.reference_c) for f in range(2000)])
    relative = flashes / own_flux_factor(MODEL, 3)
    assert relative.mean() == pytest.approx(1.0, abs=4 * MODEL.flicker / np.sqrt(2000))
    assert relative.std() == pytest.approx(MODEL.flicker, rel=0.06)


def test_a_warm_board_gives_less_light_by_the_stated_share_per_kelvin() -> None:
    cold, warm = (led_flux_factor(MODEL, 3, 0, t) for t in (25.0, 45.0))
    assert warm / cold == pytest.approx(1.0 + 20 * MODEL.flux_per_k)


def test_an_led_gives_seven_tenths_at_the_end_of_its_life() -> None:
    new, old = (led_flux_factor(MODEL, 3, 0, 25.0, hours=h) for h in (0.0, 50_000.0))
    assert old / new == pytest.approx(0.7)


def test_a_dead_led_gives_nothing() -> None:
    assert led_flux_factor(LedModel(dead=(7,)), 7, 0, 25.0) == 0.0


def test_the_spectrum_has_a_blue_peak_and_a_yellow_band_and_the_stated_shares() -> None:
    power = spectral_power(LedSpectrum())
    assert power.sum() == pytest.approx(1.0)
    assert WAVELENGTHS_NM[np.argmax(power)] == pytest.approx(450.0, abs=5.0)
    yellow = WAVELENGTHS_NM > 500.0
    assert WAVELENGTHS_NM[yellow][np.argmax(power[yellow])] == pytest.approx(560.0, abs=5.0)


def test_the_spectrum_is_that_of_a_white_led_of_daylight_colour() -> None:
    xyz = light.tristimulus(np.ones(81), spectral_power(LedSpectrum()), light.observer("2 deg"))
    x, y = xyz[:2] / xyz.sum()
    n = (x - 0.3320) / (0.1858 - y)
    # McCamy, Color Res. Appl. 17, 142 (1992).
    assert 5000.0 < 449 * n**3 + 3525 * n**2 + 6823.3 * n + 5520.33 < 6500.0


def test_channels_see_each_led_a_little_differently_and_blue_most() -> None:
    factors = np.array([channel_factors(MODEL, led, light.camera()) for led in range(300)])
    assert np.allclose(factors.mean(axis=0), 1.0, atol=0.02)
    assert factors[:, 2].std() > 3 * factors[:, 0].std()
    assert led_power(MODEL, 4).sum() == pytest.approx(1.0)


def test_white_stays_white_in_every_channel() -> None:
    weights = camera_weights(MODEL, light.camera())
    assert weights.shape == (3, 81)
    assert np.allclose(weights.sum(axis=1), 1.0)


def test_an_led_with_a_loose_contact_changes_from_flash_to_flash_and_its_neighbours_do_not() -> None:
    flashes = Flashes(STEADY)
    flashes.unsteady[7] = 0.2
    assert {flashes.flux(8, 40.0) for _ in range(8)} == {1.0}
    assert np.std([flashes.flux(7, 40.0) for _ in range(2000)]) == pytest.approx(0.2, rel=0.08)


def test_old_leds_have_lost_light() -> None:
    assert Flashes(replace(STEADY, hours_to_70_percent=50_000.0, hours_shone=50_000.0)).flux(3, 25.0) == 0.7
