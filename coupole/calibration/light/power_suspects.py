"""Suspected errors in the model of a white tile's signals: a lobe of the tile, light or gain that drifts; and the
words for these, for a stain and for tilted dies (`tile_parts`).

A drift changes all powers of a time by one factor. Its modes are cosines over the session: few slow ones, and two
bands of faster ones, each with an amplitude of its own.

Amplitudes, noise and evidence are those of `model_error`. A suspect is named if the fit is clearly worse without
it, with all others present.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from coupole.calibration.adjustment import Block
from coupole.calibration.light.power_between import Between
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_lobe import ALBEDO, WIDTHS, lobes_of
from coupole.calibration.light.tile_parts import CLEAR_FALL_OFF, STAIN, PartsFound
from coupole.calibration.light.tile_views import Row
from coupole.calibration.model_error import ModelError, Search, Suspect, Suspected, with_suspects
from coupole.calibration.rotations import Floats

GLOSS, DRIFT, DIES = "lobe of the tile", "drift", "tilted dies"
UNSTEADY, RESTLESS = "unsteady light", "restless light"
CLEAR = 15.0
"""Evidence from which a suspect is named. Noise alone exceeds it once in 20,000 fits."""
_DOUBTFUL = 1.64
"""Evidence below which a lobe or drift is ignored: noise alone gives this much evidence in a tenth of all
cells."""
_SLOW, _FASTER, _FAST = 3, 9, 24
"""Number of half waves over the session: slow ones, with faster ones, all. Slow ones become smaller by their
number, like the steps of a random walk."""
_LEAST, _LEAST_REDUNDANCY = 1e-9, 10.0
"""Least amplitude, and least number of observations beyond one for each LED, from which a cause is determined."""
REACH_MM = 40.0
"""Distance from the tile's middle for which powers hold."""

_WORDS = {
    STAIN: "the tile has a stain, or is not equally white",
    GLOSS: "the tile shines: it has a lobe in addition to Minnaert's law",
    DRIFT: "gain or light drifted over the session",
    UNSTEADY: "gain or light wavered during the session",
    RESTLESS: "gain or light wavered many times during the session",
    DIES: "dies are tilted, or their lobes differ: their light does not follow the cosine law",
}
_REMEDIES = {
    STAIN: "Clean the tile or turn another part of it up",
    GLOSS: "Grind the tile flat with wet abrasive paper, or describe its lobe by a goniometer's certificate",
    DRIFT: "Let lamps and camera warm up for half an hour, then acquire again",
    DIES: (
        f"The powers are valid up to {REACH_MM:.0f} mm from the tile's middle: lay the tile where the object "
        "will be"
    ),
    UNSTEADY: "Look at the supply of the LEDs and at room light, then acquire again",
    RESTLESS: "Look at the supply of the LEDs and at room light, then acquire again",
}


@dataclass(frozen=True)
class CausesFound:
    """Lobe and drift, as the differences between the views of each LED show them."""

    error: ModelError
    """Its step are the shared figures [c]."""
    modes: Floats
    """[n, modes] change of each observation if a coefficient is 1."""
    mean_modes: Floats
    """[leds, modes] weighted mean of the modes of each LED."""
    pattern: Floats
    """[n] change of each observation by lobe and drift, less the mean change over its LED's views."""
    gloss: float
    """Reflectance of the lobe for light along the normal."""
    drift: float
    """Largest difference of gain or light within the session by slow modes."""
    unsteady: float
    """The same by the other modes."""

    @property
    def figures(self) -> Floats:
        """[c] the shared figures."""
        return self.error.step

    @property
    def suspects(self) -> tuple[Suspected, ...]:
        return self.error.suspects

    @property
    def names_lobe(self) -> bool:
        """True if a lobe of the tile is named."""
        return any(suspect.name == GLOSS and suspect.evidence >= CLEAR for suspect in self.suspects)

    def with_modes(self, between: Between, design: Floats, factor: float) -> Between:
        """Return the observations with the modes among the shared figures, whose derivatives are `design` [n, c].
        `factor` is the variance over the stated one."""
        return replace(
            between,
            design=np.hstack([design, self.modes]),
            weights=between.weights / factor,
            prior=np.append(between.prior, self.amplitudes),
        )

    @property
    def amplitudes(self) -> Floats:
        """[modes] prior standard deviations of the coefficients."""
        counts = [len(suspect.coefficients) for suspect in self.suspects]
        own_amplitudes = np.array([suspect.amplitude for suspect in self.suspects], np.float64)
        return np.asarray(np.maximum(np.repeat(own_amplitudes, counts), _LEAST))


