"""The queue between what is printed and who reads it."""

from __future__ import annotations

import re
import threading

from hypothesis import given
from hypothesis import strategies as st

from coupole.viewing.text_queue import TextQueue

PIECES = st.lists(st.binary(min_size=1, max_size=40), max_size=60)


def all_of(queue: TextQueue) -> bytes:
    """What a reader gets now."""
    found = b""
    while piece := queue.take(0):
        found += piece
        queue.gave(len(piece))
    return found


@given(PIECES)
def test_a_reader_who_reads_gets_everything_in_order(pieces: list[bytes]) -> None:
    queue, found = TextQueue(40), b""
    for piece in pieces:
        queue.append(piece)
        found += all_of(queue)
    assert found == b"".join(pieces)
    assert not queue.unread()


@given(PIECES, st.integers(1, 200))
def test_a_queue_that_nobody_reads_keeps_the_newest_within_its_bound_and_counts_the_rest(
    pieces: list[bytes], most_bytes: int
) -> None:
    queue, put = TextQueue(most_bytes, tells=False), b"".join(pieces)
    for piece in pieces:
        queue.append(piece)
        assert queue.unread().waiting_bytes <= most_bytes
    unread, kept = queue.unread(), all_of(queue)
    assert put.endswith(kept)
    gone = put[: len(put) - len(kept)]
    assert (unread.lost_bytes, unread.lost_lines) == (len(gone), gone.count(b"\n"))


def test_the_next_reader_is_told_how_many_lines_were_dropped_where_they_were() -> None:
    queue = TextQueue(20)
    for number in range(10):
        queue.append(b"line %d is\n" % number)
    found = all_of(queue)
    assert re.fullmatch(rb"\n\[8 lines of text \(80 bytes\) were dropped: .*\]\nline 8 is\nline 9 is\n", found)
    queue.append(b"on\n")
    assert all_of(queue) == b"on\n"


def test_what_a_reader_refuses_is_counted() -> None:
    queue = TextQueue()
    queue.append(b"one\ntwo\n")
    queue.note_refused(queue.take(0))
    assert (queue.unread().lost_lines, queue.unread().waiting_bytes) == (2, 0)


def test_the_end_waits_for_a_reader_who_takes_something_and_not_for_one_who_does_not() -> None:
    queue = TextQueue()
    queue.append(b"text")
    assert not queue.wait_until_drained(0.05, 10.0)
    piece = queue.take(0)
    threading.Timer(0.05, queue.gave, [len(piece)]).start()
    assert queue.wait_until_drained(5.0, 10.0)
