"""Suspected errors in the model of a panel's pictures: a panel that is not smooth, a fall-off that is not round.

The panel's unevenness beyond a quadratic is a set of polynomials over the panel, which shifted and turned views
show at other pixels. A fall-off that is not round about one centre is a set of polynomials over the field, the
same in all views. A block of pixels has a response of its own, the same in all views. Therefore means over the
views are noisier than differences between views. So both are separate observations, each with its noise, which
differences of neighbouring blocks give.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander2d
from numpy.typing import NDArray
from scipy.linalg import helmert

from coupole.calibration.adjustment import Block
from coupole.calibration.model_error import Search, Suspect, Suspected, with_suspects
from coupole.calibration.rotations import Floats

PANEL, FORM = "panel", "form of the fall-off"
CLEAR = 15.0
"""Evidence from which a suspect is named. Noise alone exceeds it once in 20,000 fits."""
_DOUBTFUL = 1.64
"""Evidence below which a suspect is ignored: noise alone exceeds it in a tenth of all fits."""
_PANEL_DEGREES, _FORM_DEGREES = (3, 6), (1, 4)
_MAD = 1.4826
_LEAST_NOISE = 1e-9
_WORDS = {
    PANEL: "the panel's light has a pattern that is not smooth; clean the panel, or add a diffuser before it",
    FORM: "the fall-off is not round about one centre; look for a hood or filter that shades one side",
}


@dataclass(frozen=True)
class FlatCauses:
    """Panel and form of the fall-off, as the residuals show them."""

    step: Floats
    """[p] change of the parameters of the fit."""
    form: Floats
    """[modes] coefficients of `form_modes`."""
    joint_covariance: Floats
    """[p + modes, p + modes] covariance of the parameters and these coefficients."""
    suspects: tuple[Suspected, ...]
    panel: float
    """Relative root mean square of the panel's pattern, without the part that a lens's fall-off could have too."""
    off_round: float
    """Relative standard deviation over the field of the part of the fall-off that is not round."""

    def names(self) -> Iterator[str]:
        """Yield the suspects that are named."""
        yield from (suspect.name for suspect in self.suspects if suspect.evidence >= CLEAR)

    def sentences(self) -> Iterator[str]:
        """Yield cause and remedy of each suspect that is named."""
        for name in self.names():
            yield f"{_WORDS[name]}. Fall-off and uncertainties account for it"


def form_modes(pixels: Floats, size_px: tuple[int, int]) -> Floats:
    """Return [..., modes] of ln g at pixels [..., 2]."""
    places = 2.0 * np.asarray(pixels, float) / (np.array(size_px) - 1.0) - 1.0
    return _polynomials(places, *_FORM_DEGREES)


def _polynomials(places: Floats, least: int, most: int) -> Floats:
    """Return [..., modes] products of Legendre's polynomials of these total degrees at places from -1 to 1."""
    degrees = np.array([(i, j) for i in range(most + 1) for j in range(most + 1) if least <= i + j <= most])
    table = legvander2d(places[..., 0], places[..., 1], (most, most)).reshape(*places.shape[:-1], most + 1, -1)
    return np.asarray(table[..., degrees[:, 0], degrees[:, 1]])


def flat_causes(
    pixels: Floats, places: Floats, residuals: Floats, design: Floats, used_mask: NDArray[np.bool_],
    size_px: tuple[int, int],
) -> FlatCauses:  # fmt: skip
    """Judge the suspects by the residuals [b] of blocks at pixels [b, 2] that show places [b, 2] of the panel.
    `design` [b, p] are the derivatives of the fit, `used_mask` [b] the blocks that are not outliers."""
    middle, reach = places.mean(axis=0), np.abs(places - places.mean(axis=0)).max(axis=0)
    panel = _polynomials((places - middle) / reach, *_PANEL_DEGREES)
    scale = np.linalg.norm(design, axis=0)
    form = form_modes(pixels, size_px)
    whole = np.column_stack([residuals, design / scale, panel, form])
    rows, noise = _means_and_differences(pixels[used_mask], whole[used_mask])
    count, panels = design.shape[1], panel.shape[1]
    block = Block(rows[:, 0], rows[:, 1 : 1 + count], np.arange(count), 0)
    modes = rows[:, 1 + count :]
    error = with_suspects(
        [block],
        [np.ones(len(rows))],
        np.ones(1),
        count,
        float(len(rows) - count),
        [Suspect(PANEL, modes[:, :panels]), Suspect(FORM, modes[:, panels:])],
        Search(doubtful=_DOUBTFUL),
    )
    kept = np.concatenate([np.arange(count), np.arange(count + panels, count + modes.shape[1])])
    sizes = np.concatenate([1.0 / scale, np.ones(form.shape[1])])
    joint = error.joint_covariance[np.ix_(kept, kept)] * np.outer(sizes, sizes)
    of_form = error.coefficients[panels:]
    spreads = noise * error.of(PANEL).pattern, float(np.std(form @ of_form))
    return FlatCauses(error.step / scale, of_form, joint, error.suspects, *spreads)


def _means_and_differences(pixels: Floats, values: Floats) -> tuple[Floats, float]:
    """Return [n, k] values of blocks [n, k] in an orthonormal basis of each block's views: its mean, and
    differences between views. Each is divided by its noise, which the first column gives; also return the noise of
    differences."""
    _, cluster = np.unique(pixels, axis=0, return_inverse=True)
    order = np.argsort(cluster.ravel(), kind="stable")
    starts = np.flatnonzero(np.diff(cluster.ravel()[order])) + 1
    parts = [helmert(len(own), full=True) @ values[own] for own in np.split(order, starts)]
    means = np.array([part[0] for part in parts])
    most = max(len(part) for part in parts)
    differences = [np.array([part[number] for part in parts if len(part) > number]) for number in range(1, most)]
    noise = _noise([column[:, 0] for column in differences])
    return np.concatenate([means / _noise([means[:, 0]]), np.concatenate(differences) / noise]), noise


def _noise(columns: Sequence[Floats]) -> float:
    """Return the standard deviation of values of neighbouring blocks, by their differences, which a smooth pattern
    hardly changes."""
    steps = np.concatenate([np.diff(column) for column in columns])
    return max(_MAD * float(np.median(np.abs(steps))) / float(np.sqrt(2.0)), _LEAST_NOISE)
