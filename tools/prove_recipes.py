"""Shares that `coupole recipe` finds in random mixtures of measured oil paints, beside what the noise allows.

    python tools/prove_recipes.py oilpaint.rs [--mixtures 60] [--noise 0.002]

Mixtures of three of the library's paints, their shares drawn evenly from all that sum to 1, are seen in air with
noise in each band. For each share the Cramer-Rao bound is computed: the least standard deviation of an unbiased
estimate that knows the three paints. The output is the number of shares that are found within 2 %, the number that
an estimate at the bound would find, and the errors relative to the bound. Exits with 1 if the errors are at least
1.3 times the bound where the right paints were chosen; not with `--smallest`, whose errors are not meaningful.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.stats import norm

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from coupole.appearance.matter import kubelka_munk  # noqa: E402
from coupole.appearance.matter.glossy_face import Face, InternalReflectance, face  # noqa: E402
from coupole.heritage.analysis import recipe_search  # noqa: E402
from coupole.heritage.analysis.palette import Paint, read_palette  # noqa: E402
from smallest import add_smallest  # noqa: E402

WITHIN, WORST_RATIO = 0.02, 1.3
_STEP = 1e-6
_SEED = 11


def mixture_reflectance(shares: np.ndarray, chosen_paints: list[Paint], under: Face) -> np.ndarray:
    """Return the reflectance of a mixture, with NaN in bands that are missing for a paint."""
    k, s = (
        np.asarray(sum(c * getattr(p, coefficient) for c, p in zip(shares, chosen_paints, strict=True)))
        for coefficient in ("absorption", "scattering")
    )
    finite = np.isfinite(k + s)
    spectrum = under.reflectance_in_air(
        InternalReflectance(kubelka_munk.opaque(np.where(finite, k, 1.0) / np.where(finite, s, 1.0)))
    )
    return np.where(finite, spectrum.values, np.nan)


def bound(shares: np.ndarray, chosen: list[Paint], under: Face, noise: float, bands: np.ndarray) -> np.ndarray:
    """Least standard deviations of the shares, which sum to 1: the inverse of Fisher's information in that plane
    (Stoica, Ng, IEEE Signal Processing Letters 5(7), 1998)."""
    middle = mixture_reflectance(shares, chosen, under)
    slopes = [
        (mixture_reflectance(shares + _STEP * e, chosen, under) - middle)[bands] / _STEP
        for e in np.eye(len(shares))
    ]
    plane = np.linalg.svd(np.ones((1, len(shares))))[2][1:].T
    within = np.stack(slopes, axis=1) @ plane
    return np.sqrt(np.diag(plane @ np.linalg.inv(within.T @ within) @ plane.T)) * noise


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("library", type=Path)
    parser.add_argument("--mixtures", type=int, default=60)
    parser.add_argument("--noise", type=float, default=0.002)
    add_smallest(parser, mixtures=2)
    arguments = parser.parse_args()
    palette, under = read_palette([arguments.library]), face(1.5, "gloss excluded")
    rng = np.random.default_rng(_SEED)
    bands = np.all([np.isfinite(p.absorption + p.scattering) for p in palette], axis=0)
    least, errors, widths, half, right = [], [], [], [], []
    for _ in range(arguments.mixtures):
        paints = [palette[k] for k in rng.choice(len(palette), 3, replace=False)]
        shares = rng.dirichlet(np.ones(3))
        noisy = mixture_reflectance(shares, paints, under) + arguments.noise * rng.standard_normal(len(bands))
        recipes = recipe_search.find(noisy, palette, under, arguments.noise, 4)
        least += list(bound(shares, paints, under, arguments.noise, bands))
        names = {paint.name for paint in paints}
        half += [recipes.best.half_widths.get(p.name, np.nan) for p in paints]
        right += [set(recipes.best.shares) == names] * 3
        errors += [recipes.best.shares.get(p.name, 0.0) - share for p, share in zip(paints, shares, strict=True)]
        widths += [recipes.told_within(p.name) if p.name in recipes.best.shares else np.nan for p in paints]
    u, off, same = np.array(least), np.abs(errors), np.array(right)
    interval, narrow = np.array(half), np.array(widths) <= WITHIN
    ratio = float(np.median(off[same] / u[same]) / norm.ppf(0.75))
    print(f"{len(off)} shares, noise {arguments.noise:g}, {int(bands.sum())} bands")
    print(
        f"within 2 %: {100 * np.mean(off < WITHIN):.0f} %; by an estimate at the bound, which knows the paints: "
        f"{100 * np.mean(1 - 2 * norm.sf(WITHIN / u)):.0f} %"
    )
    print(
        f"least 95 % interval wider than 2 %: {100 * np.mean(1.96 * u > WITHIN):.0f} % of the shares; of others "
        f"{100 * np.mean(off[1.96 * u <= WITHIN] < WITHIN):.0f} % come back within 2 %"
    )
    print(
        f"the right paints in {100 * np.mean(same):.0f} %; of these {100 * np.mean(off[same] < WITHIN):.0f} % are "
        f"within 2 % (bound: {100 * np.mean(1 - 2 * norm.sf(WITHIN / u[same])):.0f} %), "
        f"{100 * np.mean(off[same] < interval[same]):.0f} % in their intervals, errors {ratio:.2f} times the bound"
    )
    print(
        f"said to be told within 2 %: {100 * np.mean(narrow):.0f} % of the shares, of which "
        f"{100 * np.mean(off[narrow] < WITHIN):.0f} % are"
    )
    return int(not arguments.smallest and ratio > WORST_RATIO)


if __name__ == "__main__":
    sys.exit(main())
