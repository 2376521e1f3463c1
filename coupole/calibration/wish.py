"""What an operator asks of a calibration, whichever it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime


@dataclass(frozen=True)
class Wish:
    """What the operator says beside the images."""

    name: str
    now: datetime
    valid_days: int = 180
    lens: str | None = None
    focus_tolerance_mm: float = 2.0
    temperature_margin_c: float = 5.0
    limits: Mapping[str, float] = field(default_factory=dict)
    """Acceptance limits that the operator set, by name (`coupole.calibration.limits`)."""
