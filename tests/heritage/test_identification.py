"""Which reference a spectrum resembles, or none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coupole.appearance.matter import kubelka_munk, pigments, typical
from coupole.appearance.spectra import light, resampling
from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.measured import Measured
from coupole.errors import InputError
from coupole.heritage.analysis import identification

REFERENCES = {name: typical.reflectance(name).values for name in typical.SHAPES if name != "black_shape"}


def colour_chart(name: str) -> list[Array]:
    """The 18 coloured patches of a ColorChecker as measured, on the grid."""
    patches = light._colour().SDS_COLOURCHECKERS[name].values()
    return [
        resampling.on_grid(Measured("", np.asarray(p.wavelengths), np.asarray(p.values), ())).values
        for p in list(patches)[:18]
    ]


@pytest.mark.parametrize("name", REFERENCES)
def test_a_reference_is_itself(name: str) -> None:
    verdict = identification.identify(REFERENCES[name], REFERENCES)

    assert verdict.finding == "match"
    assert verdict.candidates[0].name == name
    assert verdict.candidates[0].score == pytest.approx(1.0)


@settings(deadline=None, max_examples=30)
@given(
    name=st.sampled_from(sorted(REFERENCES)),
    dust=st.floats(0.0, 0.25),
    kept=st.floats(0.5, 1.0),
    seed=st.integers(0, 99),
)
def test_dust_and_noise_do_not_hide_a_pigment(name: str, dust: float, kept: float, seed: int) -> None:
    contrast = np.ptp(REFERENCES[name])
    noise = 0.01 * kept * contrast * np.random.default_rng(seed).standard_normal(81)

    verdict = identification.identify(dust + kept * (1.0 - dust) * REFERENCES[name] + noise, REFERENCES)

    assert verdict.candidates[0].name == name


def test_a_tint_with_white_is_still_its_pigment() -> None:
    white, blue = (
        pigments.from_opaque(name, typical.reflectance(name)) for name in ("white_shape", "blue_one_peak_shape")
    )
    tint = pigments.opaque_reflectance(pigments.mixture([white, blue], [0.7, 0.3]))

    verdict = identification.identify(tint.values, REFERENCES)

    assert verdict.finding == "match"
    assert verdict.candidates[0].name == "blue_one_peak_shape"


def test_a_pigment_that_the_references_lack_is_none_of_these() -> None:
    others = {name: REFERENCES[name] for name in REFERENCES if name != "blue_two_peaks_shape"}

    verdict = identification.identify(REFERENCES["blue_two_peaks_shape"], others)

    assert verdict.finding == "none"
    assert "comes nearest" in verdict.reason


def test_two_references_that_are_alike_are_ambiguous() -> None:
    twin = kubelka_munk.opaque(1.3 * kubelka_munk.k_over_s(REFERENCES["red_shape"]))

    verdict = identification.identify(REFERENCES["red_shape"], {**REFERENCES, "cinnabar": twin})

    assert verdict.finding == "ambiguous"
    assert verdict.margin < 0.02


def test_a_flat_grey_is_none_of_these() -> None:
    verdict = identification.identify(np.full(81, 0.3), REFERENCES)

    assert verdict.finding == "none"
    assert "flat" in verdict.reason


def test_bands_that_were_not_measured_do_not_count() -> None:
    spectrum = REFERENCES["green_shape"].copy()
    spectrum[:6] = spectrum[-10:] = np.nan

    verdict = identification.identify(spectrum, REFERENCES)

    assert verdict.finding == "match"
    assert verdict.candidates[0].name == "green_shape"


def test_too_few_common_bands_are_refused() -> None:
    spectrum = np.full(81, np.nan)
    spectrum[:20] = REFERENCES["blue_one_peak_shape"][:20]

    with pytest.raises(InputError, match="common bands"):
        identification.compare("azurite", spectrum, REFERENCES["blue_one_peak_shape"])


def test_without_references_nothing_can_be_said() -> None:
    with pytest.raises(InputError, match="found none"):
        identification.identify(REFERENCES["blue_one_peak_shape"], {})


def test_measured_patches_of_another_chart_are_found_again() -> None:
    # Charts of different decades and paints: two patches differ so much beyond 650 nm that "none" is right, and
    # one blue goes to its neighbour.
    references = {str(i): patch for i, patch in enumerate(colour_chart("BabelColor Average"))}

    verdicts = [identification.identify(patch, references) for patch in colour_chart("cc_ohta")]

    matched = [v.candidates[0].name == str(i) for i, v in enumerate(verdicts) if v.finding == "match"]
    assert sum(matched) >= 15
    assert len(matched) - sum(matched) <= 1
