"""Response: photon transfer and linearity against sensors of the tests' own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from light_synthesis import Array, TrueSensor, coverage

from coupole.calibration.light.linearity import linearity
from coupole.calibration.light.pairs import Pair
from coupole.calibration.light.photon_transfer import photon_transfer
from coupole.errors import InputError

SHAPE = (96, 128)
EXPOSURES_US = (500.0, 1000.0, 2000.0, 4000.0, 8000.0, 12000.0, 16000.0)
RATE_E_PER_S = 0.8 * 4031 * 3.2 / 16e-3
"""Of the brightest pixels: 80 % of the scale in the longest exposure."""


def scene() -> Array:
    """Relative light [H, W]: a slope from 0.3 to 1."""
    return np.broadcast_to(np.linspace(0.3, 1.0, SHAPE[1]), SHAPE)


def pairs_of(
    sensor: TrueSensor,
    random: np.random.Generator,
    *,
    exposures_us: tuple[float, ...] = EXPOSURES_US,
    flicker: float = 0.0,
    brighter: float = 1.0,
) -> list[Pair]:
    """Two frames of each exposure; the dark signal, known from elsewhere, is subtracted."""
    _, offset, dark = sensor.pattern()
    found = []
    for t in exposures_us:
        level = RATE_E_PER_S * brighter * scene() * t * 1e-6
        frames = [
            sensor.frame(level * (1 + flicker * random.standard_normal()), t * 1e-6, random) for _ in range(2)
        ]
        black = sensor.black_dn + (offset + dark * t * 1e-6) / sensor.e_per_dn
        a, b = (np.asarray(frame - black, float).ravel() for frame in frames)
        full = np.maximum(*frames).ravel() >= sensor.white_dn
        found.append(Pair(f"e{t:.0f}", t, a, b, full))
    return found


def random_sensor(seed: int) -> TrueSensor:
    random = np.random.default_rng([seed, 7])
    return TrueSensor(
        SHAPE,
        e_per_dn=float(random.uniform(2.0, 5.0)),
        read_e=float(random.uniform(8.0, 25.0)),
        row_e=0.0,
        prnu=float(random.uniform(0.003, 0.02)),
        seed=seed,
    )


def test_gain_and_read_noise_lie_in_their_intervals(scale: Callable[[int, int], int]) -> None:
    off = []
    for seed in range(scale(5, 100)):
        sensor = random_sensor(seed)
        found = photon_transfer(pairs_of(sensor, np.random.default_rng([seed, 8]), brighter=sensor.e_per_dn / 3.2))
        off.append((found.gain_dn_per_e.value - 1 / sensor.e_per_dn) / found.gain_dn_per_e.u)
        off.append((found.read_noise_e.value - sensor.read_e) / found.read_noise_e.u)
    inside, rms = coverage(off)
    few = len(off) < 50
    assert inside >= (0.7 if few else 0.9)
    assert (0.3 if few else 0.8) < rms < (1.8 if few else 1.25)


def test_the_response_of_single_pixels_scatters_as_it_does() -> None:
    sensor = TrueSensor(SHAPE, row_e=0.0, prnu=0.012)
    found = photon_transfer(pairs_of(sensor, np.random.default_rng(3)))
    assert found.prnu is not None
    assert abs(found.prnu.value - 0.012) < 4 * found.prnu.u


def test_saturation_is_where_variance_has_its_maximum() -> None:
    sensor = TrueSensor(SHAPE)
    found = photon_transfer(pairs_of(sensor, np.random.default_rng(4), brighter=1.6))
    assert found.saturated_seen
    assert abs(found.saturation_dn / 4031 - 1) < 0.06


def test_a_straight_response_is_called_straight() -> None:
    found = linearity(pairs_of(TrueSensor(SHAPE), np.random.default_rng(5)), 4031.0)
    assert not found.coefficients.any()
    assert found.worst_deviation < 4 * found.u_deviation + 1e-4


def test_the_bend_of_a_response_lies_in_its_interval(scale: Callable[[int, int], int]) -> None:
    off = []
    for seed in range(scale(5, 100)):
        random = np.random.default_rng([seed, 9])
        bend = tuple(random.uniform(-0.05, 0.05, 2))
        sensor = replace(random_sensor(seed), e_per_dn=3.2, bend=bend)
        found = linearity(pairs_of(sensor, random, flicker=5e-4), 4031.0, significance=1.0)
        off += list((found.coefficients - bend) / np.sqrt(np.diag(found.covariance)))
    inside, rms = coverage(off)
    few = len(off) < 50
    assert inside >= (0.7 if few else 0.9)
    assert rms < (1.8 if few else 1.25)


def test_a_bent_response_is_made_straight() -> None:
    sensor = TrueSensor(SHAPE, bend=(0.04, 0.03))
    found = linearity(pairs_of(sensor, np.random.default_rng(6)), 4031.0)
    levels = np.linspace(200, 3600, 20)
    straight = found.linear(sensor.bent(levels)) / levels
    assert np.ptp(straight) < 2e-3


def test_clipped_images_are_named() -> None:
    pairs = pairs_of(TrueSensor(SHAPE), np.random.default_rng(7), brighter=60.0)
    with pytest.raises(InputError, match="saturated in e1000, e2000"):
        linearity(pairs, 4031.0)


def test_flickering_light_is_named() -> None:
    pairs = pairs_of(TrueSensor(SHAPE), np.random.default_rng(8), flicker=0.05)
    with pytest.raises(InputError, match="flickers by"):
        linearity(pairs, 4031.0)


def test_a_changed_scene_is_named_by_its_frame() -> None:
    pairs = pairs_of(TrueSensor(SHAPE), np.random.default_rng(9))
    pairs[3] = replace(pairs[3], first=pairs[3].first[::-1], second=pairs[3].second[::-1])
    with pytest.raises(InputError, match="has changed in e4000"):
        linearity(pairs, 4031.0)


def test_a_longer_exposure_that_is_darker_is_named() -> None:
    pairs = pairs_of(TrueSensor(SHAPE), np.random.default_rng(10))
    pairs[3] = replace(pairs[3], first=pairs[3].first * 0.4, second=pairs[3].second * 0.4)
    with pytest.raises(InputError, match="e4000 is exposed longer than e2000 and yet not brighter"):
        linearity(pairs, 4031.0)
