"""How a run is watched, steered from outside, and summed up."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Progress:
    """Where the run is, for whoever watches."""

    view: str
    view_number: int
    views: int
    proven: int
    """Proven frames of the whole run, darks included."""
    frames: int
    light: str
    dose_lux_h: float


class Observer:
    """Watches a run; override what is of interest. Called on the sequencer's thread, so be brief."""

    def progress(self, progress: Progress) -> None:
        """Something was proven, or time went by."""

    def note(self, message: str) -> None:
        """Something that the operator should know."""


@dataclass
class Control:
    """How the operator reaches into a run: set from signal handlers and other threads."""

    stop: threading.Event = field(default_factory=threading.Event)
    pause: threading.Event = field(default_factory=threading.Event)


@dataclass
class Outcome:
    """What came of it."""

    shots: int
    proven: int = 0
    reshot: int = 0
    bad: list[str] = field(default_factory=list)
    """Shots whose LED drew no current: proven dark, so not kept as shots."""
    missing: list[str] = field(default_factory=list)
    duration_s: float = 0.0
    ideal_s: float = 0.0
    """Motion and settling at the arm's limits plus the tables' own time, of what this session did."""
    dose_lux_h: float = 0.0
    over_triggers: int = 0
    lost_transfers: int = 0
