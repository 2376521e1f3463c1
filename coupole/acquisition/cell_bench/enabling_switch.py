"""The enabling switch that a person at the cell holds while the arm is moved from a console (ISO 10218-1, 5.8.3).

The switch is connected to an input of the LED box. It is not a safety function, because the box, its line and this
program are in between. It shows that a person is at the cell and wants the motion; the address of a console cannot
show this.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from coupole.devices import LedBox
from coupole.errors import DeviceError, InputError
from coupole.supervision import ATTENTION_S

_POLL_S = 0.03
_NEWS_S = 0.3
"""A switch counts as released if there was no news of it for this time."""


class ReleasedError(Exception):
    """The switch was released, or it is not known to be held."""


class EnablingSwitch:
    """The switch of one cell, if it has one."""

    def __init__(self, box: LedBox, *, must_exist: bool) -> None:
        """`must_exist`: the rig says that the box has an input for a switch."""
        self._box, self._must_exist = box, must_exist
        self.exists = box.presence() is not None

    def refuse_released(self) -> None:
        """Raise InputError unless the switch is held. A cell without a switch passes, unless its rig has one. Use
        this for an arm at rest, because it waits for the box."""
        if not self.exists:
            if self._must_exist:
                raise InputError(
                    "the rig has an enabling switch (`console: enabling_switch:`), but the LED box reports no "
                    "input for one: check its wiring and firmware"
                )
            return
        if not self._box.presence():
            raise InputError(
                "the enabling switch at the cell is not held: a person at the cell must hold it while the arm "
                "moves"
            )

    @contextmanager
    def release_check(self) -> Iterator[Callable[[], None]]:
        """Give a function that raises ReleasedError unless the switch is held, while the context lasts. Call the
        function again and again while the arm moves. Another thread asks the box. It stops asking if the caller
        hangs; otherwise it would keep the box's watchdog quiet in the caller's place."""
        if not self.exists:
            yield lambda: None
            return
        watch = _Watch(self._box)
        try:
            yield watch.check
        finally:
            watch.end()


class _Watch:
    def __init__(self, box: LedBox) -> None:
        self._box = box
        self._released = ""
        self._checked_s = self._heard_s = self._resumed_s = time.monotonic()
        self._ended = threading.Event()
        threading.Thread(target=self._ask, name="enabling switch", daemon=True).start()

    def check(self) -> None:
        """Raises ReleasedError. A released switch stays released: the motion must be requested again."""
        now_s = time.monotonic()
        if now_s - self._checked_s > ATTENTION_S:  # the arm rested, and nothing was asked
            self._resumed_s = now_s
        self._checked_s = now_s
        if not self._released and now_s - max(self._heard_s, self._resumed_s) > _NEWS_S:
            self._released = f"the enabling switch was not reported for {1e3 * _NEWS_S:g} ms"
        if self._released:
            raise ReleasedError(self._released)

    def end(self) -> None:
        self._ended.set()

    def _ask(self) -> None:
        while not self._ended.wait(_POLL_S):
            if time.monotonic() - self._checked_s > ATTENTION_S:
                continue
            asked_s = time.monotonic()
            try:
                is_held = self._box.presence()
            except DeviceError:  # another thread has darkened the box, or it is lost: the news get old
                continue
            if is_held:
                self._heard_s = asked_s
            else:
                self._released = "the enabling switch was released"
                return
