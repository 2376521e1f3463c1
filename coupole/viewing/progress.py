"""Where a run is and what came of it, as values that screens and reports show."""

from __future__ import annotations

from dataclasses import dataclass, field

from coupole.plan.shot_id import ShotId


@dataclass(frozen=True)
class Progress:
    """Where the run is."""

    view: str
    view_number: int
    views: int
    proven: int
    """Proven frames of the whole run, darks included."""
    frames: int
    light: str
    dose_lux_h: float


@dataclass
class Outcome:
    """What came of a session."""

    shots: int
    proven: int = 0
    reshot: int = 0
    bad: set[ShotId] = field(default_factory=set)
    """Shots whose LED drew no current: proven dark, so not kept as shots."""
    missing: list[ShotId] = field(default_factory=list)
    duration_s: float = 0.0
    ideal_s: float = 0.0
    """Motion and settling at the arm's limits plus the tables' own time, of what this session did."""
    dose_lux_h: float = 0.0
    over_triggers: int = 0
    lost_transfers: int = 0


@dataclass
class ViewExposure:
    """How well a view is exposed, on the frames of a sample of its lights."""

    pictures: int = 0
    saturated: float = 0.0
    """Largest share of saturated pixels of any sampled frame."""
    brightest: float = 0.0
    """Highest 99.9 % quantile of any sampled frame, share of full scale above black."""
    median_bright: float = 0.0
    """Median over the sampled frames of that quantile."""
    quantiles: list[float] = field(default_factory=list)

    def verdict(self) -> str:
        """`over-exposed`, `under-exposed` or `well exposed`."""
        if self.saturated > 1e-3:
            return "over-exposed"
        return "under-exposed" if self.median_bright < 0.05 else "well exposed"
