"""The controller's cycle, measured by the arrival of its packets and by its IPOC.

Every packet advances the commanded axes by one cycle of `cycle_ms`. If the controller runs at 4 ms and the driver
is set to 12 ms, the arm therefore moves three times as fast as the driver computes. So the cycle is measured
before the first motion, and as long as packets come. The arrival on the machine's clock decides. The IPOC is a
second witness. On real controllers the IPOC counts the cycle in ms. In some simulators it counts packets, and
then says nothing about the cycle. A simulated world that waits for answers, or runs at another speed than the
machine's clock, declares its cycle instead.
"""

from __future__ import annotations

from collections import Counter

WINDOW = 100
"""Number of cycles over which arrivals are averaged."""
_DECLARED_WINDOW = 10
"""Number of cycles after which the IPOC confirms a declared cycle."""
_FASTEST, _SLOWEST = 0.85, 1.7
"""Allowed ratio of the measured cycle to the set one. If a machine is busy for 60 ms at the beginning of a window,
a cycle of 4 ms seems 15 % shorter. 1.7 is midway between equal and threefold."""
_WRONG_WINDOWS = 2
"""Number of consecutive windows that prove a mismatch. So a single moment in which the machine was busy is not
taken as proof.
"""


class CycleMeter:
    """Measures the cycle. Feed it every packet that continues the session, once."""

    def __init__(self, cycle_s: float, declared_s: float | None) -> None:
        """`declared_s` is the cycle that a simulated world declares. None: arrivals are measured."""
        self.measured_ns = 0
        """Mean of the last window, or the declared cycle; 0 before it is known."""
        self.ipoc_step = 0
        """Step of the IPOC from packet to packet, from the first window; 0 before its end."""
        self._cycle_ms = 1e3 * cycle_s
        self._declared_ms = 1e3 * declared_s if declared_s else None
        self._advances: Counter[int] = Counter()
        self._begun_ns: int | None = None
        self._last_ns = self._cycles = self._wrong = 0
        self._gaps_ms: list[float] = []
        """Time per cycle between the packets of the window."""

    def packet(self, now_ns: int, advance: int, cycles: int) -> str:
        """Note a packet whose IPOC is `advance` higher than the last one's, `cycles` cycles later. Return why the
        cycle is not the one that was set, or "" while nothing proves this."""
        if self._begun_ns is None:
            self._begun_ns = self._last_ns = now_ns
            return ""
        self._cycles += cycles
        if not self.ipoc_step:
            self._advances[advance] += 1
        self._gaps_ms.append((now_ns - self._last_ns) / 1e6 / cycles)
        self._last_ns = now_ns
        if self._cycles < (WINDOW if self._declared_ms is None else _DECLARED_WINDOW):
            return ""
        arrived_ms = (now_ns - self._begun_ns) / 1e6 / self._cycles
        self._begun_ns, self._cycles = now_ns, 0
        return self._judge_cycle(arrived_ms if self._declared_ms is None else self._declared_ms)

    def _judge_cycle(self, cycle_ms: float) -> str:
        first = not self.measured_ns
        ratio = cycle_ms / self._cycle_ms
        wrong = ratio < _FASTEST
        if ratio > _SLOWEST:
            # A link that falters makes the mean longer, but few of the gaps.
            median_ms = sorted(self._gaps_ms)[len(self._gaps_ms) // 2]
            wrong |= self._declared_ms is not None or median_ms > _SLOWEST * self._cycle_ms
        self._gaps_ms.clear()
        self._wrong = self._wrong + 1 if wrong else 0
        step = self.ipoc_step or self._step()
        if self._wrong >= _WRONG_WINDOWS or (wrong and self._declared_ms is not None):
            return self._mismatch(cycle_ms, step)
        if wrong:
            return ""
        if first and step not in (1, round(self._cycle_ms)):
            return self._mismatch(cycle_ms, step)
        self.measured_ns, self.ipoc_step = round(cycle_ms * 1e6), step
        return ""

    def _mismatch(self, cycle_ms: float, step: int) -> str:
        source = "its packets come every" if self._declared_ms is None else "its simulated world declares"
        return f"{source} {cycle_ms:.2f} ms and its IPOC counts {step} a packet; `cycle_ms` is {self._cycle_ms:g}"

    def _step(self) -> int:
        """Return the step of the IPOC: the smallest advance that is not an exception. Lost packets cause larger
        advances."""
        often = [advance for advance, count in self._advances.items() if 5 * count >= self._advances.total()]
        return min(often or self._advances)
