"""Proves the intervals of `coupole layer`: specimens with 0.5 % noise, by the matrix exponential and by photons.

    python tools/prove_layers.py [--rounds N] [--photons N]

Of each kind of films (two grounds, opaque and thin, a series) for several paints it prints how often the 95 %
interval holds the truth, and of a walk of photons how often that of the reflectance over another ground does, and
how far K and S of a film are off for twice its thickness, where two fluxes are a model. Exits with 1 if the mean
of a kind is outside 93 to 97 %, but not with `--smallest`, whose means say nothing.
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
from coupole.heritage.analysis import layer_fit  # noqa: E402
from coupole.heritage.analysis.layer_fit import COVERAGE_FACTOR, Film  # noqa: E402
from smallest import add_smallest  # noqa: E402

PAINTS = ((0.2, 20.0), (2.0, 20.0), (10.0, 20.0), (20.0, 20.0), (5.0, 60.0))
KINDS = ("two grounds", "opaque and thin", "series")
DEPTHS, ABSORBED = (0.5, 1.0, 2.0, 5.0), (0.002, 0.02, 0.1)
DRAWS = 1000


def coverage(kind: str, rounds: int) -> float:
    """Mean over the paints of the share of K and S in their intervals, in bands that tell them."""
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


def photons(count: int) -> tuple[float, float]:
    """Coverage of the reflectance over another ground, and the largest error for twice the thickness."""
    rng, shares, worst = np.random.default_rng(22), [], 0.0
    for depth in DEPTHS:
        thin, thick = walk(depth, count, 1), walk(2.0 * depth, count, 2)
        for absorption in ABSORBED:
            exact = {g: thin.reflectance(absorption, g) for g in (cases.BLACK, cases.WHITE, 0.5)}
            ends = [
                Film(exact[g] + cases.NOISE * rng.standard_normal(DRAWS), np.full(DRAWS, g), str(g))
                for g in (cases.BLACK, cases.WHITE)
            ]
            prediction = layer_fit.predict(layer_fit.fit(ends, BARE, cases.NOISE), BARE, 1.0, 0.5)
            shares.append(np.mean(np.abs(prediction.seen - exact[0.5]) < COVERAGE_FACTOR * prediction.u_seen))
            sharp = [Film(np.array([exact[g]]), np.array([g]), str(g)) for g in (cases.BLACK, cases.WHITE)]
            sharp_fit = layer_fit.fit(sharp, BARE, 1e-4)
            for g in (cases.BLACK, cases.WHITE):
                twice = layer_fit.predict(sharp_fit, BARE, 2.0, g).seen[0] - thick.reflectance(absorption, g)
                worst = max(worst, abs(float(twice)))
            print(f"  photons, depth {depth:g}, absorbed {absorption:g}: {100 * shares[-1]:.1f} %")
    return float(np.mean(shares)), worst


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--photons", type=int, default=300_000, help="of each walk")
    add_smallest(parser, rounds=2, photons=3000)
    options = parser.parse_args()
    means = {kind: coverage(kind, options.rounds) for kind in KINDS}
    means["photons, another ground"], worst = photons(options.photons)
    for kind, mean in means.items():
        print(f"{kind}: 95 % intervals hold {100 * mean:.1f} %")
    print(f"K and S of a film miss twice its thickness by up to {worst:.3f} of full reflectance")
    return int(not options.smallest and not all(0.93 <= mean <= 0.97 for mean in means.values()))


if __name__ == "__main__":
    sys.exit(main())
