"""Proves the intervals of `coupole layer`: specimens with 0.5 % noise, by the matrix exponential and by photons.

    python tools/prove_layers.py [--rounds N] [--photons N]

For each kind of films (two grounds, opaque and thin, a series) and several paints, this prints how often the 95 %
interval contains the truth. For a random walk of photons, it prints how often the interval of the reflectance over
another ground contains the truth. At other thicknesses two-flux theory is only approximate. There it prints, for
grains of three mean cosines, how often the interval of the film that `--at-um` predicts contains the photons'
result, with the model's error and without it.

Exits with 1 if the mean of a kind is outside 93 to 97 %, or below 93 % at other thicknesses. With `--smallest` the
means are not meaningful, and the exit code is 0.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "heritage")]

import test_layer_fit as cases  # noqa: E402
from painted_films import walk  # noqa: E402

from coupole.appearance.matter.glossy_face import BARE  # noqa: E402
from coupole.heritage.analysis import layer_fit, other_thickness  # noqa: E402
from coupole.heritage.analysis.layer_fit import COVERAGE_FACTOR, Film  # noqa: E402
from smallest import add_smallest  # noqa: E402

PAINTS = ((0.2, 20.0), (2.0, 20.0), (10.0, 20.0), (20.0, 20.0), (5.0, 60.0))
KINDS = ("two grounds", "opaque and thin", "series")
DEPTHS, ABSORBED = (0.5, 1.0, 2.0, 5.0), (0.002, 0.02, 0.1)
"""Optical depths, and absorption, of grains that scatter isotropically; other grains are scaled to the same
diffusion."""
GROUNDS, TIMES, MEAN_COSINES = (cases.BLACK, cases.WHITE), (0.5, 2.0, 4.0), (0.0, 0.5, 0.8)
DRAWS = 1000
LEAST, MOST = 0.93, 0.97


def coverage(kind: str, rounds: int) -> float:
    """Mean, over the paints, of the share of K and S within their intervals, in the bands that determine them."""
    rng, shares = np.random.default_rng(21), []
    for k, s in PAINTS:
        inside = []
        for _ in range(rounds):
            fit = layer_fit.fit(cases.films_of(kind, k, s, rng), cases.FACE, cases.NOISE)
            sure = fit.determined_bands
            inside += [
                np.abs(fit.absorption - k)[sure] < COVERAGE_FACTOR * fit.u_absorption[sure],
                np.abs(fit.scattering - s)[sure] < COVERAGE_FACTOR * fit.u_scattering[sure],
            ]
        values = np.concatenate(inside)
        if len(values) < 0.5 * 2 * rounds * cases.EACH:
            print(f"  {kind}, K {k:g}, S {s:g} per mm: hides its ground, or shows too little; not told")
            continue
        print(f"  {kind}, K {k:g}, S {s:g} per mm: {100 * values.mean():.1f} %")
        shares.append(values.mean())
    return float(np.mean(shares))


def photons(count: int) -> float:
    """Return the coverage of the reflectance over another ground."""
    rng, shares = np.random.default_rng(22), []
    for depth in DEPTHS:
        photon_walk = walk(depth, count, 1)
        for absorption in ABSORBED:
            exact = {g: photon_walk.reflectance(absorption, g) for g in (*GROUNDS, 0.5)}
            fit = layer_fit.fit(noisy_films(exact, rng), BARE, cases.NOISE)
            prediction = layer_fit.predict(fit, BARE, 1.0, 0.5)
            shares.append(np.mean(np.abs(prediction.seen - exact[0.5]) < COVERAGE_FACTOR * prediction.u_seen))
            print(f"  photons, depth {depth:g}, absorbed {absorption:g}: {100 * shares[-1]:.1f} %")
    return float(np.mean(shares))


def noisy_films(exact: dict[float, float], rng: np.random.Generator) -> list[Film]:
    """Films over both grounds, measured `DRAWS` times."""
    return [
        Film(exact[g] + cases.NOISE * rng.standard_normal(DRAWS), np.full(DRAWS, g), str(g), 0.0) for g in GROUNDS
    ]


def other_thicknesses(count: int) -> float:
    """Return the least coverage of a mean cosine, over all depths, absorptions, thicknesses and grounds."""
    rng, least = np.random.default_rng(23), 1.0
    for mean_cosine in MEAN_COSINES:
        shares, shares_without, largest = [], [], 0.0
        for depth in DEPTHS[:-1]:
            walks = {
                times: walk(times * depth / (1.0 - mean_cosine), count, 4, mean_cosine) for times in (1.0, *TIMES)
            }
            for absorption in ABSORBED:
                exact = {
                    times: {g: photon_walk.reflectance(absorption * (1.0 - mean_cosine), g) for g in GROUNDS}
                    for times, photon_walk in walks.items()
                }
                films = noisy_films(exact[1.0], rng)
                fit = layer_fit.fit(films, BARE, cases.NOISE)
                for film in other_thickness.films_at(fit, films, BARE, TIMES):
                    off = film.reflectance - exact[film.thickness_mm][float(film.ground_name)]
                    off, u, u_without = (a[np.isfinite(off)] for a in (off, film.u_reflectance, film.u_measured))
                    if len(off) < DRAWS // 2:
                        continue  # the film hides its ground
                    shares.append(np.mean(np.abs(off) < COVERAGE_FACTOR * u))
                    shares_without.append(np.mean(np.abs(off) < COVERAGE_FACTOR * u_without))
                    largest = max(largest, abs(float(np.median(off))))
        print(
            f"  photons, other thicknesses, mean cosine {mean_cosine:g}: {100 * np.mean(shares):.1f} % "
            f"({100 * np.mean(shares_without):.1f} % without the model's error, which is up to {largest:.3f}); "
            f"{100 * min(shares):.0f} % in the worst of {len(shares)} films"
        )
        least = min(least, float(np.mean(shares)))
    return least


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--photons", type=int, default=300_000, help="of each walk")
    add_smallest(parser, rounds=2, photons=3000)
    options = parser.parse_args()
    means = {kind: coverage(kind, options.rounds) for kind in KINDS}
    means["photons, another ground"] = photons(options.photons)
    least = other_thicknesses(options.photons // 3)
    for kind, mean in means.items():
        print(f"{kind}: 95 % intervals hold {100 * mean:.1f} %")
    print(f"photons, other thicknesses: 95 % intervals hold at least {100 * least:.1f} %")
    holds = least >= LEAST and all(LEAST <= mean <= MOST for mean in means.values())
    return int(not options.smallest and not holds)


if __name__ == "__main__":
    sys.exit(main())