def names_of(causes: CausesFound, parts: PartsFound) -> Iterator[str]:
    """Yield the suspects that are named. If the tile has a lobe of another form than Ward's, its error looks like
    a fall-off. Therefore no fall-off is named if a lobe is named."""
    yield from (suspect.name for suspect in (*causes.suspects, parts.stain) if suspect.evidence >= CLEAR)
    if parts.evidence >= CLEAR_FALL_OFF and not causes.names_lobe:
        yield DIES


def sentences(causes: CausesFound, parts: PartsFound) -> Iterator[str]:
    """Yield cause and remedy of each suspect that is named."""
    for name in names_of(causes, parts):
        yield f"{_WORDS[name]}; powers and uncertainties account for it. {_REMEDIES[name]}"


def causes_of(rows: Sequence[Row], between: Between, tile: Tile) -> CausesFound:
    """Judge lobe and drift by the differences between views. Drifts are left out if times are not known, and
    all causes if few LEDs are in two views."""
    if between.redundancy < _LEAST_REDUNDANCY:
        return without_causes(between)
    gloss = np.stack([lobes_of(row.angles, tile).mean(axis=0) for row in rows])
    times = np.array([row.time_s for row in rows])
    groups = [(GLOSS, gloss)]
    waves = np.zeros((len(rows), 0))
    if np.isfinite(times).all() and np.ptp(times) > 0.0:
        share = (times - times.min()) / np.ptp(times)
        half_waves = np.arange(1, _FAST + 1)
        waves = np.cos(np.pi * half_waves * share[:, None])
        waves[:, :_SLOW] /= half_waves[:_SLOW]
        groups += [
            (DRIFT, waves[:, :_SLOW]),
            (UNSTEADY, waves[:, _SLOW:_FASTER]),
            (RESTLESS, waves[:, _FASTER:]),
        ]
    modes = np.concatenate([values for _, values in groups], axis=1)
    mean_modes = between.means(modes)
    root = np.sqrt(between.weights)
    own = Block(root * between.residuals, root[:, None] * between.design, np.arange(len(between.prior)), 0)
    prior = Block(np.zeros(len(between.prior)), np.diag(1.0 / between.prior), np.arange(len(between.prior)), 1)
    suspects = [
        Suspect(name, root[:, None] * (values - between.means(values)[between.led])) for name, values in groups
    ]
    weights = [np.ones(len(block.residuals)) for block in (own, prior)]
    error = with_suspects(
        [own, prior],
        weights,
        np.ones(2),
        len(between.prior),
        between.redundancy,
        suspects,
        Search(priors=(1,), doubtful=_DOUBTFUL),
    )
    changes = waves * error.coefficients[gloss.shape[1] :]
    lobes = error.of(GLOSS).coefficients[: len(WIDTHS)]
    return CausesFound(
        error,
        modes,
        mean_modes,
        (modes - mean_modes[between.led]) @ error.coefficients,
        float(ALBEDO * lobes.sum()),
        float(np.ptp(changes[:, :_SLOW].sum(axis=1))),
        float(np.ptp(changes[:, _SLOW:].sum(axis=1))),
    )


def without_causes(between: Between) -> CausesFound:
    """Return the shared figures of a calibration that searches for no cause, with the noise as stated."""
    normal = np.diag(between.prior**-2.0) + between.design.T @ (between.design * between.weights[:, None])
    covariance = np.asarray(np.linalg.inv(normal), np.float64)
    step = covariance @ (between.design.T @ (between.weights * between.residuals))
    error = ModelError(step, covariance, 1.0, (), np.zeros(0), covariance)
    none = np.zeros((len(between.led), 0))
    return CausesFound(error, none, np.zeros((between.leds, 0)), np.zeros(len(between.led)), 0.0, 0.0, 0.0)
