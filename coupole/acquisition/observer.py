"""Observation and control of a run from outside."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from coupole.errors import Interrupted
from coupole.supervision import ASKS_FROM_S, HEARD_WITHIN_S

if TYPE_CHECKING:
    from coupole.viewing.progress import Progress


_WORD_EVERY_S = 0.01


class Observer(Protocol):
    """Observes a run. The sequencer's thread calls it, so methods must return quickly."""

    def progress(self, progress: Progress) -> None:
        """Tell that frames were proven, or that some time passed."""
        ...

    def note(self, message: str) -> None:
        """Show a message to the operator."""
        ...


class Unwatched:
    """An `Observer` that does nothing."""

    def progress(self, progress: Progress) -> None:
        """Do nothing: nobody watches."""

    def note(self, message: str) -> None:
        """Do nothing: nobody listens."""


class Held(Exception):
    """Raised instead of a command to a device, when the session must stop at once and wait for a person."""


def frozen(seconds: float) -> str:
    """Return why a session is held whose process did not run for a while."""
    return f"the program did not run for {seconds:.1f} s: it was stopped, or its machine slept"


@dataclass
class Control:
    """The operator's stop and pause. Signal handlers and other threads set them.

    A *pause* waits for the end of the burst. A *hold* does not wait: something stopped the program or the arm
    without anybody's request, or the cause is urgent. A hold switches the lights off and stops the arm
    (`halting`), and only a person ends it.
    """

    session: Control | None = None
    """The session that this is a part of: its stop and holds count here too. None: this is the session itself."""
    stop: threading.Event = field(default_factory=threading.Event)
    pause: threading.Event = field(default_factory=threading.Event)
    standing: threading.Event = field(default_factory=threading.Event)
    """Set while the session stands: lights off, the arm at rest."""
    can_stand: bool = False
    """True if the session can stand and go on. A hold stops a session that cannot."""
    hold_pending: threading.Event = field(default_factory=threading.Event)
    """Set from a hold until the session stands."""
    halting: threading.Event = field(default_factory=threading.Event)
    """Set while a hold switches the lights off and stops the arm. During this time nobody can let the session go
    on."""
    held_because: str = ""
    unsure: Sequence[str] = ()
    """Sentences on devices that are perhaps not safe after a hold. If there are any, the session ends."""
    pulse_s: float = math.inf
    """Time when this process last proved that it runs, monotonic s. A thread that does nothing else sets it
    (`coupole.acquisition.signals`). It is infinite without this thread."""
    stood_at_s: float = -math.inf
    """Time when that thread last found that it had not run for a while, monotonic s."""
    signal_number: int = signal.SIGINT
    """The signal that set `stop`, or the signal that the session's end is reported as."""
    stopped_by: str = ""
    """Cause that set `stop`, in words; empty: the signal."""

    def stop_by(self, number: int, cause: str = "") -> None:
        """Stop for this signal, or for `cause` as if this signal had come. Only the first call counts."""
        if not self.stop.is_set():
            self.signal_number, self.stopped_by = number, cause
            self.stop.set()

    def toggle_pause(self) -> None:
        """Pause at the next opportunity, or go on."""
        (self.let_go_on if self.pause.is_set() else self.pause.set)()

    def let_go_on(self) -> None:
        """End a pause when a person asks for it. This does not end a hold before all is safe and the session
        stands. Before that, the session has not reported what happened, and it needs the pause in order to come to
        a stand."""
        if not self.coming_to_stand:
            self.pause.clear()

    @property
    def coming_to_stand(self) -> bool:
        """True from a hold until all is safe and the session stands. Meanwhile a person's request to go on is
        ignored."""
        return self.halting.is_set() or self.hold_pending.is_set()

    def hold(self, why: str) -> None:
        """Hold the session at once, wherever it is. The first reason counts until the session stands."""
        if not self.can_stand:
            if not self.stop.is_set():  # else another reason came first
                self.held_because = why
            self.stop_by(signal.SIGINT)
            return
        if not self.hold_pending.is_set():
            self.held_because = why
        self.pause.set()
        self.hold_pending.set()

    @property
    def stopped_by_hand(self) -> bool:
        """True if the session was stopped as by Ctrl-C, and not by a hold. A live view or a bench then ends
        normally."""
        return self.stop.is_set() and self.signal_number == signal.SIGINT and not self.held_because

    def interruption(self) -> Interrupted:
        """The error that ends a stopped session."""
        word = "stopped by the operator" if self.signal_number == signal.SIGINT else "stopped"
        name = self.stopped_by or signal.Signals(self.signal_number).name
        if self.held_because and not self.can_stand:
            why = f"{self.held_because}; this command cannot pause, so it was ended"
            return Interrupted(why, self.signal_number)
        return Interrupted(f"{word} ({name}); everything proven so far is kept", self.signal_number)

    @property
    def stands(self) -> bool:
        """True from a hold until the session stands. Meanwhile devices may fail because they or this process were
        stopped. If the process did not run for a while, this waits for the thread that hears of SIGCONT. That
        thread tells whether the process was frozen, or the machine only busy."""
        if self.session is not None:
            return self.session.stands
        self.await_word()
        return self.hold_pending.is_set()

    def await_word(self) -> None:
        """Wait, if this process did not run for a while, until the reason for that is known. Call this before an
        arm that stands is moved again."""
        if self.session is not None:
            self.session.await_word()
            return
        end_s = time.monotonic() + HEARD_WITHIN_S
        while self.awaits_word and not self.stop.is_set() and time.monotonic() < end_s:
            self.hold_pending.wait(_WORD_EVERY_S)

    @property
    def awaits_word(self) -> bool:
        """True if `stands` would wait, because this process did not run for a while and the reason is not known
        yet."""
        if self.session is not None:
            return self.session.awaits_word
        now_s = time.monotonic()
        late = now_s - self.pulse_s > ASKS_FROM_S or now_s - self.stood_at_s < HEARD_WITHIN_S
        return late and not self.hold_pending.is_set()

    @contextmanager
    def explains(self, *errors: type[Exception]) -> Iterator[None]:
        """Raise Interrupted in place of these errors if the session was told to stop: this is why its devices
        fail."""
        try:
            yield
        except errors as error:
            self.await_word()
            stopped = next(
                (control for control in (self.session, self) if control and control.stop.is_set()), None
            )
            if stopped is not None:
                raise stopped.interruption() from error
            raise

    def go_on(self) -> None:
        """Raise Interrupted if the session must stop, or Held if it must stand. Call it before each command that
        lights or moves."""
        if self.session is not None:
            self.session.go_on()
        if self.stop.is_set():
            raise self.interruption()
        if self.hold_pending.is_set():
            raise Held(self.held_because)
