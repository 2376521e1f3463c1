"""Progress and outcome of a run, as values for terminal and reports."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from coupole.plan.shot_id import ShotId

OVER_EXPOSED, UNDER_EXPOSED = 1e-3, 0.05
"""Limits of exposure: the share of a frame's pixels that may saturate; and the share of full scale that the bright
pixels of most frames must reach."""


@dataclass(frozen=True)
class Progress:
    """Progress of the run."""

    view: str
    view_number: int
    views: int
    proven: int
    """Proven frames of the whole run, with dark frames."""
    frames: int
    light: str
    dose_lux_h: float
    """Light on the object in all sessions of the run. The present burst counts as far as it has run."""
    left_s: float
    """Expected time until the last frame is proven, on the cell's clock, if no frame is taken again."""


@dataclass
class Outcome:
    """Outcome of a session."""

    shots: int
    proven: int = 0
    reshot: int = 0
    bad: set[ShotId] = field(default_factory=set)
    """Shots whose LED drew no current. They are proven to be dark, so they are not stored as shots."""
    missing: list[ShotId] = field(default_factory=list)
    missing_darks: list[ShotId] = field(default_factory=list)
    """Dark frames and marks that are not proven."""
    duration_s: float = 0.0
    ideal_s: float = 0.0
    """Time of this session's motions and settling at the arm's limits, plus the time of its burst tables."""
    dose_lux_h: float = 0.0
    over_triggers: int = 0
    lost_transfers: int = 0


@dataclass
class ViewExposure:
    """Exposure of a view, by the frames of a sample of its lights."""

    pictures: int = 0
    saturated_share: float = 0.0
    """Largest share of saturated pixels of any sampled frame."""
    brightest: float = 0.0
    """Highest 99.9 % quantile of any sampled frame, share of full scale above black."""
    median_bright: float = 0.0
    """Median over the sampled frames of that quantile."""
    quantiles: list[float] = field(default_factory=list)

    def add(self, raw: NDArray[np.uint16], *, black_dn: int, white_dn: int) -> None:
        """Count one more frame of the sample, [H, W] in DN."""
        brightest = (float(np.quantile(raw, 0.999)) - black_dn) / (white_dn - black_dn)
        self.add_figures(brightest, float(np.mean(raw >= white_dn)))

    def add_figures(self, brightest: float, saturated_share: float) -> None:
        """Count one more frame whose quantile (share of full scale) and share of saturated pixels are known."""
        self.pictures += 1
        self.quantiles.append(brightest)
        self.brightest = max(self.brightest, brightest)
        self.median_bright = float(np.median(self.quantiles))
        self.saturated_share = max(self.saturated_share, saturated_share)

    def verdict(self) -> str:
        """`over-exposed`, `under-exposed` or `well exposed`."""
        if self.saturated_share > OVER_EXPOSED:
            return "over-exposed"
        return "under-exposed" if self.median_bright < UNDER_EXPOSED else "well exposed"
