"""Refusals of a stand-in. Refusals are shown to a person, because an outside client would otherwise see only
silence.

A client that makes a mistake usually makes it in every cycle. So the same reason is printed again only after a
while, with its count.
"""

from __future__ import annotations

import time
from collections.abc import Callable

_AGAIN_S = 2.0
"""Machine time between two messages with the same reason."""


def untold(message: str) -> None:
    """Drop the message: for stand-ins whose client is Coupole itself."""


class Refusals:
    """Counts refusals by reason, and prints them."""

    def __init__(self, device: str, tell: Callable[[str], None]) -> None:
        self._device, self._tell = device, tell
        self._since: dict[str, tuple[float, int]] = {}
        """Time at which each reason was last told, s, and the number of times that it has occurred since."""

    def note_refusal(self, reason: str, details: str = "") -> None:
        """Count a refusal. `reason` is equal for equal mistakes; `details` belong to this occurrence."""
        now_s = time.monotonic()
        told_s, count = self._since.get(reason, (-_AGAIN_S, 0))
        if now_s - told_s < _AGAIN_S:
            self._since[reason] = told_s, count + 1
            return
        self._since[reason] = now_s, 0
        again = f" ({count + 1} times since the last message)" if count else ""
        self._tell(f"{self._device}: {reason}{': ' if details else ''}{details}{again}")
