"""Auto exposure on scenes whose rates are known: limits are met, the bound holds, the same is chosen again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from preflight_cases import DOME, TOP, plan_of, rig_of, schedule_of

from coupole.plan.choices import MOST_BURSTS, Choice, ChosenBurst, FrameSample, OpenView, has_enough, refuse_beyond
from coupole.plan.exposures import AutoExposure
from coupole.plan.shot_id import Led, ShotLabel
from coupole.preflight.auto_exposure import AutoExposureChooser

FULL_DN, READ_DN, GAIN_DN, PIXELS = 4031, 4.0, 0.3, 2000


@dataclass(frozen=True)
class Case:
    """A view of the simulated cell, and who chooses its exposures."""

    exposure: AutoExposure
    view: OpenView
    chooser: AutoExposureChooser


def case_of(every: int = 20, **exposure: float) -> Case:
    """A view with every n-th LED."""
    auto = {"kind": "auto", **exposure}
    plan = plan_of(exposure=auto, lights={"kind": "every", "every": every}, views=[{**TOP, "elevation_deg": 80}])
    rig = rig_of()
    assert isinstance(plan.exposure, AutoExposure)
    chooser = AutoExposureChooser(plan.exposure, DOME, rig.support.base_from_support.matrix())
    return Case(plan.exposure, schedule_of(plan, rig, DOME).open_view(0), chooser)


class Scene:
    """Pixels with known rates under each LED, and their frames with the noise of a camera."""

    def __init__(self, view: OpenView, brightest: float, dimmest: float, seed: int) -> None:
        """Rates from `dimmest` to `brightest`, DN per us: a tenth of the pixels has highlights under some LEDs."""
        self._rng, rng = np.random.default_rng(seed), np.random.default_rng(seed)
        diffuse = dimmest * np.exp(rng.random(PIXELS) * np.log(4.0))
        mirrors = rng.choice(view.leds, PIXELS // 10)
        self.rates: dict[int, NDArray[np.float64]] = {}
        for place, led in enumerate(view.leds.tolist()):
            rate = diffuse * (1.0 + 0.3 * np.cos(place / 9.0))
            near = np.exp(-(((mirrors.astype(float) - led) / 60.0) ** 2))
            rate[: len(mirrors)] += brightest * near
            self.rates[led] = rate

    def frame(self, led: int, time_us: int) -> FrameSample:
        signal = self.rates[led] * time_us
        noise = self._rng.standard_normal(PIXELS) * np.sqrt(READ_DN**2 + GAIN_DN * np.maximum(signal, 0.0))
        noisy = np.clip(np.round(signal + noise), -64, FULL_DN).astype(np.int16)
        return FrameSample(float(np.mean(noisy >= FULL_DN)), noisy, FULL_DN)


def chosen_by(case: Case, scene: Scene) -> tuple[list[Choice], dict[ShotLabel, FrameSample]]:
    """All choices for a view, and its frames. The bound is held to."""
    view = case.view
    choices: list[Choice] = []
    samples: dict[ShotLabel, FrameSample] = {}
    while not has_enough(choices):
        choice = case.chooser.choose(view, tuple(choices), dict(samples))
        assert choice == case.chooser.choose(view, tuple(choices), dict(samples))
        choices.append(choice)
        refuse_beyond(view.bound, [view.burst_of(burst) for made in choices for burst in made.bursts])
        for burst in choice.bursts:
            for label in burst.labels():
                assert label not in samples, f"{label} is chosen twice"
                assert isinstance(label.light, Led)
                samples[label] = scene.frame(label.light.id, burst.exposure_us)
    return choices, samples


def times_of(case: Case, samples: Mapping[ShotLabel, FrameSample]) -> dict[int, list[int]]:
    """Exposures of each LED, us, shortest first."""
    times: dict[int, set[int]] = {}
    for label in samples:
        assert isinstance(label.light, Led)
        times.setdefault(label.light.id, set()).add(case.exposure.exposures_us[label.exposure])
    return {led: sorted(own) for led, own in times.items()}


def test_highlights_and_dark_pixels_are_exposed_as_asked_for() -> None:
    case = case_of(shortest_us=250, longest_us=128000, snr=15, most_exposures=4)
    scene = Scene(case.view, brightest=6.0, dimmest=0.004, seed=3)
    choices, samples = chosen_by(case, scene)
    assert choices[-1].reason == f"all {len(case.view.leds)} LEDs are exposed as requested"
    for led, times_us in times_of(case, samples).items():
        rate = scene.rates[led]
        assert np.mean(rate * times_us[0] >= FULL_DN) <= 2e-3
        precision = sum(
            np.where(rate * t < FULL_DN, t**2 / (READ_DN**2 + GAIN_DN * rate * t), 0.0) for t in times_us
        )
        assert np.mean(rate * np.sqrt(precision) >= 15) >= 0.86


def test_one_exposure_is_enough_where_all_is_alike() -> None:
    case = case_of(shortest_us=250, longest_us=128000, snr=20)
    _, samples = chosen_by(case, Scene(case.view, brightest=0.0, dimmest=0.03, seed=1))
    frames = sum(label.repeat == 0 for label in samples)
    assert frames <= 1.3 * len(case.view.leds)


def test_what_cannot_be_reached_is_said() -> None:
    case = case_of(shortest_us=250, longest_us=2000, snr=100)
    choices, _ = chosen_by(case, Scene(case.view, brightest=0.0, dimmest=0.01, seed=1))
    assert "LEDs are noisier than requested" in choices[-1].reason
    assert "the plan allows no more" in choices[-1].reason


@settings(max_examples=25, deadline=None)
@given(
    brightest=st.floats(0.0, 500.0),
    dimmest=st.floats(1e-5, 50.0),
    most=st.integers(2, 4),
    seed=st.integers(0, 1000),
    span=st.sampled_from([(10, 20), (250, 128000), (10, 2000000), (8000, 16000)]),
)
def test_no_scene_makes_a_view_exceed_its_bound(
    brightest: float, dimmest: float, most: int, seed: int, span: tuple[int, int]
) -> None:
    case = case_of(shortest_us=span[0], longest_us=span[1], most_exposures=most, every=40)
    choices, samples = chosen_by(case, Scene(case.view, brightest, dimmest, seed))
    assert all(len(times) <= most for times in times_of(case, samples).values())
    assert sum(len(choice.bursts) for choice in choices) <= MOST_BURSTS


def test_a_chooser_that_asks_for_more_than_the_bound_is_stopped() -> None:
    case = case_of(shortest_us=1000, longest_us=4000, most_exposures=2)
    view, ladder = case.view, case.exposure.exposures_us
    leds = tuple(sorted(view.leds.tolist()))
    longest = range(len(ladder) - 3, len(ladder))
    bursts = [view.burst_of(ChosenBurst(exposure=n, exposure_us=ladder[n], leds=leds)) for n in longest]
    refuse_beyond(view.bound, bursts[1:])
    with pytest.raises(RuntimeError, match="where preflight has checked"):
        refuse_beyond(view.bound, bursts)


def test_times_of_the_ladder_rise_by_quarters_of_a_stop_and_end_as_asked() -> None:
    exposure = AutoExposure(kind="auto", shortest_us=500, longest_us=30000)
    times_us = exposure.exposures_us
    assert (times_us[0], times_us[4], times_us[-1]) == (500, 1000, 30000)
    assert all(a < b <= 1.2 * a for a, b in pairwise(times_us))
