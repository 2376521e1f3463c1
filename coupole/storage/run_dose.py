"""The light that a run has given the object in all its sessions, from its journal.

If the end of a burst was not recorded (its process was killed), its planned light counts.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import zip_longest

from coupole.storage.journal_events import BurstBegun, BurstEnded, Event


def lux_h_of_points(events: Iterable[Event]) -> tuple[float, ...]:
    """Return lux hours at each of the object's dose points; empty if no light is recorded."""
    total: tuple[float, ...] = ()
    burst_lux_h: tuple[float, ...] = ()
    for event in events:
        if isinstance(event, BurstBegun):
            total, burst_lux_h = _sum(total, burst_lux_h), event.planned_lux_h
        elif isinstance(event, BurstEnded) and event.given_lux_h is not None:
            total, burst_lux_h = _sum(total, event.given_lux_h), ()
    return _sum(total, burst_lux_h)


def highest_lux_h(events: Iterable[Event]) -> float:
    """Return the light at the point with the highest dose, which is the run's dose."""
    return max(lux_h_of_points(events), default=0.0)


def _sum(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(x + y for x, y in zip_longest(a, b, fillvalue=0.0))
