"""The world's event loop, where events come together."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import pytest

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


def open_files() -> set[str]:
    """Numbers of the files that this process has open; that of the listing is closed again."""
    return {path.name for path in Path("/proc/self/fd").iterdir() if path.is_symlink()}


def test_one_that_has_ended_has_closed_its_pipe_and_is_woken_by_nobody(tmp_path: Path) -> None:
    """A worker of tests has hundreds of them; a number that is free again belongs to another file."""
    before = open_files()
    reactor = Reactor(ClockWriter(tmp_path / "clock", speed=1.0))
    reactor.at(0, reactor.stop)
    reactor.run()
    reactor._selector.close()
    assert open_files() == before
    others = [os.pipe() for _ in range(4)]  # they have its numbers now
    try:
        reactor.stop()
        reactor.call_threadsafe(lambda: None)
        for reader, _ in others:
            os.set_blocking(reader, False)
            with pytest.raises(BlockingIOError):
                os.read(reader, 1)
    finally:
        for end in itertools.chain(*others):
            os.close(end)
