"""Drift of LED power from readings of a reference tile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from light_synthesis import coverage

from coupole.calibration.light.drift import Reading, fit_drift
from coupole.errors import InputError


def readings(
    random: np.random.Generator,
    *,
    level: float = 0.98,
    per_k: float = -0.003,
    rate_per_h: float = 0.0,
    noise: float = 1e-3,
    count: int = 30,
) -> list[Reading]:
    """A reading each minute while boards warm up and cool down again."""
    found = []
    for i in range(count):
        t_s = 1000.0 + 60.0 * i
        warm = 25.0 + 15.0 * np.sin(i / 6.0) ** 2
        truth = level * np.exp(per_k * (warm - 25.0) + rate_per_h * i / 60.0)
        found.append(
            Reading(f"f{i}", t_s, warm - 25.0, truth * (1 + noise * random.standard_normal()), noise * truth)
        )
    return found


def test_the_factor_of_each_frame_lies_in_its_interval(scale: Callable[[int, int], int]) -> None:
    off = []
    for seed in range(scale(20, 300)):
        random = np.random.default_rng([seed, 2])
        per_k, rate = -0.003 + 0.002 * random.standard_normal(), 0.005 * random.standard_normal()
        level = float(random.uniform(0.9, 1.1))
        found = fit_drift(readings(random, level=level, per_k=per_k, rate_per_h=rate))
        warm, t_s = float(random.uniform(20, 45)), 1000.0 + float(random.uniform(0, 1740))
        truth = level * np.exp(per_k * (warm - 25.0) + rate * (t_s - 1000.0) / 3600.0)
        off.append(float(np.log(found.factor(warm - 25.0, t_s) / truth) / found.u_factor(warm - 25.0, t_s)))
    inside, rms = coverage(off)
    few = len(off) < 100
    assert inside >= (0.75 if few else 0.9)
    assert (0.5 if few else 0.8) < rms < (1.5 if few else 1.25)


def test_far_from_the_readings_the_factor_is_less_certain() -> None:
    found = fit_drift(readings(np.random.default_rng(1)))
    assert found.u_factor(5.0, 1000.0 + 36_000.0) > 5 * found.u_factor(5.0, 1900.0)


def test_a_sudden_change_is_named_by_its_frames() -> None:
    seen = readings(np.random.default_rng(2))
    stepped = [replace(r, ratio=r.ratio * (0.95 if i >= 12 else 1.0)) for i, r in enumerate(seen)]
    with pytest.raises(InputError, match=r"changed suddenly by -\d\.\d+% between f11 and f12"):
        fit_drift(stepped)


def test_a_slow_change_is_none() -> None:
    found = fit_drift(readings(np.random.default_rng(3), rate_per_h=0.02))
    assert found.parameters[1] == pytest.approx(0.02, abs=4 * float(np.sqrt(found.covariance[1, 1])))


def test_a_dark_tile_is_named() -> None:
    seen = readings(np.random.default_rng(4))
    seen[5] = replace(seen[5], ratio=0.001)
    with pytest.raises(InputError, match="dark in f5"):
        fit_drift(seen)


def test_a_single_reading_far_off_is_left_out_and_named() -> None:
    seen = readings(np.random.default_rng(5))
    seen[7] = replace(seen[7], ratio=seen[7].ratio * 0.9)
    found = fit_drift(seen)
    assert [reading.name for reading in found.odd] == ["f7"]
    assert abs(found.residuals).max() < 0.005


def test_the_tile_s_tilt_is_told_from_drift_where_light_comes_from_all_around() -> None:
    random = np.random.default_rng(6)
    tilt_deg = 0.3
    slopes = [float(0.02 * np.cos(i)) for i in range(30)]
    seen = [
        replace(reading, ratio=reading.ratio * np.exp(slope * tilt_deg), by_shared=(slope,))
        for reading, slope in zip(readings(random, level=0.97), slopes, strict=True)
    ]
    found = fit_drift(seen, shared_covariance=np.array([[0.2**2]]))
    assert abs(found.parameters[0] - np.log(0.97)) < 4 * np.sqrt(found.covariance[0, 0])
    assert abs(found.residuals).max() < 0.005
