"""Shares of the parts of the veil (veiling glare), from pictures of black traps beside white.

A trap shows t W + sum over k of a_k B_k. The first term is the trap's own light: the share t of the white W beside
it. Each other term is the light that one part of the veil (`veil.py`) brings to the trap from the own light of the
whole picture. The shares a_k are found by least squares; none is below 0.

Own light means light without the veil. Therefore own light and veil are computed in turn, for some rounds.

Noise, and errors of the veil's form, become visible when the traps of a view are predicted by a fit without that
view. Therefore each view is left out in turn: this gives the covariance and the remaining error (Bell and
McCaffrey's CR3 of clusters).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.glare_traps import Trap
from coupole.calibration.light.veil import (
    PARTS,
    at_pixels,
    block_px_of,
    light_of_blocks,
    of_white,
    parts_of,
    veil_of,
)
from coupole.errors import InputError

Floats = NDArray[np.float64]

LEAST_VIEWS, LEAST_TRAPS = 3, 12
"""Fewest views, and fewest traps of all views together."""
U_NEAR = 0.15
"""Relative standard uncertainty of the nearest part of the veil. It covers light that stays nearer to its source
than the rims of the traps, where blur hides it. For a lobe with half of its core there, the result was 13 % too
small."""
_LEAST_SPREAD = 0.35
"""Least extent of the traps' positions, as a share of the picture's width. Traps in one place do not show the
glare in other places."""
_LEAST_VEIL = 1e-6
"""Least veil, as a share of white, whose error is also stated as a relative error. A fit without a view may
predict no veil; then there is no relative error."""
_ROUNDS = 4


@dataclass(frozen=True)
class TrapView:
    """One channel of one picture of the target."""

    name: str
    light: Floats
    """[block rows, block columns] DN/s, with the veil."""
    traps: tuple[Trap, ...]
    dark: Floats
    """[2 traps] DN/s in the traps: the outer and the inner part of each trap."""
    beside: Floats
    """[2 traps] DN/s of the white beside each trap, with its veil."""
    size_px: tuple[int, int]
    """Width and height."""


@dataclass(frozen=True)
class TrapLight:
    """Own light of a trap, divided by the own light of the white beside it."""

    share: float
    u: float


@dataclass(frozen=True)
class GlareFit:
    """Shares of the veil's parts in one channel."""

    channel: str
    shares: Floats
    """[parts]"""
    covariance: Floats
    """[parts, parts]"""
    degrees_of_freedom: float
    u_form: float
    """Relative standard uncertainty of the veil, caused by errors of its form. It is the rms relative difference
    between the traps of a left-out view and their prediction, in the worst view."""
    predicted_veil: Floats
    """[n] veil at each trap, over the white beside it, predicted by a fit without its view."""
    found_veil: Floats
    """[n] measured veil at each trap, over the white beside it."""
    pixels: Floats
    """[n, 2] x, y of the traps."""
    size_px: tuple[int, int]

    @property
    def off(self) -> float:
        """Root mean square of `found_veil` minus `predicted_veil`, as a share of white."""
        return float(np.sqrt(np.mean((self.found_veil - self.predicted_veil) ** 2)))

    def index(self, pixels: Floats) -> tuple[Floats, Floats]:
        """Return [n] the light at a black point at pixels [n, 2] in a completely white picture, as a share of
        white, and its standard uncertainty."""
        weights = of_white(self.size_px, pixels)
        value = weights @ self.shares
        u = np.sqrt(np.einsum("ni,ij,nj->n", weights, self.covariance, weights) + (self.u_form * value) ** 2)
        return value, u


def trap_view(name: str, signal: NDArray[np.float32], mask: NDArray[np.bool_], traps: Sequence[Trap]) -> TrapView:
    """Read one channel of a picture: the pixels of `mask` [h, w] in the linear signal [h, w] above dark, in any
    unit."""
    offsets = np.argwhere(mask[:2, :2])

    def mean(cells: NDArray[np.intp]) -> float:
        rows, columns = (cells[:, None] + offsets).reshape(-1, 2).T
        return float(signal[rows, columns].mean(dtype=np.float64))

    height, width = signal.shape
    return TrapView(
        name,
        light_of_blocks(signal, mask, block_px_of(width)),
        tuple(traps),
        np.array([mean(cells) for trap in traps for cells in (trap.outer, trap.inner)]),
        np.repeat([mean(trap.beside) for trap in traps], 2),
        (width, height),
    )


