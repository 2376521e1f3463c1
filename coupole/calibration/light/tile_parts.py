"""A stain of a white tile, and LEDs whose dies or lobes differ, by the differences between the tile's parts.

A stain is a pattern over the parts of the tile that all LEDs and views share. Its mean is not seen, but scales all
powers. So its modes are those of a random field over the tile (covariance exp(-d / `_STAIN_MM`)), whose mean is
about as large as its pattern. The flat field's error is a gradient over the tile in each view; it is not a stain.

If the die of an LED is tilted, its light does not fall off across the tile by the cosine law. This effect scatters
from LED to LED. It changes no power at the tile's middle, but it changes the light beside the middle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import helmert

from coupole.calibration.adjustment import Block
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_lobe import lobes_of
from coupole.calibration.light.tile_views import Row
from coupole.calibration.model_error import Search, Suspect, Suspected, with_suspects
from coupole.calibration.rotations import Floats

STAIN, LOBE = "stain", "lobe"
_STAIN_MM = 15.0
_FLAT = 3e-3
"""Prior of the flat field's error from the tile's middle to its side, in each view."""
_FALL_OFF, CLEAR_FALL_OFF = 2.0, 5.0
"""Evidence from which a fall-off counts, and from which it is named."""
_LEAST_PARTS, _LEAST_NOISE = 4, 1e-9


@dataclass(frozen=True)
class PartsFound:
    """A pattern of the tile, and light whose fall-off across the tile departs from the cosine law."""

    loss: float
    """Relative change of the tile's mean reflectance against its description."""
    u_loss: float
    stain: Suspected
    fall_off_per_mm: float
    """Standard deviation over the LEDs of the relative change of their light across the tile that no figure
    explains, in each direction."""
    evidence: float
    """Evidence of the fall-off: chi-squared of the gradients beyond its mean, over its standard deviation."""


NO_PARTS = PartsFound(0.0, 0.0, Suspected(STAIN, 0.0, 0.0, np.zeros(0), np.zeros((0, 0)), 0.0), 0.0, 0.0)
"""Nothing is known of the parts of the tile."""


def parts_of(rows: Sequence[Row], places_mm: Sequence[Floats], tile: Tile, prior: Floats) -> PartsFound:
    """Judge the parts of the tile. `places_mm` [m, 2] of each view are the parts on the tile, `prior` [c] the
    standard uncertainties of the shared figures. With few parts, nothing is known."""
    if min(len(part) for part in places_mm) < _LEAST_PARTS:
        return NO_PARTS
    places, numbers = np.unique(np.round(np.concatenate(places_mm), 3), axis=0, return_inverse=True)
    number_of = np.split(numbers.ravel(), np.cumsum([len(part) for part in places_mm])[:-1])
    field = _field(np.asarray(places, np.float64))
    views = [
        _parts_in_view(rows, view, field[number_of[view]], places_mm[view], tile)
        for view in sorted({row.view for row in rows})
    ]
    gradients = 2 * len(views)
    blocks = [
        Block(
            view.values.ravel(),
            view.by_figures.reshape(view.values.size, -1),
            np.concatenate([[2 * number, 2 * number + 1], gradients + np.arange(len(prior))]),
            0,
        )
        for number, view in enumerate(views)
    ]
    sigmas = np.concatenate([np.full(gradients, _FLAT), prior])
    blocks.append(Block(np.zeros(len(sigmas)), np.diag(1.0 / sigmas), np.arange(len(sigmas)), 1))
    suspects = [
        Suspect(STAIN, np.concatenate([view.stain.reshape(view.values.size, -1) for view in views])),
        Suspect(LOBE, np.concatenate([view.gloss.reshape(view.values.size, -1) for view in views])),
    ]
    error = with_suspects(
        blocks,
        [np.ones(len(block.residuals)) for block in blocks],
        np.ones(2),
        len(sigmas),
        float(sum(view.values.size for view in views)),
        suspects,
        Search(priors=(1,)),
    )
    mean, stain = field.mean(axis=0), error.of(STAIN)
    residuals = [
        view.values
        - view.by_figures @ error.step[block.columns]
        - view.stain @ stain.coefficients
        - view.gloss @ error.of(LOBE).coefficients
        for view, block in zip(views, blocks[:-1], strict=True)
    ]
    fall_off, evidence = _fall_off(views, residuals, error.noise)
    return PartsFound(
        float(mean @ stain.coefficients),
        float(np.sqrt(mean @ stain.coefficient_covariance @ mean)),
        stain,
        fall_off,
        evidence,
    )


