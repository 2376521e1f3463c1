"""The invariant that ties every answer to the arm itself, even if one side has lost count:

    An answer starts from the arm. It is sent on two conditions. The controller's own packet must prove that
    corrections still count from this session's start. And the distance from the axes that this packet reports to
    the answer's place must be at most the lag of the arm plus one cycle's step.

*Proof.* A packet proves this if three conditions are met. First, the controller's counter of late answers contains
every cycle of the IPOC since the last answered packet that was not answered. Second, the counter has not
decreased, unless it counts only late answers in a row. Third, every silence on the machine's clock is also a
silence by the IPOC.

The reason is a restart of RSI: the controller needs some cycles for it, counts none of them as late, and begins
its counter at 0. The old corrections would then be wrong by as much as the arm had moved before.

*Lag.* The arm must be between the places to which the answers of the last `follow_lag_s` led, with a tolerance of
`follow_deg`. If the arm is elsewhere, no answer leads farther away from it.

The witness uses no count of `rsi_session`. It stores the last answered packet and the places of the answers
itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from typing import Any

from drivers.kuka.rsi.wire import Packet

Six = tuple[float, ...]

_PATIENT_PACKETS = 5
"""Number of packets that are left unanswered after a silence, so that the IPOC can catch up with it. A busy
machine causes such silences too."""
_SURE = 10
"""Number of answers after which the smallest step of the IPOC so far counts as its step per cycle. Before that, a
packet may have been lost on the network."""
_ROUNDING = 2e-5
"""Allowance for rounding: numbers on the wire have six decimals."""
_NOWHERE: Six = (0.0,) * 6


@dataclass(frozen=True)
class LagBounds:
    """Bounds of an answer's distance from the arm."""

    follow: Six
    """Allowed distance of the arm from the places to which the answers led it."""
    step: Six
    """One cycle's step."""
    lag_s: float
    """Time within which the arm reaches a place to which the answers led it."""


class ArmWitness:
    """Checks the invariant. A `place` is the arm's position: its axes, or the flange's pose."""

    def __init__(
        self,
        place_at: Callable[[Six], Any],
        between: Callable[[Any, Any], Six],
        bounds: LagBounds,
        *,
        cycle_s: float,
        counts_in_a_row: bool,
        unaccounted_s: float,
    ) -> None:
        """`place_at` returns the place at reported axes; `between` returns the correction from one place to
        another. `counts_in_a_row`: an answer in time sets the counter of late answers to 0. `unaccounted_s` is the
        length of a silence that ends the session; 0: no silence ends it."""
        self._reported, self._between = place_at, between
        self._follow = bounds.follow
        self._follow_and_step: Six = tuple(map(float.__add__, bounds.follow, bounds.step))
        self._cycle_s, self._in_a_row, self._unaccounted_s = cycle_s, counts_in_a_row, unaccounted_s
        self._led: deque[Any] = deque(maxlen=2 + ceil(bounds.lag_s / cycle_s))
        """Places to which the last answers led, the newest last."""
        self._last: Packet | None = None
        """The last answered packet."""
        self._last_ns = self._step = self._answered = self._waits = 0

    def break_reason(self, packet: Packet, now_ns: int) -> str:
        """Return the reason why this packet does not prove that corrections still count from the session's start;
        "" if it proves this."""
        last = self._last
        if last is None:
            return ""
        advance = int(packet.ipoc) - int(last.ipoc)
        step = min(self._step or advance, advance)
        if advance <= 0:
            return f"its IPOC went back from {int(last.ipoc)} to {int(packet.ipoc)}: RSI was started anew"
        if advance % (self._step or step) and self._answered > _SURE:
            return f"its IPOC advanced by {advance} instead of a multiple of {self._step}: its cycle has changed"
        missing_cycles = advance // step - 1
        if last.delay is None or packet.delay is None:
            return f"{missing_cycles} cycles are missing, and no counter tells whether RSI was started anew" * (
                missing_cycles > 0
            )
        rise = packet.delay - last.delay
        in_a_row = packet.delay == missing_cycles or rise == missing_cycles + 1
        is_counted = in_a_row if self._in_a_row else rise >= missing_cycles
        if not is_counted and rise < 0:
            return (
                f"its counter of late answers fell from {last.delay} to {packet.delay}: RSI was started anew, or "
                "the controller counts late answers in a row (`delay_counts`)"
            )
        if not is_counted:
            return (
                f"{missing_cycles} cycles passed without an answer, but its counter of late answers "
                f"rose by {rise}: RSI was started anew, or its cycle has changed"
            )
        silent_s = (now_ns - self._last_ns) / 1e9 - advance // step * self._cycle_s
        if not 0 < self._unaccounted_s < silent_s:
            self._waits = 0
        elif self._waits >= _PATIENT_PACKETS:
            return f"it was silent for {silent_s:.2f} s that its IPOC did not count: RSI was started anew"
        return ""

    def waits(self, packet: Packet, now_ns: int) -> bool:
        """True for a packet after a silence that its IPOC does not count yet. Such a packet is left unanswered: if
        only this machine was busy, an answer would be late, and the IPOC of the next packets counts the
        silence."""
        last = self._last
        if last is None or not self._unaccounted_s or not self._step:
            return False
        cycles = (int(packet.ipoc) - int(last.ipoc)) // self._step
        if (now_ns - self._last_ns) / 1e9 - cycles * self._cycle_s <= self._unaccounted_s:
            return False
        self._waits += 1
        return True

    def strays(self, joints_deg: Six) -> bool:
        """True if the arm is not where it was led. Then no further motion must be commanded."""
        return bool(self._led) and any(self._beyond(self._reported(joints_deg), self._led[-1], self._follow))

    def violation(self, packet: Packet, place: Any, now_ns: int) -> str:
        """Return the reason why an answer to `packet` that leads to `place` must not be sent. If there is none,
        return "", and count the answer as sent."""
        if why := self.break_reason(packet, now_ns):
            return why
        arm = self._reported(packet.joints_deg)
        before = self._led[-1] if self._led else arm
        beyond = self._beyond(arm, place, self._follow_and_step)
        if any(beyond):
            already = map(abs, self._between(arm, before))
            away = map(abs, self._between(arm, place))
            for number, (off, was, out) in enumerate(zip(away, already, beyond, strict=True), start=1):
                if out and not off <= was + _ROUNDING:
                    return f"it would lead axis or coordinate {number} to {off:.3f} from where the arm is reported"
        if self._last is not None:
            advance = int(packet.ipoc) - int(self._last.ipoc)
            self._step = min(self._step or advance, advance)
        self._led.append(place)
        self._last, self._last_ns = packet, now_ns
        self._answered += 1
        return ""

    def _beyond(self, arm: Any, place: Any, within: Six) -> list[bool]:
        """Tell whether the arm is further from a place than the lag allows, for each number of the place."""
        off = self._between(arm, place)
        behind = self._between(self._led[0], self._led[-1]) if self._led else _NOWHERE
        return [not abs(away) <= limit + abs(lag) for away, lag, limit in zip(off, behind, within, strict=True)]
