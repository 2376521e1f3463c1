"""The recipe of a colour: shares of paints with an opaque mixture that matches a target (Duncan 1949).

K and S of a mixture are the sums of its paints' K and S, weighted by the shares. Subsets of the palette are
compared by the linear problem sum c_i (K_i - Q S_i) = 0, where Q is the target's K/S; it is weighted so that its
residuals are those of measured reflectance. The best few subsets are refined by least squares on the measured
reflectance itself, with shares that are not negative. If there are at most `_EXHAUSTIVE` subsets of a size, all
are tried. Otherwise the best subset grows paint by paint, with exchanges.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from math import comb

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.matter.glossy_face import Face, InternalReflectance, MeasuredReflectance
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from coupole.errors import InputError
from coupole.heritage.analysis.layer_fit import COVERAGE_FACTOR
from coupole.heritage.analysis.palette import Paint

_EXHAUSTIVE = 5000
_REFINED = 6
_WORTH = 16.0
"""Least improvement of a recipe by a further paint, in squared standard uncertainties, that is worth this
paint."""
_UNTOLD = 6.0
"""Difference, in squared standard uncertainties, up to which two recipes are not distinguished: 95 % of a
chi-square of two."""
TOLD_WITHIN = 0.02
"""Accuracy of a share that a recipe should have."""
_EXPLAINED = 1.5
"""Largest root mean square residual, divided by its uncertainty, with which a recipe explains the target."""
_LEAST_BANDS = 10
_DARKEST = 1e-4


@dataclass(frozen=True, eq=False)
class Recipe:
    """The best mixture of a number of paints."""

    shares: dict[str, float]
    """Shares of the paints used; they sum to 1."""
    half_widths: dict[str, float]
    """Half widths of the 95 % intervals of the shares."""
    reflectance: Array
    """[81], reflectance of the mixture, NaN in bands that were not compared."""
    rms: float
    """Root mean square of its residual."""
    misfit: float
    """The same residual, divided by the part that noise and the uncertainty of the paints' K and S explain."""
    worst: float
    """Largest difference, recipe minus target, of the mean over five bands."""
    worst_nm: float


@dataclass(frozen=True, eq=False)
class Found:
    """Recipes of 1, 2, ... paints, and the recipe that justifies its number of paints."""

    recipes: tuple[Recipe, ...]
    chosen_index: int
    """Index in `recipes`."""
    target: Array
    """[81] reflectance of the target, as measured."""
    bands: NDArray[np.bool_]
    noise: float
    rivals: tuple[dict[str, float], ...] = ()
    """Shares of other mixtures that the target does not distinguish from the recipe. Mixtures with as many paints
    or fewer agree within noise. Mixtures with one paint more are nearer by more than noise, but not by enough to
    be preferred."""

    def told_within(self, name: str) -> float:
        """Return the bound within which a share of the best recipe is known. It follows from the share's 95 %
        interval, and from the shares in rival recipes.
        """
        share = self.best.shares[name]
        apart = [abs(rival.get(name, 0.0) - share) for rival in self.rivals]
        return max(self.best.half_widths[name], *apart, 0.0)

    @property
    def best(self) -> Recipe:
        """The recipe to mix."""
        return self.recipes[self.chosen_index]

    @property
    def is_explained(self) -> bool:
        """True if noise, and the uncertainty of the paints' K and S, explain the residual of the best recipe."""
        return self.best.misfit <= _EXPLAINED

    def verdict(self) -> str:
        """Return the verdict in plain words."""
        best = self.best
        if self.is_explained:
            return f"the palette explains the target; the difference is {best.misfit:.1f} times its uncertainty"
        kind = "lighter" if best.worst > 0.0 else "darker"
        lacks = "absorbs" if best.worst > 0.0 else "absorbs less, or scatters more,"
        return (
            f"no mixture of this palette matches the target: the best one differs by {best.misfit:.1f} times its "
            f"uncertainty. The largest difference is near {best.worst_nm:g} nm, where the recipe is "
            f"{abs(best.worst):.3f} {kind}. A paint is missing that {lacks} there"
        )


