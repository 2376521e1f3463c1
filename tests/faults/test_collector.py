"""When Python looks for reference cycles."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator
from pathlib import Path

import pytest
from failing_calls import acquire, cell_in

from coupole.acquisition.collector import collected_when_asked


@pytest.fixture
def eager() -> Iterator[None]:
    """A collector that would run all the time."""
    before = gc.get_threshold()
    gc.set_threshold(100, 2, 2)
    yield
    gc.set_threshold(*before)


class Ring:
    """A cycle of one object."""

    def __init__(self) -> None:
        self.itself = self


def test_cycles_are_collected_when_asked_and_not_otherwise(eager: None) -> None:
    with collected_when_asked() as collect:
        ring = weakref.ref(Ring())
        keeps = [[] for _ in range(1000)]
        assert ring() is not None
        collect()
        assert ring() is None
        assert gc.get_freeze_count() > len(keeps)
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_a_session_collects_only_before_a_view_while_the_arm_rests_and_nothing_shines(
    tmp_path: Path, eager: None
) -> None:
    cell = cell_in(tmp_path)
    busy, asked, by_itself = [False], [0], [0]

    def follow(_device: str, method: str, _clock: object) -> None:
        """Busy from the command of a motion or burst until the first call after it."""
        busy[0] = (busy[0] or method in {"move_to", "start"}) and method not in {"configure", "statistics"}

    def watch(phase: str, _info: object) -> None:
        asked[0] += phase == "start" and not gc.isenabled()
        by_itself[0] += phase == "start" and busy[0]

    gc.callbacks.append(watch)
    try:
        with cell.world({"kind": "drop_trigger", "edge": 9}):
            ended = acquire(cell, follow)  # type: ignore[arg-type]
    finally:
        gc.callbacks.remove(watch)
    assert ended.code == 0, ended
    assert by_itself == [0]
    assert asked[0] >= 2, "before each view"
