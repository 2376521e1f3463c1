"""Doubts about a fit of a board's images: possible errors of its model, and its predictions of views that were
left out.

Both are part of the record. A pattern that a richer lens would explain widens the lens's covariance, up to a
limit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coupole.calibration import optics
from coupole.calibration.adjustment import Adjusted, Block
from coupole.calibration.cross_validation import LeftOut, left_out
from coupole.calibration.lens.corners import PIXEL_SIGMA_PX, Corners
from coupole.calibration.lens.suspects import BOARD, FOCUS, LENS, PRINT, PRINT_UNIT, Field, suspects_of
from coupole.calibration.model_error import ModelError, Suspected, with_suspects
from coupole.calibration.rotations import Floats

CLEAR = 15.0
"""Evidence from which a suspect is named. Noise alone exceeds it once in 20,000 fits."""
_WORDS = {
    LENS: "the lens has a form that its model lacks",
    BOARD: "the board is not flat",
    FOCUS: "the focal length changes from view to view",
}


@dataclass(frozen=True)
class Seen:
    """The corners as computed at the solution."""

    field: Field
    corners: Corners
    camera_from_board: Floats
    """[views, 4, 4]."""


@dataclass(frozen=True)
class Doubts:
    """Possible errors of the model, and the quality of its predictions."""

    error: ModelError
    field: Field
    predictions: LeftOut
    pattern: float
    """Root mean square over the field of the part of the true lens that the lens's form cannot follow, divided by
    the standard uncertainty of a direction's image by the record's lens."""

    @property
    def sigma_px(self) -> float:
        """Noise of a corner without the patterns."""
        return PIXEL_SIGMA_PX * self.error.noise

    @property
    def predicted_px(self) -> float:
        """Root mean square over the views of the corners' prediction errors, per coordinate."""
        return float(PIXEL_SIGMA_PX * np.sqrt(np.mean(self.predictions.off**2)))

    def sentences(self) -> Iterator[str]:
        """Yield the findings as sentences, for the record's remarks."""
        for suspect in self.error.suspects:
            if suspect.evidence >= CLEAR:
                pattern_px = PIXEL_SIGMA_PX * suspect.pattern
                yield (
                    f"{_words_of(suspect)}: the pattern that this leaves in the residuals is {pattern_px:.2g} "
                    f"px (log-likelihood ratio {suspect.evidence:.0f}); values and uncertainties account for it"
                )
        yield (
            f"views left out in turn are predicted with an error of {self.predicted_px:.2g} px, "
            f"{self.predictions.ratio:.2f} times the stated uncertainty"
        )


def _words_of(suspect: Suspected) -> str:
    """Return the name of a suspect. For a print, it includes the size of the error."""
    if suspect.name != PRINT:
        return _WORDS[suspect.name]
    percent, u_percent = (
        100.0 * PRINT_UNIT * float(value)
        for value in (suspect.coefficients[0], np.sqrt(suspect.coefficient_covariance[0, 0]))
    )
    words = "wider than high" if percent > 0.0 else "higher than wide"
    return (
        f"the board's squares are {abs(percent):.3f} % {words} (u {u_percent:.3f} %), sheared by "
        f"{PRINT_UNIT * float(suspect.coefficients[1]):.5f}; measure the board, or print it on a better printer"
    )


def doubts_of(
    adjustment: Adjusted[Any],
    blocks: Sequence[Block],
    views: Sequence[Sequence[int]],
    computed_corners: Seen,
    lens: Sequence[int],
) -> tuple[Doubts, Floats, Floats]:
    """Return the doubts, and the step of the parameters and their covariance with these doubts.

    `blocks` are those of `adjustment`; the corners' blocks (group 0) come first, in the order of the corners.
    `views` has the numbers of each view's blocks, `lens` the columns of the free intrinsics.
    """
    factors = np.array([component.factor for component in adjustment.components])
    weights = [keep.astype(np.float64) for keep in adjustment.accepted_masks]
    corners = computed_corners.corners
    projection = optics.project(corners.in_camera(computed_corners.camera_from_board), computed_corners.field.lens)
    suspects = suspects_of(
        computed_corners.field, corners, computed_corners.camera_from_board, projection.by_point, projection.pixels
    )
    redundancy = adjustment.components[0].redundancy
    error = with_suspects(blocks, weights, factors, len(adjustment.covariance), redundancy, suspects)
    of_lens = error.of(LENS)
    columns = np.ix_(lens, lens)
    covariance = error.covariance.copy()
    left_px = computed_corners.field.rms_px(of_lens.coefficients, of_lens.coefficient_covariance)
    pattern = left_px / computed_corners.field.ray_u_px(covariance[columns])
    covariance[columns] *= 1.0 + pattern**2
    prediction = left_out(views, blocks, weights, factors, adjustment.covariance)
    return Doubts(error, computed_corners.field, prediction, pattern), error.step, covariance