def find(target: Array, palette: Sequence[Paint], face: Face, noise: float, at_most: int) -> Found:
    """Find recipes of up to `at_most` paints for `target`, [81] as measured in air, NaN where it was not measured.

    Raises InputError for a target that no paint under the face can reach, and if no band is known for all paints.
    """
    bands = np.isfinite(target) & np.all(
        [np.isfinite(paint.absorption) & np.isfinite(paint.scattering) for paint in palette], axis=0
    )
    if bands.sum() < _LEAST_BANDS:
        raise InputError(
            f"target and palette have {int(bands.sum())} common bands between 380 and 780 nm; expected "
            f"{_LEAST_BANDS} or more: leave out the paint that is known in only a few bands"
        )
    problem = _Problem(target[bands], palette, bands, face, noise)
    recipes: list[Recipe] = []
    all_fits: list[tuple[float, tuple[int, ...], Array]] = []
    before: list[tuple[int, ...]] = [()]
    for size in range(1, min(at_most, len(palette)) + 1):
        candidates = _subsets(len(palette), size, before)
        likely_subsets = sorted(candidates, key=problem.roughly)[:_REFINED]
        fits = sorted((problem.refined_shares(subset) for subset in likely_subsets), key=lambda found: found[0])
        before = [subset for _, subset, _ in fits[:3]]
        all_fits += fits
        recipes.append(problem.recipe(fits[0][1], fits[0][2]))
    choice = _choose_recipe(recipes, int(bands.sum()))
    rivals = _rivals(all_fits, choice + 1, max(1.0, recipes[choice].misfit) ** 2, palette)
    return Found(tuple(recipes), choice, target, bands, noise, rivals)


def _rivals(
    tried_recipes: Sequence[tuple[float, tuple[int, ...], Array]],
    size: int,
    scale: float,
    palette: Sequence[Paint],
) -> tuple[dict[str, float], ...]:
    """Return the shares of tried recipes that are not distinguished from the best one of a size, the nearest
    first."""
    best = min(cost for cost, subset, _ in tried_recipes if len(subset) == size)
    rivals = []
    for cost, subset, shares in sorted(tried_recipes, key=lambda one: one[0]):
        worse = (cost - best) / scale
        near = worse < _UNTOLD if len(subset) <= size else len(subset) == size + 1 and worse < -_UNTOLD
        if near and not (len(subset) == size and cost == best):
            rivals.append({palette[i].name: float(share) for i, share in zip(subset, shares, strict=True)})
    return tuple(rivals)


def _subsets(count: int, size: int, before: Sequence[tuple[int, ...]]) -> Iterable[tuple[int, ...]]:
    if comb(count, size) <= _EXHAUSTIVE:
        return combinations(range(count), size)
    supersets = {tuple(sorted({*subset, new})) for subset in before for new in range(count) if new not in subset}
    if len(supersets) * size * count > 10 * _EXHAUSTIVE:
        return supersets
    all_indices = range(count)
    return supersets | {
        tuple(sorted({*subset, new} - {old}))
        for subset in supersets
        for old in subset
        for new in all_indices
        if new not in subset
    }


def _choose_recipe(recipes: Sequence[Recipe], bands: int) -> int:
    """Return the index of the first recipe that a further paint does not improve beyond noise. If the largest
    recipe does not explain the target, its misfit counts as the noise."""
    scale = max(1.0, recipes[-1].misfit)
    for number, (recipe, more) in enumerate(pairwise(recipes)):
        if bands * (recipe.misfit**2 - more.misfit**2) / scale**2 < _WORTH:
            return number
    return len(recipes) - 1


