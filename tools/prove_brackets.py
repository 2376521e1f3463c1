"""Proves the intervals of `coupole bracket`: random cameras photograph one scene in steps of 2, 4 and 8.

    python tools/prove_brackets.py [--cameras N]

A camera's response is a power of 1 to 1/2.6 with a random toe, shoulder and bend, the same for each channel, or
one of three fixed responses (sRGB, linear, and a wave on a power). The noise is 0.5, 1 or 2 levels of 8 bits. The
unit of a picture is half of the largest value in one second; it is not fitted here.

For each step this prints the share of pixels that are within 1.96 u of the scene, also for the worst and the best
camera; the error of responses between 5 and 95 % of the values; and how often their 95 % intervals contain the
truth. Exits with 1 if a step's share of pixels is outside 93 to 97 %, but not with `--smallest`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from coupole.exchange.bracket import camera_response, exposure_merging  # noqa: E402
from coupole.exchange.bracket.photographs import Photographs  # noqa: E402
from smallest import add_smallest  # noqa: E402

STEPS = (2.0, 4.0, 8.0)
LEVELS = 255
NOISES = (0.5, 1.0, 2.0)
LEAST, MOST = 0.93, 0.97
_FINE = np.linspace(0.0, 1.0, 200_001)
_COVERAGE_FACTOR = 1.96
Curve = Callable[[np.ndarray], np.ndarray]


def srgb(v: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1."""
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 1e-9) ** (1 / 2.4) - 0.055)


def wavy(v: np.ndarray) -> np.ndarray:
    return np.asarray(v**0.55 * (1.0 + 0.06 * np.sin(2.0 * np.pi * v**0.55)))


def straight(v: np.ndarray) -> np.ndarray:
    return v


def drawn_curve(rng: np.random.Generator) -> Curve:
    """A rising response."""
    while True:
        power = 1.0 / rng.uniform(1.0, 2.6)
        shoulder, toe, bend = rng.uniform(-0.25, 0.45), rng.uniform(-0.5, 0.4), rng.uniform(-0.3, 0.3)

        def curve(
            v: np.ndarray, p: float = power, s: float = shoulder, t: float = toe, b: float = bend
        ) -> np.ndarray:
            x = v**p
            return np.asarray(
                x + x * (1.0 - x) * (s * np.sin(np.pi * x) + t * (1.0 - 2.0 * x)) + b * x**2 * (1.0 - x)
            )

        values = curve(_FINE[20:])
        if (np.diff(values) > 1e-6).all() and values.max() <= 1.0 + 1e-9:
            return curve


def scene(rng: np.random.Generator) -> np.ndarray:
    """[80, 120, 3] radiance over a range of about 1 : 500, with varying colours."""
    y, x = np.mgrid[:80, :120] / 80.0
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    colours = [1.0 + 0.3 * np.sin(3.0 * x + 2.0 * y + phase) for phase in phases]
    return np.asarray(
        np.exp(3.2 * (x - 1.0) + 0.4 * np.sin(9.0 * y))[..., None] * np.stack(colours, axis=2) * [0.9, 0.7, 0.4]
    )


def try_camera(
    curve: Curve, step: float, noise_levels: float, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Return the share of pixels within their intervals, the greatest error of the response, and how often its
    intervals contain the truth."""
    times = step ** np.arange(np.ceil(-4.0 / np.log2(step)), 4.0 / np.log2(step) - 1e-9)
    radiance = scene(rng)
    exposures = np.clip(0.5 * radiance * times[:, None, None, None], 0.0, 1.0)
    noisy = np.clip(curve(exposures) + rng.normal(0.0, noise_levels / LEVELS, exposures.shape), 0.0, 1.0)
    values = (np.rint(LEVELS * noisy) / LEVELS).astype(np.float32)
    photographs = Photographs((), values, times, LEVELS + 1, raw=False)
    response = camera_response.found_response(photographs)
    picture = exposure_merging.merge_exposures(photographs, response)
    curve_values = curve(_FINE)
    middle = camera_response.NODES // 2 / (camera_response.NODES - 1)
    unit = 0.5 / np.interp(middle, curve_values, _FINE)
    is_known = np.isfinite(picture.uncertainty)
    off = np.abs(picture.radiance[is_known] / (radiance[is_known] * unit) - 1.0)
    shares = float((off < _COVERAGE_FACTOR * picture.uncertainty[is_known]).mean())
    nodes = slice(13, 243)
    z = np.linspace(0.0, 1.0, camera_response.NODES)
    true = np.log(np.interp(z[nodes], curve_values, _FINE)) - np.log(np.interp(middle, curve_values, _FINE))
    log_misses = np.abs(response.log_exposure[nodes] - true[:, None])
    is_shown = np.isfinite(response.uncertainty[nodes])
    hold = log_misses[is_shown] < _COVERAGE_FACTOR * np.maximum(response.uncertainty[nodes][is_shown], 1e-4)
    return shares, float(log_misses[is_shown].max()), float(hold.mean())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cameras", type=int, default=16)
    add_smallest(parser, cameras=1)
    options = parser.parse_args()
    good = True
    for step in STEPS:
        rng = np.random.default_rng(6)
        curves = [srgb, straight, wavy, *(drawn_curve(rng) for _ in range(options.cameras))][-options.cameras :]
        rows = np.array(
            [try_camera(curve, step, NOISES[number % len(NOISES)], rng) for number, curve in enumerate(curves)]
        )
        pixels, _, hold = rows.mean(axis=0)
        good &= LEAST <= pixels <= MOST
        worst, typical = 100 * rows[:, 1].max(), 100 * np.median(rows[:, 1])
        print(
            f"steps of {step:g}: {100 * pixels:.1f} % of pixels within 1.96 u ({100 * rows[:, 0].min():.0f} to "
            f"{100 * rows[:, 0].max():.0f} % of one camera); response off by up to {typical:.1f} % in the median "
            f"camera, {worst:.1f} % in the worst; its intervals hold {100 * hold:.0f} %; {len(rows)} cameras"
        )
    return int(not options.smallest and not good)


if __name__ == "__main__":
    sys.exit(main())
