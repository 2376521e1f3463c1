"""Actions that make a cell safe, each independent of the others. Actions that are perhaps not done are
reported."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

from coupole.bounded import leave_behind, waited_for

_SAFE_WITHIN_S = 15.0
"""Longer than any driver's time-outs for switching off and stopping. A call that hangs longer is given up and
reported.
"""


class Safeguard:
    """One action that makes a cell safe, in a thread of its own, so that none waits for another."""

    def __init__(self, label: str, act: Callable[[], None]) -> None:
        self.what, self._act = label, act
        self.trouble = f"no answer within {_SAFE_WITHIN_S:g} s"
        """Reason why the action is not sure to be done; empty when it is done."""
        self._begun_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name=label, daemon=True)
        self._thread.start()

    def wait(self, at_most_s: float = _SAFE_WITHIN_S) -> None:
        self._thread.join(at_most_s)
        if self._thread.is_alive() and time.monotonic() - self._begun_s >= _SAFE_WITHIN_S:
            leave_behind(self._thread)

    def _run(self) -> None:
        try:
            with waited_for():
                self._act()
        except BaseException as error:  # noqa: BLE001  whatever it is, the other safeguards go on
            self.trouble = str(error) or type(error).__name__
        else:
            self.trouble = ""


def unsure(safeguards: Sequence[Safeguard], within_s: float) -> list[str]:
    """Wait for the actions for a while; return those that are perhaps not done."""
    end_s = time.monotonic() + within_s
    for safeguard in safeguards:
        safeguard.wait(max(0.0, end_s - time.monotonic()))
    return [f"not sure: {safeguard.what}: {safeguard.trouble}" for safeguard in safeguards if safeguard.trouble]
