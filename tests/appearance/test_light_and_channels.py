"""Illuminants and observers against published chromaticities; channels as means over the light that counts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coupole.appearance.spectra import channels, light
from coupole.appearance.spectra.grid import BANDS, WAVELENGTHS_NM
from coupole.errors import InputError

WHITE = np.ones(BANDS)


@pytest.mark.parametrize(
    ("illuminant", "observer", "x", "y"),
    [
        # CIE 15:2018, tables of chromaticity coordinates.
        ("D65", "2 deg", 0.31272, 0.32903),
        ("D65", "10 deg", 0.31382, 0.33100),
        ("A", "2 deg", 0.44758, 0.40745),
        ("A", "10 deg", 0.45117, 0.40594),
        ("E", "2 deg", 1.0 / 3.0, 1.0 / 3.0),
        ("E", "10 deg", 1.0 / 3.0, 1.0 / 3.0),
    ],
)
def test_illuminants_have_their_published_chromaticities(
    illuminant: str, observer: light.Observer, x: float, y: float
) -> None:
    xyz = light.tristimulus(WHITE, light.illuminant(illuminant), light.observer(observer))

    assert xyz[:2] / xyz.sum() == pytest.approx([x, y], abs=1e-4)


def test_illuminant_a_agrees_with_the_table_of_the_library() -> None:
    table = light._on_grid(light._colour().SDS_ILLUMINANTS["A"])

    assert light.illuminant("A") == pytest.approx(table, rel=1e-4)


def test_the_perfect_white_is_lightness_100_and_a_fifth_of_it_about_50() -> None:
    power, functions = light.illuminant("D65"), light.observer("10 deg")
    white = light.tristimulus(WHITE, power, functions)

    assert light.lab(white, white) == pytest.approx([100.0, 0.0, 0.0])
    assert light.lab(0.18418 * white, white)[0] == pytest.approx(50.0, abs=0.01)


def test_a_white_under_d65_is_white_on_the_screen() -> None:
    xyz = light.tristimulus(WHITE, light.illuminant("D65"), light.observer("2 deg"))

    assert light.linear_srgb(xyz) == pytest.approx(1.0, abs=1e-3)


def test_an_unknown_illuminant_is_refused_with_those_that_are_known() -> None:
    with pytest.raises(InputError, match="D65"):
        light.illuminant("D66")


def test_a_white_led_has_a_blue_peak_and_a_broad_yellow_one() -> None:
    power = light.led("LED-B3")
    blue, gap, yellow = (
        power[(low_nm < WAVELENGTHS_NM) & (high_nm > WAVELENGTHS_NM)]
        for low_nm, high_nm in ((430.0, 470.0), (470.0, 500.0), (540.0, 640.0))
    )

    assert gap.min() < 0.4
    assert blue.max() == 1.0
    assert yellow.max() > 0.8


def test_a_cameras_channels_peak_where_their_names_say() -> None:
    peaks_nm = WAVELENGTHS_NM[light.camera().argmax(axis=1)]

    assert 570.0 < peaks_nm[0] < 650.0
    assert 500.0 < peaks_nm[1] < 560.0
    assert 430.0 < peaks_nm[2] < 490.0


@settings(deadline=None, max_examples=40)
@given(value=st.floats(0.0, 2.0))
def test_a_grey_has_its_reflectance_in_every_channel(value: float) -> None:
    weights = channels.channel_weights(light.led("LED-B3"), light.camera())

    assert channels.channel_values(np.full(BANDS, value), weights) == pytest.approx(value)


@settings(deadline=None, max_examples=40)
@given(spectrum=st.lists(st.floats(0.0, 1.0), min_size=BANDS, max_size=BANDS))
def test_channels_lie_between_the_least_and_the_most_of_the_spectrum(spectrum: list[float]) -> None:
    weights = channels.channel_weights(light.led("LED-B3"), light.camera())

    found = channels.channel_values(np.array(spectrum), weights)

    assert np.all((found >= min(spectrum) - 1e-9) & (found <= max(spectrum) + 1e-9))


def test_channels_do_not_depend_on_how_strong_the_light_or_the_camera_is() -> None:
    spectrum = np.linspace(0.1, 0.9, BANDS)
    power, camera = light.led("LED-B3"), light.camera()

    once, scaled = (
        channels.channel_values(spectrum, channels.channel_weights(f * power, f**2 * camera)) for f in (1.0, 7.0)
    )

    assert once == pytest.approx(scaled)


def test_the_white_tile_is_one_whatever_it_reflects() -> None:
    tile = np.linspace(0.93, 0.99, BANDS)
    weights = channels.channel_weights(light.led("LED-B3"), light.camera())

    assert channels.channel_values(tile, weights, tile) == pytest.approx(1.0)


def test_a_narrow_band_of_light_reads_the_spectrum_at_its_wavelength() -> None:
    line = np.zeros(BANDS)
    line[20] = 3.0
    spectrum = np.linspace(0.0, 1.0, BANDS)

    found = channels.channel_values(spectrum, channels.channel_weights(line, light.camera()))

    assert found == pytest.approx(spectrum[20])


def test_a_light_that_a_channel_does_not_see_is_refused() -> None:
    with pytest.raises(InputError, match="sees none of it"):
        channels.channel_weights(np.zeros(BANDS), light.camera())