@dataclass(frozen=True)
class _InView:
    """Contrasts [n, m - 1] of the parts in one view, divided by their noise, and the effect of causes on them."""

    leds: NDArray[np.int64]
    values: Floats
    by_figures: Floats
    """[n, m - 1, 2 + c] by the flat field's gradient, then by the shared figures."""
    stain: Floats
    gloss: Floats
    by_place: Floats
    """[n, m - 1, 2] by a relative change of the light across the tile, per mm."""


def _parts_in_view(rows: Sequence[Row], view: int, field: Floats, places_mm: Floats, tile: Tile) -> _InView:
    view_rows = [row for row in rows if row.view == view]
    contrast = helmert(len(places_mm))
    parts = np.array([row.parts for row in view_rows]).reshape(-1, len(places_mm))
    weights = np.array([1.0 / max(float(np.mean(row.u_parts)), _LEAST_NOISE) for row in view_rows])[:, None, None]

    def over_noise(by_part: Floats) -> Floats:
        return np.asarray(weights * np.einsum("cm,...mk->...ck", contrast, by_part))

    gloss = np.array([lobes_of(row.angles, tile) for row in view_rows]).reshape(*parts.shape, -1)
    figures = np.array([row.part_slopes for row in view_rows]).reshape(*parts.shape, -1)
    gradient = np.broadcast_to(places_mm / (0.5 * tile.side_mm), (*parts.shape, 2))
    return _InView(
        np.array([row.led for row in view_rows], np.int64),
        over_noise(np.log(np.maximum(parts, 1e-3))[..., None])[..., 0],
        over_noise(np.concatenate([gradient, figures], axis=-1)),
        over_noise(field),
        over_noise(gloss),
        over_noise(np.broadcast_to(places_mm, (*parts.shape, 2))),
    )


def _fall_off(views: Sequence[_InView], residuals: Sequence[Floats], noise: float) -> tuple[float, float]:
    """Return the standard deviation over the LEDs of their light's relative gradients, 1/mm, and its evidence."""
    normal: dict[int, Floats] = {}
    side: dict[int, Floats] = {}
    for view, residual in zip(views, residuals, strict=True):
        for led, by_place, own in zip(view.leds.tolist(), view.by_place, residual, strict=True):
            normal[led] = normal.get(led, np.zeros((2, 2))) + by_place.T @ by_place
            side[led] = side.get(led, np.zeros(2)) + by_place.T @ own
    covariances = np.array([noise**2 * np.linalg.inv(own) for own in normal.values()])
    gradients = np.array([np.linalg.solve(own, side[led]) for led, own in normal.items()])
    squares = np.einsum("ni,nij,nj->n", gradients, np.linalg.inv(covariances), gradients)
    excess = float(np.mean(gradients**2) - np.mean(np.trace(covariances, axis1=1, axis2=2)) / 2.0)
    evidence = float((squares.sum() - 2 * len(squares)) / np.sqrt(4.0 * len(squares)))
    return (np.sqrt(excess), evidence) if excess > 0.0 and evidence > _FALL_OFF else (0.0, max(evidence, 0.0))


def _field(places_mm: Floats) -> Floats:
    """Return [places, modes]: independent coefficients of standard deviation 1 give the random field."""
    away_mm = np.linalg.norm(places_mm[:, None] - places_mm, axis=-1)
    values, vectors = np.linalg.eigh(np.exp(-away_mm / _STAIN_MM))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
