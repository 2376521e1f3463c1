"""Samples of a view against the formula in double precision, triangle by triangle."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coupole.calibration.light.frames import LightFrame
from coupole.calibration.light.glare_correction import GlareCorrection
from coupole.calibration.light.veil import at_pixels, light_of_blocks
from coupole.plan.shot_id import ShotId
from coupole.reflectance.extraction.frame_veils import FrameVeils, dark_of_blocks
from coupole.reflectance.extraction.lamp_sight import Facets
from coupole.reflectance.extraction.radiance import SignalReader
from coupole.reflectance.extraction.sample_codes import REACHED, SHADED
from coupole.reflectance.extraction.seen_surface import SeenSurface
from coupole.reflectance.extraction.view_samples import ViewPass

HEIGHT, WIDTH, TRIANGLES = 48, 64, 40
TOP_DN, RANGE_DN = 4095 - 0.02 * 4031, 4031.0
CURVE = np.array([[0.02, -0.01], [0.0, 0.0], [-0.03, 0.005]])
NOISE = np.array([[6.0, 0.4], [5.0, 0.3], [7.0, 0.5]])


def view_of(exposures_us: list[tuple[float, ...]], random: Any, emission: str, noise: Any) -> Any:
    """A view of LEDs with these exposures, each over triangles of random pixels, and all that is known of it."""
    channel = np.tile(np.array([[1, 2], [0, 1]], np.int8), (HEIGHT // 2, WIDTH // 2))
    seen = random.integers(-3, TRIANGLES, (HEIGHT, WIDTH)).clip(-1).astype(np.int32)
    dark = random.uniform(60, 70, (HEIGHT, WIDTH)).astype(np.float32)
    curve = np.hstack([CURVE, np.full((3, 1), RANGE_DN)])
    radiometry: Any = SimpleNamespace(
        channel=channel, channels=3, flat=random.uniform(0.7, 1.1, seen.shape).astype(np.float32), curve=curve,
        noise=noise, u_pixel=np.zeros(3), white_dn=4095, black_dn=64,
        dark=lambda frame: dark + np.float32(1e-4 * frame.exposure_us), veils=lambda frames: None,
    )  # fmt: skip
    by_led: dict[int, list[LightFrame]] = {}
    for led, mine in enumerate(exposures_us):
        level = random.uniform(0.02, 0.4, seen.shape)
        for number, exposure_us in enumerate(mine):
            pixels = (64 + 4031 * np.minimum(level * exposure_us / 4000, 1.0)).astype(np.uint16)
            shot, pose = ShotId.parse(f"top/led{led:04d}/e{number}"), np.eye(4)
            frame = LightFrame(shot, exposure_us, 0.0, 25.0, pose, pose, lambda pixels=pixels: pixels)
            by_led.setdefault(led, []).append(frame)
    leds_mm = np.array([0.0, 0.0, 900.0]) + random.normal(0, 300, (len(by_led), 3))
    axes = -leds_mm / np.linalg.norm(leds_mm, axis=1, keepdims=True)
    powers = random.uniform(1e6, 1e7, (len(by_led), 3))
    normals = random.normal(0, 0.3, (TRIANGLES, 3)) + np.array([0.0, 0.0, 1.0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    facets = Facets(random.uniform(-50, 50, (TRIANGLES, 3)), normals, np.full((TRIANGLES, 3), -1))
    frames = [frame for mine in by_led.values() for frame in mine]
    measured = SimpleNamespace(
        frames=SimpleNamespace(size_px=(WIDTH, HEIGHT)), emission=emission,
        leds=SimpleNamespace(of=lambda leds: (leds_mm[leds], axes[leds])),
        power_of=lambda frame: powers[frame.led],
    )  # fmt: skip
    view = SimpleNamespace(by_led=by_led, frames=frames)
    surface = SeenSurface(seen, np.arange(TRIANGLES))
    return ViewPass(measured, view, facets, SignalReader(radiometry, surface)), radiometry, seen  # type: ignore[arg-type]


def by_formula(
    work: Any, radiometry: Any, seen: Any, triangle: int, led: int, channel: int
) -> tuple[float, float]:
    """f and its relative uncertainty (Lucat et al. 2025, Eqs. 1 to 3); exposures by their weights."""
    means, weights = [], []
    noise = radiometry.noise[channel]
    for frame in work.view.by_led[led]:
        mine = (seen == triangle) & (radiometry.channel == channel)
        dn = frame.read()[mine].astype(float)
        signal, flat = dn - radiometry.dark(frame)[mine], radiometry.flat[mine].astype(float)
        if not len(dn) or dn.max() >= TOP_DN or signal.mean() <= 0.02 * RANGE_DN:
            continue
        c2, c3 = CURVE[channel] / (RANGE_DN, RANGE_DN**2)
        time_s = frame.exposure_us * 1e-6
        means.append(np.mean((signal + c2 * signal**2 + c3 * signal**3) / flat) / time_s)
        variance = np.sum((noise[0] + noise[1] * np.maximum(signal, 0)) / flat**2) / (len(dn) * time_s) ** 2
        weights.append(time_s if np.isnan(variance) else 1 / variance)
    if not means:
        return np.nan, np.nan
    (place,), (axis,) = work.measured_run.leds.of(np.array([led]))
    way = place - work.facets.centres_mm[triangle]
    distance = np.linalg.norm(way)
    leaving, arriving = -way @ axis / distance, way @ work.facets.normals[triangle] / distance
    lit = leaving ** (2 if work.measured_run.emission == "paper" else 1) / (np.pi * (distance * 1e-3) ** 2)
    mean = np.average(means, weights=weights)
    power = work.measured_run.power_of(work.view.by_led[led][0])[channel]
    u = np.nan if np.isnan(noise[0]) else np.sum(weights) ** -0.5 / mean
    return mean / (power * lit * arriving), u


ONE, SOME = [(4000.0,)] * 11, [(4000.0, 16000.0), (4000.0,), (1000.0, 4000.0, 4000.0), (16000.0,)] * 3


@pytest.mark.parametrize(
    ("exposures_us", "emission", "noise"),
    [(ONE, "lambertian", NOISE), (ONE, "paper", NOISE), (SOME, "paper", NOISE), (SOME, "paper", NOISE * np.nan)],
)
def test_samples_are_those_of_the_formula_within_a_step_of_their_halves(
    exposures_us: list[tuple[float, ...]], emission: str, noise: Any
) -> None:
    random = np.random.default_rng(5)
    work, radiometry, seen = view_of(exposures_us, random, emission, noise)
    codes = np.where(random.random((len(exposures_us), TRIANGLES)) < 0.2, SHADED, REACHED).astype(np.uint8)
    found = np.full((2, TRIANGLES, len(exposures_us), 3), np.nan)
    for some in work.samples(lambda part, pool: codes[part], 2):
        found[:, some.rows, some.leds] = some.f, some.u_own
        np.testing.assert_array_equal(some.codes, codes[some.leds, some.rows].T)
    wanted = np.full(found.shape, np.nan)
    for triangle, led, channel in np.ndindex(found.shape[1:]):
        if codes[led, triangle] == REACHED:
            wanted[:, triangle, led, channel] = by_formula(work, radiometry, seen, triangle, led, channel)
    assert np.isfinite(wanted[0]).mean() > 0.5
    np.testing.assert_allclose(found, wanted, rtol=2.0**-11 + 2e-6)


@pytest.mark.parametrize("exposures_us", [SOME, ONE])
def test_glare_is_taken_off_by_the_light_of_all_exposures_of_an_led(exposures_us: list[tuple[float, ...]]) -> None:
    random = np.random.default_rng(8)
    work, radiometry, seen = view_of(exposures_us, random, "lambertian", NOISE)
    glare = GlareCorrection(
        ("R", "G", "B"), random.uniform(0.0, 0.01, (3, 5)), np.tile(1e-8 * np.eye(5), (3, 1, 1)), np.full(3, 0.03),
        (WIDTH, HEIGHT),
    )  # fmt: skip
    darks = {t: dark_of_blocks(radiometry.dark(SimpleNamespace(exposure_us=t)), radiometry.channel, glare)
             for t in (1000.0, 4000.0, 16000.0)}  # fmt: skip
    codes = np.zeros((len(exposures_us), TRIANGLES), np.uint8)
    plain, found = (np.full((TRIANGLES, len(exposures_us), 3), np.nan) for _ in range(2))
    u_plain, u_found, taken_off = (np.full(plain.shape, np.nan) for _ in range(3))
    for some in work.samples(lambda part, pool: codes[part], 2):
        plain[some.rows, some.leds], u_plain[some.rows, some.leds] = some.f, some.u_own
        assert some.glare.shape == (0, 0, 0)
    curve = radiometry.curve
    radiometry.veils = lambda frames: FrameVeils(glare, radiometry.channel, curve, TOP_DN, darks)
    for some in work.samples(lambda part, pool: codes[part], 2):
        found[some.rows, some.leds], u_found[some.rows, some.leds] = some.f, some.u_own
        taken_off[some.rows, some.leds] = some.glare
    checked = 0
    for led in range(len(exposures_us)):
        light, clipped = light_of_led(work.view.by_led[led], radiometry)
        for channel in range(3):
            mask = radiometry.channel == channel
            veil, u_veil = glare.veil(light_of_blocks(light, mask, 2), channel)
            u_all = np.hypot(u_veil, light[mask & clipped].sum() / light[mask].sum())
            assert work.reader.u_glare[led][channel] == pytest.approx(u_all, rel=1e-3)
            for triangle in np.flatnonzero(np.isfinite(plain[:, led, channel])):
                rows, columns = np.nonzero(mask & (seen == triangle))
                veil_rate = np.mean(at_pixels(veil, rows, columns, 2) / radiometry.flat[rows, columns])
                per_rate = plain[triangle, led, channel] / signal_of(
                    work, radiometry, seen, triangle, led, channel
                )
                left = plain[triangle, led, channel] - veil_rate * per_rate
                assert found[triangle, led, channel] == pytest.approx(left, rel=2e-3)
                assert taken_off[triangle, led, channel] == pytest.approx(veil_rate * per_rate / left, rel=3e-3)
                checked += 1
    assert checked > 500
    np.testing.assert_allclose(u_found * found, u_plain * plain, rtol=3e-3)


def signal_of(work: Any, radiometry: Any, seen: Any, triangle: int, led: int, channel: int) -> float:
    """Mean signal of a triangle, DN/s, with its glare: f without what light and power make of it."""
    f, _ = by_formula(work, radiometry, seen, triangle, led, channel)
    (place,), (axis,) = work.measured_run.leds.of(np.array([led]))
    way = place - work.facets.centres_mm[triangle]
    distance = np.linalg.norm(way)
    leaving, arriving = -way @ axis / distance, way @ work.facets.normals[triangle] / distance
    lit = leaving / (np.pi * (distance * 1e-3) ** 2)
    return float(f * work.measured_run.power_of(work.view.by_led[led][0])[channel] * lit * arriving)


def light_of_led(frames: list[LightFrame], radiometry: Any) -> tuple[Any, Any]:
    """[h, w] linear signal, DN/s, by the longest exposure that does not clip; and what all exposures clip."""
    rate, is_open = np.zeros((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH), bool)
    for frame in sorted(frames, key=lambda frame: -frame.exposure_us):
        signal = frame.read() - radiometry.dark(frame).astype(float)
        x = signal / RANGE_DN
        c2, c3 = np.moveaxis(CURVE[radiometry.channel], -1, 0)
        rate = np.where(is_open, rate, signal * (1 + x * (c2 + x * c3)) / (1e-6 * frame.exposure_us))
        is_open |= frame.read() < TOP_DN
    return rate, ~is_open


def test_a_sample_that_no_half_can_hold_is_none() -> None:
    work, _, _ = view_of([(4000.0,)], np.random.default_rng(1), "paper", NOISE)
    work.measured_run.power_of = lambda frame: np.array([1e-3, 0.0, np.nan])  # type: ignore[attr-defined]
    (some,) = work.samples(lambda part, pool: np.zeros((1, TRIANGLES), np.uint8), 1)
    assert np.isnan(some.f).all()
    assert np.isnan(some.u_own).all()


def test_frames_are_read_into_little_memory_that_is_used_again() -> None:
    work, _, _ = view_of([(4000.0,)] * 40, np.random.default_rng(2), "paper", NOISE)
    places = set()
    shots: Callable[..., Any] = work._shots

    def noted(frames: Any, pixels: Any, slots: Any) -> Any:
        places.update(pixels[slot].ctypes.data for slot in slots)
        return shots(frames, pixels, slots)

    object.__setattr__(work, "_shots", noted)
    assert len(list(work.samples(lambda part, pool: np.zeros((8, TRIANGLES), np.uint8), 2))) == 5
    assert len(places) == 10


def test_a_pass_that_is_left_early_ends() -> None:
    work, _, _ = view_of([(4000.0,)] * 40, np.random.default_rng(3), "paper", NOISE)
    begun = work.samples(lambda part, pool: np.zeros((8, TRIANGLES), np.uint8), 2)
    next(begun)
    begun.close()


@pytest.mark.parametrize(("leds", "exposures", "together"), [(6, 1, 6), (300, 1, 8), (300, 3, 2), (300, 20, 1)])
def test_leds_are_read_together_as_long_as_their_frames_are_few(leds: int, exposures: int, together: int) -> None:
    view = SimpleNamespace(by_led={led: [None] * exposures for led in range(leds)})
    assert ViewPass(None, view, None, None).together == together  # type: ignore[arg-type]


@pytest.mark.filterwarnings("error")
def test_of_a_triangle_without_pixels_nothing_is_known_even_of_pixels_that_are_all_alike() -> None:
    random = np.random.default_rng(6)
    _, radiometry, seen = view_of(ONE, random, "lambertian", NOISE)
    seen[seen == 7] = -1
    reader = SignalReader(radiometry, SeenSurface(seen, np.arange(TRIANGLES)))
    expected = np.zeros((TRIANGLES, 3))
    expected[7] = np.inf
    np.testing.assert_array_equal(reader.u_response, expected)
