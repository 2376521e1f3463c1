"""Observation and control of a run from outside."""

from __future__ import annotations

import signal
import threading
from dataclasses import dataclass, field
from typing import Protocol

from coupole.errors import Interrupted
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
    paused: threading.Event = field(default_factory=threading.Event)
    """Set while the session stands: lights off, the arm at rest."""
    signal_number: int = signal.SIGINT
    """The signal that set `stop`."""

    def stop_by(self, number: int) -> None:
        """Stop for this signal; the first one counts."""
        if not self.stop.is_set():
            self.signal_number = number
            self.stop.set()

    def toggle_pause(self) -> None:
        """Pause at the next opportunity, or go on."""
        (self.pause.clear if self.pause.is_set() else self.pause.set)()

    def interrupted(self) -> Interrupted:
        """The error that ends a stopped session."""
        word = "stopped by the operator" if self.signal_number == signal.SIGINT else "stopped"
        name = signal.Signals(self.signal_number).name
        return Interrupted(f"{word} ({name}); everything proven so far is kept", self.signal_number)

    def go_on(self) -> None:
        """Raise Interrupted if the session is to stop: to be called before each command that lights or moves."""
        if self.stop.is_set():
            raise self.interrupted()
