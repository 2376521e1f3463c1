"""Suspected errors in the model of an LED's image: shifts of spots that a plain adjustment has no term for.

A primary lens on a die shifts its image across the die's normal, towards the viewer, in proportion to the sine of
the angle between both. A shift along the ray is not seen, so this is a change of height by the cosine: the part of
it that all views share looks like another height of the LED. A lens that is not round, or a reflecting wall of the
package, shifts the image by another linear function of the direction. Spots of LEDs are far out of the focus in
which the camera was calibrated: their picture may be larger than the record says, either as a whole, or more so
for near LEDs (a pupil that is vignetted, or elsewhere).

Each suspect is a set of modes, whose coefficients are first estimated freely beside all other unknowns. The
variance under which these estimates are most likely is their prior variance in the second adjustment (empirical
Bayes; Efron and Morris, J. Am. Stat. Assoc. 68, 1973). Of the primary lens it is the square of the estimate and
its variance together: by likelihood, a lens of once to three times its uncertainty would be taken for none in too
many cells, and each mm of it moves the heights by 0.7 mm. A lens never shifts an image away from the viewer, so a
negative estimate counts as 0 here; if it is sure, the record is refused. The other suspects move the LEDs by less;
they are left out if noise alone gives such estimates in a tenth of all cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from coupole.calibration import optics
from coupole.calibration.rotations import Floats

PRIMARY, OVAL, FIELD = "primary lens", "lens not round", "field out of focus"
GROWTH, NEAR_MM = 1e-4, 1000.0
"""Unit of the growth of the picture, and the distance at which the growth for near LEDs has its stated value."""
_WIDE_MM, _WIDE_GROWTHS = 2.0, 50.0
"""Prior standard deviations of freely estimated coefficients: much larger than the effect of any lens on a die, or
of focus."""
_LEAST, _CANDIDATES = 1e-6, 400
_BY_CHANCE, _DOUBTFUL = 1e-4, 0.1
"""Two probabilities that noise alone explains a suspect: below the first it is named, below the second it may have
an amplitude."""


@dataclass(frozen=True)
class Mode:
    """One shift of spots. A coefficient of 1 shifts the die's image by `across` in mm, or enlarges the picture."""

    suspect: str
    sigma: float
    """Prior standard deviation of the mode's coefficient."""
    across: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    """Shift along the board's x and y, mm, by the x and y of the unit vector to the camera."""
    growth: float = 0.0
    """Growth of the picture about its principal point, in `GROWTH`."""
    near_growth: float = 0.0
    """Growth of the picture at `NEAR_MM`, in proportion to the nearness of the LED."""


MODES = (
    Mode(PRIMARY, _WIDE_MM, across=((1.0, 0.0), (0.0, 1.0))),
    Mode(OVAL, _WIDE_MM, across=((1.0, 0.0), (0.0, -1.0))),
    Mode(OVAL, _WIDE_MM, across=((0.0, 1.0), (1.0, 0.0))),
    Mode(FIELD, _WIDE_GROWTHS, growth=1.0),
    Mode(FIELD, _WIDE_GROWTHS, near_growth=1.0),
)


@dataclass(frozen=True)
class SuspectedShift:
    """One suspect as the spots show it, with all other suspects in the model."""

    name: str
    coefficients: Floats
    """[modes] coefficients that were estimated freely: mm, or in `GROWTH`."""
    u: Floats
    """[modes] standard uncertainties."""
    amplitude: float
    """Prior standard deviation of its modes in the final adjustment."""
    by_chance: float
    """Probability that noise alone gives estimates as far from 0."""

    @property
    def away(self) -> float:
        """Shift of the images away from the camera, divided by its standard uncertainty; 0 for a shift towards
        it."""
        return max(0.0, -float(self.coefficients[0] / self.u[0])) if self.name == PRIMARY else 0.0

    @property
    def is_named(self) -> bool:
        """True if the fit would be significantly worse without this suspect, with all other suspects present."""
        return self.by_chance < _BY_CHANCE

    def sentence(self) -> str:
        """Return cause and remedy, for the record's page."""
        size, u = float(np.linalg.norm(self.coefficients)), float(self.u.max())
        if self.name == PRIMARY:
            if self.coefficients[0] < 0.0:
                return (
                    f"images of the dies shift away from the camera by {-self.coefficients[0]:.3f} mm (u {u:.3f} "
                    "mm) times the sine of the angle to the normal, which no lens does; heights may be wrong by "
                    "about as much. Check records and views, and measure heights with a probe"
                )
            return (
                f"lenses on the dies shift their images towards the camera by {self.coefficients[0]:.3f} mm (u "
                f"{u:.3f} mm) times the sine of the angle to the normal; places and uncertainties account for "
                "it. Heights rest on this law: a flat window over the dies gives nearly the same spots, but "
                "then the heights have the opposite error. Check one height with a probe"
            )
        if self.name == OVAL:
            return (
                "images of the dies shift more along one side of their board than along the other, by "
                f"{size:.3f} mm (u {u:.3f} mm); places and uncertainties account for it. Look at the LEDs for "
                "lenses that are not round, and for bright walls beside the dies"
            )
        growth, near = self.coefficients
        return (
            f"spots lie farther out than the camera's record says, by {growth:.1f} (u {self.u[0]:.1f}) in "
            f"10,000, and {near:.1f} (u {self.u[1]:.1f}) more at 1 m: this record is not valid for LEDs so far "
            "out of focus. Places and uncertainties account for it; stop the lens down, or calibrate camera "
            "and hand-eye anew"
        )


