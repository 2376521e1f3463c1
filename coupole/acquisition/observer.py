"""How a run is watched and steered from outside."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Protocol

from coupole.viewing.progress import Progress


class Observer(Protocol):
    """Watches a run. Called on the sequencer's thread, so be brief."""

    def progress(self, progress: Progress) -> None:
        """Something was proven, or time went by."""
        ...

    def note(self, message: str) -> None:
        """Something that the operator should know."""
        ...


class Unwatched:
    """An `Observer` that says nothing."""

    def progress(self, progress: Progress) -> None:
        """Nobody asks."""

    def note(self, message: str) -> None:
        """Nobody listens."""


@dataclass
class Control:
    """How the operator reaches into a run: set from signal handlers and other threads."""

    stop: threading.Event = field(default_factory=threading.Event)
    pause: threading.Event = field(default_factory=threading.Event)