class _Problem:
    """The target, and the best recipes from subsets of the palette."""

    def __init__(
        self, target: Array, palette: Sequence[Paint], bands: NDArray[np.bool_], face: Face, noise: float
    ) -> None:
        self.target, self.palette, self.bands, self.noise = target, palette, bands, noise
        self.face = Face(
            *(np.broadcast_to(part, bands.shape)[bands] for part in (face.passing, face.inner, face.gloss))
        )
        self.k = np.stack([paint.absorption[bands] for paint in palette], axis=1)
        self.s = np.stack([paint.scattering[bands] for paint in palette], axis=1)
        clipped_target = np.clip(target, self.face.gloss, self.face.brightest * (1.0 - 1e-6))
        if np.abs(clipped_target - target).max() > 5.0 * noise:
            at = int(np.argmax(np.abs(clipped_target - target)))
            raise InputError(
                f"the target is {target[at]:.3g} at {WAVELENGTHS_NM[bands][at]:g} nm, a value that no paint "
                "under this face can have: check whether gloss is included, and whether values are percent or "
                "fractions"
            )
        inside = np.maximum(self.face.inside(MeasuredReflectance(clipped_target)).values, _DARKEST)
        q = kubelka_munk.k_over_s(inside)
        # dR/dQ inside, then d(seen)/dR: residuals of the linear problem are about the residuals of the seen
        # reflectance.
        slope = inside / np.sqrt(np.maximum(q * (q + 2.0), 1e-9))
        slope = slope * self.face.passing / (1.0 - self.face.inner * inside) ** 2
        self.system = slope[:, None] * (self.k - q[:, None] * self.s)

    def roughly(self, subset: tuple[int, ...]) -> float:
        """Root mean square residual of the mixture from the linear problem."""
        shares = self._linear(subset)
        return float(np.mean((self._mixture_reflectance(subset, shares) - self.target) ** 2))

    def refined_shares(self, subset: tuple[int, ...]) -> tuple[float, tuple[int, ...], Array]:
        """Squared residuals divided by their variances, and shares that are not negative."""
        from scipy.optimize import least_squares

        if len(subset) == 1:
            return self._cost(subset, np.ones(1)), subset, np.ones(1)
        start = np.maximum(self._linear(subset), 1e-6)
        u = np.sqrt(self.noise**2 + self._of_palette(subset, start / start.sum()))
        solution = least_squares(
            lambda c: np.append((self._mixture_reflectance(subset, c) - self.target) / u, c.sum() - 1.0),
            start / start.sum(),
            bounds=(0.0, 2.0),
            x_scale=np.maximum(start / start.sum(), 1e-3),
        )
        shares = solution.x / solution.x.sum()
        return 2.0 * float(solution.cost), subset, shares

    def _cost(self, subset: tuple[int, ...], shares: Array) -> float:
        u2 = self.noise**2 + self._of_palette(subset, shares)
        return float(np.sum((self._mixture_reflectance(subset, shares) - self.target) ** 2 / u2))

    def recipe(self, subset: tuple[int, ...], shares: Array) -> Recipe:
        reflectance = self._mixture_reflectance(subset, shares)
        residuals = reflectance - self.target
        smooth = np.convolve(residuals, np.ones(5) / 5.0, mode="same")
        at = int(np.argmax(np.abs(smooth)))
        whole = np.full(len(self.bands), np.nan)
        whole[self.bands] = reflectance
        names = [self.palette[i].name for i in subset]
        variance = self.noise**2 + self._of_palette(subset, shares)
        misfit = float(np.sqrt(np.mean(residuals**2 / variance)))
        widths = COVERAGE_FACTOR * self._uncertainty(subset, shares, max(1.0, misfit) ** 2 * variance)
        return Recipe(
            dict(zip(names, map(float, shares), strict=True)),
            dict(zip(names, map(float, widths), strict=True)),
            whole,
            float(np.sqrt(np.mean(residuals**2))),
            misfit,
            float(smooth[at]),
            float(WAVELENGTHS_NM[self.bands][at]),
        )

    def _linear(self, subset: tuple[int, ...]) -> Array:
        from scipy.optimize import nnls

        if len(subset) == 1:
            return np.ones(1)
        columns = list(subset)
        size = self.s[:, columns].mean(axis=0)
        system = self.system[:, columns] / size
        heavy = 10.0 * np.abs(system).max() + 1e-9
        amounts, _ = nnls(
            np.vstack([system, np.full(len(subset), heavy)]), np.append(np.zeros(len(system)), heavy)
        )
        return np.asarray(amounts / size / (amounts / size).sum())

    def _mixture_reflectance(self, subset: tuple[int, ...], shares: Array) -> Array:
        columns = list(subset)
        k, s = self.k[:, columns] @ shares, self.s[:, columns] @ shares
        return self.face.reflectance_in_air(InternalReflectance(kubelka_munk.opaque(k / s))).values

    def _uncertainty(self, subset: tuple[int, ...], shares: Array, variance: Array) -> Array:
        """Standard uncertainty of the shares, from the variance [bands] of recipe minus target."""
        count = len(subset)
        if count == 1:
            return np.zeros(1)
        step = 1e-6
        slopes = np.stack(
            [
                (self._mixture_reflectance(subset, shares + step * e) - self._mixture_reflectance(subset, shares))
                / step
                for e in np.eye(count)
            ],
            axis=1,
        )
        # Shares sum to 1: only changes within that plane count.
        _, _, rows = np.linalg.svd(np.ones((1, count)))
        plane = rows[1:].T
        weight = 1.0 / np.sqrt(variance)
        gain = plane @ np.linalg.pinv(weight[:, None] * (slopes @ plane)) * weight
        return np.asarray(np.sqrt(np.einsum("ib,b,ib->i", gain, variance, gain)))

    def _of_palette(self, subset: tuple[int, ...], shares: Array) -> Array:
        """Variance [bands] of the measured reflectance from K and S of the paints."""
        columns = list(subset)
        k, s = self.k[:, columns] @ shares, self.s[:, columns] @ shares
        variance = np.zeros(len(k))
        for i, share in zip(subset, shares, strict=True):
            paint = self.palette[i]
            for u, at in ((paint.u_absorption, (1.0, 0.0)), (paint.u_scattering, (0.0, 1.0))):
                step = 1e-6 * (k + s)
                reflectance = kubelka_munk.opaque((k + at[0] * step) / (s + at[1] * step))
                change = self.face.reflectance_in_air(
                    InternalReflectance(reflectance)
                ).values - self._mixture_reflectance(subset, shares)
                variance += (change / step * share * u[self.bands]) ** 2
        return variance
