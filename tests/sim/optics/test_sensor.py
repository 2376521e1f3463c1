"""The simulated sensor against the figures it was given: what a calibration would measure is what the model
says."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from places import REPO

from coupole.errors import InputError
from sim.optics.sensor import SensorModel, electrons, expose_electrons, fixed_pattern, mosaic_electrons

QUIET = SensorModel(read_noise_e=0.0, row_noise_e=0.0, prnu=0.0, dsnu_e=0.0, dark_e_per_s=0.0)
"""Shot noise alone."""
SHAPE = (96, 128)
ROOT = REPO


def flat(
    model: SensorModel, light_e: float, shape: tuple[int, int] = SHAPE, **settings: float
) -> NDArray[np.uint16]:
    out = np.empty(shape, np.uint16)
    frame = int(settings.pop("frame", 0))
    expose_electrons(out, np.full(shape, light_e, np.float32), model=model, frame=frame, **settings)
    return out


def test_the_mean_variance_line_gives_gain_and_read_noise_within_one_percent(
    scale: Callable[[int, int], int],
) -> None:
    model = replace(SensorModel(), row_noise_e=0.0, bit_depth=16, black_dn=1024)
    shape = (scale(1000, 3072), scale(1400, 4096))
    mean, variance = [], []
    for step, light_e in enumerate((0.0, 50.0, 500.0, 1500.0, 3000.0, 6000.0, 9000.0)):
        pair = [flat(model, light_e, shape, frame=2 * step + i).astype(float) for i in (0, 1)]
        mean.append(0.5 * (pair[0] + pair[1]).mean() - model.black_dn)
        # The difference of two frames takes the fixed pattern away (EMVA 1288, section 6.6).
        variance.append(0.5 * (pair[0] - pair[1]).var())
    slope, _ = np.polyfit(mean, variance, 1, w=1.0 / np.array(variance))
    assert 1.0 / slope == pytest.approx(model.electrons_per_dn, rel=0.01)
    assert np.sqrt(variance[0]) * model.electrons_per_dn == pytest.approx(model.read_noise_e, rel=0.01)


def test_the_response_is_linear_to_a_thousandth() -> None:
    light_e = np.array([200.0, 1000.0, 4000.0, 8000.0, 12_000.0])
    model = replace(SensorModel(), prnu=0.0, dsnu_e=0.0, dark_e_per_s=0.0)
    mean = [flat(model, e, (400, 500), frame=int(e)).mean() - model.black_dn for e in light_e]
    assert np.array(mean) * model.electrons_per_dn / light_e == pytest.approx(1.0, abs=1e-3)


def test_a_dark_frame_shows_black_level_read_and_row_noise() -> None:
    model = replace(SensorModel(), dsnu_e=0.0, row_noise_e=4.0, bit_depth=16, black_dn=2000)
    dark = flat(model, 0.0, (1500, 1000)).astype(float)
    rows = dark.mean(axis=1)
    assert dark.mean() == pytest.approx(model.black_dn, abs=1.0)
    assert (dark - rows[:, None]).std() * model.electrons_per_dn == pytest.approx(model.read_noise_e, rel=0.01)
    assert rows.std() * model.electrons_per_dn == pytest.approx(model.row_noise_e, rel=0.1)


def test_row_noise_is_new_in_each_frame() -> None:
    model = replace(QUIET, row_noise_e=20.0, bit_depth=16, black_dn=2000)
    rows = [flat(model, 0.0, (2000, 4), frame=frame).mean(axis=1) for frame in (0, 1)]
    assert abs(np.corrcoef(rows)[0, 1]) < 0.1


def test_more_light_than_the_full_well_holds_gives_a_level_without_shot_noise() -> None:
    half = flat(QUIET, 40_000.0, gain=0.5)
    assert np.unique(half).tolist() == [round(QUIET.black_dn + 0.5 * QUIET.full_well_e / QUIET.electrons_per_dn)]


def test_an_overexposed_pixel_is_white_in_spite_of_read_noise() -> None:
    assert flat(SensorModel(), 40_000.0).min() == SensorModel().white_dn


def test_gain_lets_the_adc_saturate_before_the_well() -> None:
    assert flat(QUIET, 0.6 * QUIET.full_well_e, gain=2.0).min() == QUIET.white_dn
    assert flat(QUIET, 0.4 * QUIET.full_well_e, gain=2.0).max() < QUIET.white_dn


def test_gain_divides_electrons_per_dn() -> None:
    single, fourfold = (flat(QUIET, 1000.0, (300, 400), gain=gain).mean() - QUIET.black_dn for gain in (1.0, 4.0))
    assert fourfold / single == pytest.approx(4.0, rel=1e-3)


def test_noise_below_the_black_level_is_kept_and_the_adc_ends_at_zero() -> None:
    model = replace(SensorModel(), black_dn=1, read_noise_e=50.0)
    assert flat(model, 0.0).min() == 0
    assert flat(SensorModel(), 0.0).min() < SensorModel().black_dn


def test_dark_current_doubles_with_the_stated_warming() -> None:
    model = replace(QUIET, dark_e_per_s=200.0, hot_share=0.0, dark_spread=0.0)
    cool, warm = (flat(model, 0.0, (200, 300), exposure_s=2.0, temperature_c=t).mean() for t in (25.0, 31.5))
    assert (warm - model.black_dn) / (cool - model.black_dn) == pytest.approx(2.0, rel=0.01)
    assert (cool - model.black_dn) * model.electrons_per_dn == pytest.approx(400.0, rel=0.01)


def test_hot_pixels_of_a_long_dark_frame_are_those_of_the_truth() -> None:
    model = replace(SensorModel(), hot_share=2e-3)
    shape = (300, 400)
    pattern = fixed_pattern(model, *shape)
    longest = flat(model, 0.0, shape, exposure_s=2.0)
    found = longest > np.median(longest) + 500
    assert 120 < np.count_nonzero(pattern.hot) < 360
    assert np.array_equal(found, pattern.hot)


def test_the_mean_of_many_frames_is_the_fixed_pattern(scale: Callable[[int, int], int]) -> None:
    model = replace(SensorModel(), prnu=0.05, dsnu_e=30.0, row_noise_e=0.0)
    n = scale(200, 2000)
    light, dark = (
        sum(flat(model, e, frame=frame + int(e)).astype(float) for frame in range(n)) / n for e in (6000.0, 0.0)
    )
    pattern = fixed_pattern(model, *SHAPE)
    response = (light - dark) * model.electrons_per_dn / 6000.0
    offset_e = (dark - model.black_dn) * model.electrons_per_dn
    assert (response - pattern.response).std() < 2.0 * np.sqrt(6000.0 + 2 * 13.0**2) / 6000.0 / np.sqrt(n)
    assert (offset_e - pattern.offset_e).std() < 2.0 * 13.0 / np.sqrt(n)


def test_the_fixed_pattern_has_the_spreads_of_the_model() -> None:
    pattern = fixed_pattern(SensorModel(), 500, 600)
    assert pattern.response.std() == pytest.approx(SensorModel().prnu, rel=0.02)
    assert pattern.offset_e.std() == pytest.approx(SensorModel().dsnu_e, rel=0.02)
    dark = pattern.dark_e_per_s[~pattern.hot]
    assert np.median(dark) == pytest.approx(SensorModel().dark_e_per_s, rel=0.02)
    assert np.log(dark).std() == pytest.approx(SensorModel().dark_spread, rel=0.02)


def test_ambient_light_counts_by_channel_and_time() -> None:
    model = replace(QUIET, ambient_e_per_s=(1000.0, 2000.0, 3000.0))
    frame = flat(model, 0.0, (200, 200), exposure_s=2.0).astype(float) - model.black_dn
    cell = [frame[y::2, x::2].mean() * model.electrons_per_dn for y in (0, 1) for x in (0, 1)]
    assert cell == pytest.approx([4000.0, 6000.0, 2000.0, 4000.0], rel=0.01)  # G B R G


def test_the_mosaic_takes_each_pixels_own_channel() -> None:
    out, seen = np.empty(SHAPE, np.uint16), np.zeros(SHAPE, np.int32)
    radiance, falloff = np.array([[1000.0, 2000.0, 4000.0]], np.float32), np.ones(SHAPE, np.float32)
    mean_e = mosaic_electrons(seen, radiance, falloff, model=QUIET, electrons_per_radiance=1.0)
    expose_electrons(out, mean_e, model=QUIET, frame=0)
    cell = [(out[y::2, x::2].mean() - 64) * QUIET.electrons_per_dn for y in (0, 1) for x in (0, 1)]
    assert cell == pytest.approx([2000.0, 4000.0, 1000.0, 2000.0], rel=0.01)


def test_finer_sites_are_averaged_within_each_pixel() -> None:
    fine = np.full((SHAPE[0] * 3, SHAPE[1] * 3), -1, np.int32)
    fine[::3, ::3] = 0
    fine[1::3, 1::3] = 0
    falloff = np.full(SHAPE, 0.5, np.float32)
    radiance = np.array([[9000.0] * 3], np.float32)
    ours, expected = np.empty(SHAPE, np.uint16), np.empty(SHAPE, np.uint16)
    mean_e = mosaic_electrons(fine, radiance, falloff, model=SensorModel(), electrons_per_radiance=1.0)
    expose_electrons(ours, mean_e, model=SensorModel(), frame=7)
    expose_electrons(expected, np.full(SHAPE, 1000.0, np.float32), model=SensorModel(), frame=7)
    assert np.abs(ours.astype(int) - expected).max() <= 1


def test_an_unblurred_picture_through_the_mosaic_is_the_frame_of_the_short_way() -> None:
    rng = np.random.default_rng(3)
    site = rng.integers(-1, 20, SHAPE).astype(np.int32)
    radiance = rng.uniform(0.0, 5000.0, (20, 3)).astype(np.float32)
    falloff = rng.uniform(0.5, 1.0, SHAPE).astype(np.float32)
    image = electrons(site, radiance, falloff, electrons_per_radiance=1.0)
    rows, columns = np.indices(SHAPE)
    mean_e = image[rows, columns, SensorModel().channels()[rows % 2, columns % 2]]
    short_way = mosaic_electrons(site, radiance, falloff, model=SensorModel(), electrons_per_radiance=1.0)
    np.testing.assert_allclose(short_way, mean_e, rtol=1e-6)


def test_frames_differ_and_repeat() -> None:
    first, again, other = (flat(SensorModel(), 1000.0, frame=frame) for frame in (4, 4, 5))
    reseeded = flat(replace(SensorModel(), seed=2), 1000.0, frame=4)
    assert np.array_equal(first, again)
    assert np.mean(first == other) < 0.1
    assert np.mean(first == reseeded) < 0.1


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="render for the camera's size"):
        expose_electrons(np.empty((4, 4), np.uint16), np.zeros((4, 6), np.float32), model=QUIET, frame=0)
    with pytest.raises(InputError, match="render for the camera's size"):
        mosaic_electrons(
            np.zeros((6, 4), np.int32),
            np.zeros((1, 3), np.float32),
            np.ones((4, 4), np.float32),
            model=QUIET,
            electrons_per_radiance=1.0,
        )


SCRIPT = """
import hashlib, numba, numpy as np
from sim.optics.sensor import SensorModel, expose_electrons, mosaic_electrons
assert numba.get_num_threads() == {threads}
out = np.empty((301, 403), np.uint16)
triangle = (np.arange(out.size, dtype=np.int32) % 997 - 1).reshape(out.shape)
radiance = np.linspace(0, 3000, 3 * 996, dtype=np.float32).reshape(996, 3)
falloff, model = np.ones(out.shape, np.float32), SensorModel()
mean_e = mosaic_electrons(triangle, radiance, falloff, model=model, electrons_per_radiance=1.0)
expose_electrons(out, mean_e, model=model, frame=11, exposure_s=0.5)
print(hashlib.sha256(out.tobytes()).hexdigest())
"""


def test_one_two_and_eight_threads_write_the_same_bytes() -> None:
    found = {
        subprocess.run(
            [sys.executable, "-c", SCRIPT.format(threads=threads)],
            env={**os.environ, "NUMBA_NUM_THREADS": str(threads)},
            cwd=ROOT,
            check=True,
            capture_output=True,
            text=True,
            timeout=120,
        ).stdout
        for threads in (1, 2, 8)
    }
    assert len(found) == 1
