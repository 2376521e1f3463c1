"""Observation and control of a run from outside."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Protocol

from coupole.viewing.progress import Progress


class Observer(Protocol):
    """Observes a run. Called in the sequencer's thread, so methods must return quickly."""

    def progress(self, progress: Progress) -> None:
        """Frames were proven, or some time passed."""
        ...

    def note(self, message: str) -> None:
        """A message for the operator."""
        ...


class Unwatched:
    """An `Observer` that does nothing."""

    def progress(self, progress: Progress) -> None:
        """Nobody asks."""

    def note(self, message: str) -> None:
        """Nobody listens."""


@dataclass
class Control:
    """The operator's stop and pause: set from signal handlers and other threads."""

    stop: threading.Event = field(default_factory=threading.Event)
    pause: threading.Event = field(default_factory=threading.Event)