def fit_glare(views: Sequence[TrapView], trap_light: TrapLight, channel: str) -> GlareFit:
    """Find the shares of the veil's parts. Raises InputError if there are too few views or traps, if all traps are
    in one place, or if the traps show no veil."""
    _refuse_few(views)
    shares, equations = np.zeros(len(PARTS)), []
    for _ in range(_ROUNDS):
        equations = [_equations(view, shares, trap_light.share) for view in views]
        shares = _solve(equations)
    without = np.stack([_solve([*equations[:n], *equations[n + 1 :]]) for n in range(len(views))])
    count = len(views)
    off = without - without.mean(axis=0)
    covariance = (count - 1) / count * off.T @ off
    # If the traps' own light is brighter, all shares are smaller.
    by_trap = shares - _solve([_equations(view, shares, trap_light.share + trap_light.u) for view in views])
    covariance += np.outer(by_trap, by_trap)
    predicted_veil = np.concatenate([design @ a for (design, _), a in zip(equations, without, strict=True)])
    found_veil = np.concatenate([values for _, values in equations])
    if not shares.any():
        raise InputError(
            f"glare: {channel}: the traps have no more light than their own {trap_light.share:.2%} of white; is "
            "`trap_share` of the target's description too high, or the dark frames of another exposure?"
        )
    near = PARTS.index("near")
    covariance[near, near] += (U_NEAR * shares[near]) ** 2
    pixels = np.array([middle for view in views for trap in view.traps for middle in [trap.middle_px] * 2])
    return GlareFit(
        channel,
        shares,
        covariance,
        count - 1.0,
        _worst_view(views, (found_veil - predicted_veil) / np.maximum(predicted_veil, _LEAST_VEIL)),
        predicted_veil,
        found_veil,
        pixels,
        views[0].size_px,
    )


def _worst_view(views: Sequence[TrapView], off: Floats) -> float:
    """Return the root mean square of the errors `off` [2 traps of all views] in the worst view."""
    ends = np.cumsum([len(view.dark) for view in views])
    return max(float(np.sqrt(np.mean(part**2))) for part in np.split(off, ends[:-1]))


def _equations(view: TrapView, shares: Floats, trap_share: float) -> tuple[Floats, Floats]:
    """Return [2 traps, parts] the veil of each part at the traps, and [2 traps] the measured veil there. Both are
    divided by the own light of the white beside."""
    width = view.size_px[0]
    block_px = block_px_of(width)
    veil = veil_of(view.light, shares, width / block_px)
    parts = parts_of(view.light - veil, width / block_px)
    at_traps = np.stack(
        [
            at_pixels(np.concatenate([parts, veil[None]]), cells[:, 0], cells[:, 1], block_px).mean(axis=1)
            for trap in view.traps
            for cells in (trap.outer, trap.inner)
        ]
    )
    beside = view.beside - at_traps[:, -1]
    return at_traps[:, :-1] / beside[:, None], view.dark / beside - trap_share


def _solve(equations: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Return [parts] shares, none below 0."""
    from scipy.optimize import nnls

    design, values = (np.concatenate(part) for part in zip(*equations, strict=True))
    return np.asarray(nnls(design, values)[0])


def _refuse_few(views: Sequence[TrapView]) -> None:
    traps = [trap for view in views for trap in view.traps]
    if len(views) < LEAST_VIEWS or len(traps) < LEAST_TRAPS:
        raise InputError(
            f"glare: expected {LEAST_VIEWS} views or more with {LEAST_TRAPS} black traps in all, each with white "
            f"all around it, found {len(traps)} traps in {len(views)} views; show the target as in "
            "`coupole plan new glare`"
        )
    pixels = np.array([trap.middle_px for trap in traps])
    spread_share = float(np.ptp(pixels, axis=0).max()) / views[0].size_px[0]
    if spread_share < _LEAST_SPREAD:
        raise InputError(
            f"glare: expected traps over at least {_LEAST_SPREAD:.0%} of the picture's width, found them over "
            f"{spread_share:.0%}; glare differs from place to place: shift the target, or take one with more traps"
        )
