"""Watch over the control of a cell, for a command that drives the arm: it ends when another person has control."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from coupole.console.command_line.client import ask_permission, call
from coupole.errors import InputError, Interrupted
from coupole.plan.cell import Cell

_LOOK_EVERY_S, _LOGGED_WITHIN_S = 0.1, 2.0


class KeptControl:
    """Tells whether another person has taken control at the cell's console."""

    def __init__(self) -> None:
        self._is_lost = threading.Event()
        self.lost_because = ""
        """Name of the person in control, in words; empty as long as this process may act."""

    def await_loss(self, seconds: float) -> None:
        """Wait for this time. Raises Interrupted as soon as another person is in control."""
        if self._is_lost.wait(seconds):
            raise Interrupted(f"the arm was stopped: {self.lost_because}")

    def lose(self, why: str) -> None:
        """Note who has taken control."""
        self.lost_because = why
        self._is_lost.set()


@contextmanager
def kept_control(cell: Cell, action: str) -> Iterator[KeptControl]:
    """Ask the cell's console for permission; then ask every 0.1 s, in another thread, who came into control since,
    while the context lasts. The console's log says that the `action` was ended. At a console that is frozen nobody
    can take control, so nothing ends until it runs again; the same is true without a console. Raises InputError if
    another person is in control, or if the console does not answer."""
    control, over = KeptControl(), threading.Event()
    taken_count = ask_permission(cell, action)
    arguments = (cell, action, taken_count, control, over)
    watch = threading.Thread(target=_watch, args=arguments, name="control", daemon=True)
    watch.start()
    try:
        yield control
    finally:
        over.set()
        watch.join(_LOGGED_WITHIN_S)


def _watch(cell: Cell, action: str, taken_count: int, control: KeptControl, over: threading.Event) -> None:
    while not (over.wait(_LOOK_EVERY_S) or control.lost_because):
        with contextlib.suppress(InputError):  # nobody answers
            now = call(
                cell,
                "GET",
                f"/api/v1/bench/permission?taken_count={taken_count}",
                given_up=over.is_set,
                meanwhile="; the motion goes on, because nobody can take control there now",
            )
            if not now["may_act"]:
                control.lose(f"{now['in_control']} took control at the console")
                ask_permission(cell, f"{action}, under way")  # its refusal is logged
