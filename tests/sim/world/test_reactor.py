"""The world's event loop, where events come together."""

from __future__ import annotations

import os
from pathlib import Path

from sim.world.clock import ClockWriter
from sim.world.reactor import Reactor


def test_a_line_that_is_closed_by_another_event_of_the_same_moment_is_not_read_any_more(tmp_path: Path) -> None:
    """An order to unplug the box and a byte from its client come at once: whichever is first, the world lives."""
    reactor = Reactor(ClockWriter(tmp_path / "clock", speed=1.0))
    lines = [os.pipe(), os.pipe()]
    read = []

    def take(number: int) -> None:
        read.append(os.read(lines[number][0], 1))
        reactor.remove_reader(lines[1 - number][0])
        os.close(lines[1 - number][0])
        reactor.after(0.05, reactor.stop)

    for number, (ours, theirs) in enumerate(lines):
        reactor.add_reader(ours, lambda number=number: take(number))  # type: ignore[misc]
        os.write(theirs, b"x")
    reactor.run()
    assert read == [b"x"]