def shifts_px(
    modes: Sequence[Mode],
    in_camera: Floats,
    camera_from_board: Floats,
    projection: optics.Projected,
    centre_px: Floats,
) -> Floats:
    """[k, 2, modes] shift of each spot by a coefficient of 1. `in_camera` [k, 3] are the LEDs in mm,
    `camera_from_board` [k, 3, 3] the rotations of their boards, `centre_px` [2] is the principal point."""
    away = np.einsum("kji,kj->ki", camera_from_board, in_camera) / np.linalg.norm(in_camera, axis=1)[:, None]
    across = np.array([mode.across for mode in modes]).reshape(-1, 2, 2)
    on_board = np.einsum("mij,kj->kim", across, -away[:, :2])
    growths = np.array([(mode.growth, mode.near_growth) for mode in modes]).reshape(-1, 2)
    relative_growth = GROWTH * np.stack([np.ones(len(in_camera)), NEAR_MM / in_camera[:, 2]], axis=1) @ growths.T
    of_field = (projection.pixels - centre_px)[:, :, None] * relative_growth[:, None, :]
    shifts: Floats = projection.by_point @ camera_from_board[:, :, :2] @ on_board + of_field
    return shifts


def judge(
    modes: Sequence[Mode], coefficients: Floats, covariance: Floats, degrees: float
) -> tuple[SuspectedShift, ...]:
    """Judge the suspects by the free estimates [c] of all modes and their covariance [c, c], whose noise has the
    given degrees of freedom."""
    suspects = []
    for name in dict.fromkeys(mode.suspect for mode in modes):
        own_modes = [number for number, mode in enumerate(modes) if mode.suspect == name]
        estimate, own_covariance = coefficients[own_modes], covariance[np.ix_(own_modes, own_modes)]
        ratio = float(estimate @ np.linalg.solve(own_covariance, estimate)) / len(own_modes)
        by_chance = float(fdtrc(len(own_modes), max(degrees, 1.0), ratio))
        variance = float(max(estimate[0], 0.0) ** 2 + own_covariance[0, 0])
        if name != PRIMARY:
            variance = _most_likely_variance(estimate, own_covariance) if by_chance < _DOUBTFUL else 0.0
        suspects.append(
            SuspectedShift(
                name,
                estimate,
                np.sqrt(np.diag(own_covariance)),
                float(np.sqrt(max(variance, _LEAST**2))),
                by_chance,
            )
        )
    return tuple(suspects)


def _most_likely_variance(estimate: Floats, covariance: Floats) -> float:
    """Return the prior variance, the same for all coefficients, under which the estimates [m] are most likely."""
    variances, vectors = np.linalg.eigh(covariance)
    squares = (vectors.T @ estimate) ** 2

    def cost(variance: float) -> float:
        return float(np.sum(np.log(variances + variance) + squares / (variances + variance)))

    candidates = [0.0, *np.geomspace(1e-3 * variances[0], 10.0 * float(squares.max()) + variances[0], _CANDIDATES)]
    return float(min(candidates, key=cost))


def as_found(modes: Sequence[Mode], suspects: Sequence[SuspectedShift]) -> tuple[Mode, ...]:
    """The modes, with the amplitudes that were found."""
    amplitude_of = {suspect.name: suspect.amplitude for suspect in suspects}
    return tuple(replace(mode, sigma=amplitude_of[mode.suspect]) for mode in modes)


def step_of_records(
    modes: Sequence[Mode], coefficients: Floats, lens: Floats, free: Sequence[str], turn: Floats
) -> Floats:
    """Return [free + 6], the step of lens and hand-eye that has the same effect as the growths: a change of the
    focal length, and a shift of the camera along its axis. `turn` [3, 3] is the rotation of
    `flange_from_camera`."""
    growths = np.array([(mode.growth, mode.near_growth) for mode in modes]).reshape(-1, 2)
    growth, near = GROWTH * coefficients @ growths
    focal_steps = [growth * lens[optics.NAMES.index(name)] if name in ("fx", "fy") else 0.0 for name in free]
    return np.concatenate([focal_steps, NEAR_MM * near * turn[:, 2], np.zeros(3)])
