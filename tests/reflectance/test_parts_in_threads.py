"""Work in parts, in threads."""

from __future__ import annotations

import threading
import time

import cells
import pytest

from coupole.reflectance.parts_in_threads import in_threads


def test_each_part_is_done_once() -> None:
    done: list[int] = []

    def work(first: int) -> None:
        done.append(first)

    in_threads(work, 11, part=4, threads=3)
    assert sorted(done) == [0, 4, 8]


def test_the_first_part_is_done_before_the_others_begin() -> None:
    """Each kernel has been called when threads call it together; the next time all go at once."""
    spans: list[tuple[int, float, float]] = []
    all_at_once = threading.Barrier(2)

    def work(first: int) -> None:
        begun_s = time.monotonic()
        if meet:
            all_at_once.wait(cells.PATIENCE_S)
        time.sleep(0.02)
        spans.append((first, begun_s, time.monotonic()))

    meet = False
    in_threads(work, 6, threads=3)
    first_end_s = next(end_s for first, _, end_s in spans if first == 0)
    assert all(begun_s >= first_end_s for first, begun_s, _ in spans if first != 0)
    meet = True
    in_threads(work, 2, threads=2)  # each of the two waits for the other


def test_what_a_part_raises_is_raised() -> None:
    def work(first: int) -> None:
        if first == 3:
            raise ValueError("part 3")

    with pytest.raises(ValueError, match="part 3"):
        in_threads(work, 5, threads=2)


def test_nothing_to_do_is_done() -> None:
    in_threads(lambda first: pytest.fail("called"), 0)
