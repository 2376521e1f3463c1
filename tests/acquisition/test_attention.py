"""The beats of whoever watches a motion."""

from __future__ import annotations

import threading
import time

import pytest

from coupole.supervision import Attention


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """What `time.monotonic_ns` says."""
    now_ns = [7_000_000_000]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[0])
    return now_ns


def test_the_longest_gap_is_that_between_two_looks_of_the_motion_under_way(clock: list[int]) -> None:
    attention = Attention()
    assert attention.begin() == clock[0]
    for step_ms in (20, 70, 10):
        clock[0] += step_ms * 1_000_000
        assert attention.look() == clock[0]
    assert attention.longest_gap_s() == pytest.approx(0.07)
    clock[0] += 5_000_000_000
    attention.begin()
    assert attention.longest_gap_s() == 0.0
    clock[0] += 30_000_000
    attention.look()
    clock[0] += 11_000_000_000
    assert attention.longest_gap_s() == pytest.approx(11.0), "frozen between the look and what it saw"


def test_only_the_thread_that_began_the_motion_beats_for_it(clock: list[int]) -> None:
    attention, beats = Attention(), []
    attention.begin()
    clock[0] += 80_000_000
    helper = threading.Thread(target=lambda: beats.append(attention.look()))
    helper.start()
    helper.join()
    assert beats == [None]
    clock[0] += 10_000_000
    assert attention.longest_gap_s() == pytest.approx(0.09)
