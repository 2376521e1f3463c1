"""Exposure advice from pictures of known radiance and noise, made here."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from coupole.devices import FrameFormat
from coupole.errors import InputError
from coupole.plan.exposures import FixedExposure
from coupole.plan.yamlfile import read_document
from coupole.preflight.exposure_advice import Metered, Noise, Request, advise, advise_view, noise_of, write_plan

BLACK, WHITE = 64, 4095
FORMAT = FrameFormat(64, 96, 12, "GBRG", BLACK, WHITE)
READ_DN, GAIN_DN = 4.0, 0.3
EXPOSURES_US = (500, 2000, 8000)
PIXELS = 12_000


def picture(rate: NDArray[np.float64], exposure_us: int, random: np.random.Generator) -> NDArray[np.int32]:
    """Signal above black, DN, of pixels with `rate` DN a microsecond: shot and read noise, rounding, clipping."""
    electrons = random.poisson(rate * exposure_us / GAIN_DN)
    signal = electrons * GAIN_DN + random.normal(0.0, READ_DN, rate.shape)
    return np.clip(np.rint(signal), -BLACK, WHITE - BLACK).astype(np.int32)


def metered(rates: list[NDArray[np.float64]], seed: int = 1) -> Metered:
    random = np.random.default_rng(seed)
    return Metered(
        FORMAT,
        {
            f"led{n:04d}": {e: [picture(rate, e, random) for _ in range(2)] for e in EXPOSURES_US}
            for n, rate in enumerate(rates)
        },
    )


def lambertian(brightest: float, seed: int = 2) -> list[NDArray[np.float64]]:
    """Four lights on an object that fills the picture, each pixel lit well by one of them at least."""
    random = np.random.default_rng(seed)
    return [brightest * random.uniform(0.2, 1.0, PIXELS) for _ in range(4)]


def test_the_photon_transfer_line_gives_back_read_noise_and_gain() -> None:
    noise = noise_of([metered(lambertian(0.3))])
    assert noise.gain_dn == pytest.approx(GAIN_DN, rel=0.02)
    assert noise.read_dn == pytest.approx(np.hypot(READ_DN, np.sqrt(1 / 12)), rel=0.05)


@given(st.floats(1.0, 200.0), st.floats(0.3, 30.0), st.floats(0.01, 5.0))
def test_the_signal_for_a_ratio_has_that_ratio(snr: float, read_dn: float, gain_dn: float) -> None:
    signal = Noise(read_dn, gain_dn).signal_for(snr)
    assert signal / np.sqrt(read_dn**2 + gain_dn * signal) == pytest.approx(snr)


@settings(max_examples=25, deadline=None)
@given(st.floats(0.02, 1.5), st.integers(0, 1000))
def test_what_is_proposed_meets_both_wishes(brightest: float, seed: int) -> None:
    rates = lambertian(brightest, seed)
    request = Request(saturated_share=1e-3, snr=25.0, object_share=0.9)
    advice = advise({"top": metered(rates, seed)}, request, longest_us=200_000)
    assert advice.remarks == ()
    shortest_us, longest_us = advice.exposure.exposures_us[0], advice.exposure.exposures_us[-1]
    for rate in rates:
        assert np.mean(rate * shortest_us >= WHITE - BLACK) <= request.saturated_share
    best = np.max(rates, axis=0) * longest_us
    assert np.mean(best / np.sqrt(READ_DN**2 + GAIN_DN * best) >= request.snr) >= request.object_share


def test_the_shortest_exposure_that_is_good_enough_is_proposed_for_it_gives_least_light() -> None:
    advice = advise({"top": metered(lambertian(0.05))}, Request(snr=20.0), longest_us=200_000)
    (view,) = advice.views
    assert advice.exposure.kind == "fixed"
    assert view.shortest_us <= advice.exposure.exposures_us[0] < 1.1 * view.shortest_us < view.longest_us


def test_a_gloss_that_outshines_the_rest_asks_for_a_bracket() -> None:
    rates = lambertian(0.05)
    rates[0][: PIXELS // 100] = 3.0
    advice = advise({"top": metered(rates)}, Request(), longest_us=200_000)
    exposures_us = advice.exposure.exposures_us
    assert advice.exposure.kind == "bracket"
    assert 3.0 * exposures_us[0] < WHITE - BLACK
    assert all(b <= 4.1 * a for a, b in pairwise(exposures_us))


def test_the_darkest_view_and_the_brightest_bound_the_plan() -> None:
    views = {"bright": metered(lambertian(0.4)), "dim": metered(lambertian(0.004))}
    advice = advise(views, Request(), longest_us=200_000)
    bright, dim = advice.views
    assert advice.exposure.exposures_us[0] <= bright.longest_us
    assert advice.exposure.exposures_us[-1] >= 0.99 * dim.shortest_us


def test_pixels_that_show_nothing_do_not_lengthen_the_exposure() -> None:
    rates = lambertian(0.3)
    for rate in rates:
        rate[PIXELS // 3 :] = 0.0
    noise = Noise(READ_DN, GAIN_DN)
    seen = advise_view("top", metered(rates), Request(), noise)
    assert seen.object_share == pytest.approx(1 / 3, abs=0.01)
    assert seen.shortest_us < 2 * advise_view("top", metered(lambertian(0.3)), Request(), noise).shortest_us


def test_a_view_of_nothing_is_said_to_be_one() -> None:
    advice = advise({"top": metered([np.zeros(PIXELS)] * 4)}, Request(), longest_us=200_000)
    assert "view top: the pictures show only noise" in advice.remarks[0]


def test_pictures_that_are_all_saturated_ask_for_another_metering() -> None:
    advice = advise({"top": metered(lambertian(100.0))}, Request(), longest_us=200_000)
    assert any("meter again" in remark for remark in advice.remarks)


def test_an_exposure_longer_than_leds_can_be_on_is_not_proposed() -> None:
    advice = advise({"top": metered(lambertian(0.0005))}, Request(snr=40.0), longest_us=20_000)
    assert max(advice.exposure.exposures_us) <= 20_000
    assert any("too short for the required signal-to-noise ratio" in remark for remark in advice.remarks)


PLAN = "schema_version: 1  # this stays\nname: x\nexposure: {kind: fixed, exposure_us: 8000}\n"


def test_the_plan_is_written_with_its_comments_and_the_new_exposure(tmp_path: Path) -> None:
    plan, out = tmp_path / "plan.yaml", tmp_path / "metered.yaml"
    plan.write_text(PLAN)
    write_plan(read_document(plan), out, FixedExposure(kind="fixed", exposure_us=1234))
    assert out.read_text() == PLAN.replace("8000", "1234")
    assert read_document(out).data["exposure"]["exposure_us"] == 1234


@pytest.mark.parametrize("out", ["other/plan.yaml", "plan.yaml"])
def test_a_plan_is_written_neither_elsewhere_nor_over_another(tmp_path: Path, out: str) -> None:
    (tmp_path / "other").mkdir()
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN)
    with pytest.raises(InputError, match=r"plan\.yaml: "):
        write_plan(read_document(plan), tmp_path / out, FixedExposure(kind="fixed", exposure_us=1234))
    assert plan.read_text() == PLAN
