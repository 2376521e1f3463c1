"""Dark frames: maps, noise and hot pixels, against sensors of the tests' own."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pytest
from light_synthesis import TrueSensor, coverage

from coupole.calibration.light.dark import DarkFrame, calibrate_dark
from coupole.errors import InputError

SHAPE = (96, 128)
EXPOSURES_S = (0.002, 0.05, 0.2, 0.5)


def dark_frames(
    sensor: TrueSensor,
    seed: int = 1,
    *,
    each: int = 6,
    exposures_s: Sequence[float] = EXPOSURES_S,
    temperatures_c: Sequence[float] = (25.0,),
) -> list[DarkFrame]:
    found = []
    for e, exposure_s in enumerate(exposures_s):
        for i in range(each):
            warm = temperatures_c[i % len(temperatures_c)]
            random = np.random.default_rng([seed, e, i])
            shot = sensor.frame(0.0, exposure_s, random, warm)
            found.append(DarkFrame(f"dark{i}/e{e}", exposure_s, warm, shot.copy))
    return found


def test_offset_and_current_of_each_pixel_lie_in_their_intervals() -> None:
    sensor = TrueSensor(SHAPE, offset_e=12.0, dark_e_per_s=400.0, row_e=0.0)
    _, offset, current = sensor.pattern()
    found = calibrate_dark(dark_frames(sensor), white_dn=4095)
    u = found.noise_dn * np.sqrt(found.cofactor[0, 0])
    from scipy.stats import t as student

    k = float(student.ppf(0.975, found.degrees_of_freedom))
    inside, _ = coverage(((found.offset_dn - 64 - offset / 3.2) / u).ravel(), k)
    assert 0.93 < inside < 0.97
    u = found.noise_dn * np.sqrt(found.cofactor[1, 1])
    inside, _ = coverage(((found.current_dn_per_s - current / 3.2) / u).ravel(), k)
    assert 0.9 < inside < 0.97  # the longest exposures have more noise of their own than the others


def test_read_and_row_noise_lie_in_their_intervals(scale: Callable[[int, int], int]) -> None:
    off = []
    for seed in range(scale(5, 100)):
        random = np.random.default_rng([seed, 1])
        sensor = TrueSensor(
            SHAPE,
            read_e=float(random.uniform(8, 25)),
            row_e=float(random.uniform(2, 6)),
            dark_e_per_s=0.0,
            seed=seed,
        )
        found = calibrate_dark(dark_frames(sensor, seed), white_dn=4095)
        off.append((found.read_noise_dn - sensor.read_e / sensor.e_per_dn) / found.read_noise_u_dn)
        off.append((found.row_noise_dn - sensor.row_e / sensor.e_per_dn) / found.row_noise_u_dn)
    inside, rms = coverage(off)
    few = len(off) < 50
    assert inside >= (0.7 if few else 0.9)
    assert (0.3 if few else 0.8) < rms < (1.8 if few else 1.25)


def test_hot_pixels_are_found_the_hottest_first() -> None:
    sensor = TrueSensor(SHAPE, hot=7, dark_e_per_s=300.0)
    _, _, current = sensor.pattern()
    found = calibrate_dark(dark_frames(sensor), white_dn=4095)
    hottest = {tuple(place) for place in np.argwhere(current > 6000).tolist()}
    assert {tuple(place) for place in found.hot[: len(hottest)].tolist()} == hottest
    assert len(found.hot) <= len(hottest) + 5  # the warmest of the others


def test_frames_of_several_temperatures_give_one_current() -> None:
    sensor = TrueSensor(SHAPE, dark_e_per_s=400.0)
    found = calibrate_dark(dark_frames(sensor, temperatures_c=(20.0, 30.0)), white_dn=4095)
    assert found.reference_c == 25.0
    _, offset, current = sensor.pattern()
    warm_s = 0.3 * 2.0 ** ((31.5 - 25.0) / found.doubling_k)
    warm = found.offset_dn + found.current_dn_per_s * warm_s - 64 - (offset + 2 * current * 0.3) / 3.2
    assert abs(float(warm.mean())) < 0.1


def test_memory_does_not_grow_with_the_number_of_frames() -> None:
    sensor = TrueSensor((384, 512))
    frame = sensor.frame(0.0, 0.1, np.random.default_rng(1))

    def peak(each: int) -> int:
        frames = [
            DarkFrame(f"{e}-{i}", 0.1 * (e + 1), 25.0, partial(np.roll, frame, i))
            for e in range(2)
            for i in range(each)
        ]
        tracemalloc.start()
        calibrate_dark(frames, white_dn=4095)
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    few = peak(3)
    assert peak(30) < few + frame.nbytes
    assert few < 16 * 4 * frame.size


def test_light_in_a_dark_frame_is_named_by_its_frame() -> None:
    sensor = TrueSensor(SHAPE)
    frames = dark_frames(sensor)
    lit = sensor.frame(60.0, 0.05, np.random.default_rng(1))
    frames[8] = DarkFrame("dark2/e1", 0.05, 25.0, lit.copy)
    with pytest.raises(InputError, match="light fell into 1 of 24 frames: dark2/e1"):
        calibrate_dark(frames, white_dn=4095)


def test_a_black_level_that_cuts_noise_off_is_named() -> None:
    with pytest.raises(InputError, match="noise is clipped"):
        calibrate_dark(dark_frames(TrueSensor(SHAPE, black_dn=3.0)), white_dn=4095)


def test_one_exposure_does_not_tell_offset_and_current_apart() -> None:
    with pytest.raises(InputError, match="2 or more exposures, found 6 of 1"):
        calibrate_dark(dark_frames(TrueSensor(SHAPE), exposures_s=(0.1,)), white_dn=4095)
