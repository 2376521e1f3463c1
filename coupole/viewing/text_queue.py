"""Text on its way to a reader who may not read. It stays in order and in bounded memory, and no writer waits."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

MOST_BYTES = 1 << 20


@dataclass(frozen=True)
class Unread:
    """Text that a reader has not been given."""

    lost_lines: int
    lost_bytes: int
    waiting_bytes: int
    stalled_s: float
    """Time for which the reader has taken nothing, although text waits."""

    def __bool__(self) -> bool:
        return bool(self.lost_bytes or self.waiting_bytes)


class TextQueue:
    """Bytes in the order in which they were put in. When the queue is full the oldest bytes are dropped, and the
    next text that the reader takes says how many lines were lost. Any thread may use it."""

    def __init__(self, most_bytes: int = MOST_BYTES, *, tells: bool = True) -> None:
        """Make an empty queue. With `tells`, a message takes the place of dropped text. For a document, `tells` is
        False."""
        self._most_bytes, self._tells = most_bytes, tells
        self._pieces: deque[bytes] = deque()
        self._waiting_bytes = self._taken_bytes = 0  # taken: handed out, not yet with the reader
        self._lost_lines = self._lost_bytes = 0
        self._untold_lines = self._untold_bytes = 0
        self._moved_s = time.monotonic()
        self._changed = threading.Condition()

    def append(self, text: bytes) -> None:
        """Append text. Never waits."""
        if not text:
            return
        with self._changed:
            if not (self._waiting_bytes or self._taken_bytes):
                self._moved_s = time.monotonic()
            self._pieces.append(text)
            self._waiting_bytes += len(text)
            while self._waiting_bytes > self._most_bytes:
                oldest = self._pieces.popleft()
                self._waiting_bytes -= len(oldest)
                self._note_lost(oldest)
            self._changed.notify_all()

    def take(self, wait_s: float | None = None) -> bytes:
        """Take the oldest piece, to be given to the reader; empty if none comes within a time. Report the result
        by `gave` or `note_refused`."""
        with self._changed:
            self._changed.wait_for(lambda: self._pieces or (self._tells and self._untold_bytes), wait_s)
            if self._tells and self._untold_bytes:
                return self._handed_out(self._notice())
            if not self._pieces:
                return b""
            piece = self._pieces.popleft()
            self._waiting_bytes -= len(piece)
            return self._handed_out(piece)

    def gave(self, count: int) -> None:
        """Note that the reader has taken this number of bytes of the piece."""
        with self._changed:
            self._taken_bytes -= count
            self._moved_s = time.monotonic()
            self._changed.notify_all()

    def note_refused(self, rest: bytes) -> None:
        """Note that the reader refused this rest of the piece."""
        with self._changed:
            self._taken_bytes -= len(rest)
            self._lost_lines, self._lost_bytes = self._lost_lines + rest.count(b"\n"), self._lost_bytes + len(rest)
            self._changed.notify_all()

    def unread(self) -> Unread:
        with self._changed:
            waiting = self._waiting_bytes + self._taken_bytes
            stalled_s = time.monotonic() - self._moved_s if waiting else 0.0
            return Unread(self._lost_lines, self._lost_bytes, waiting, stalled_s)

    def wait_until_drained(self, patience_s: float, at_most_s: float) -> bool:
        """Wait until the reader has all bytes. Give up if the reader takes none for `patience_s`, or after
        `at_most_s`."""
        begun_s = time.monotonic()
        with self._changed:
            while self._waiting_bytes or self._taken_bytes:
                now_s = time.monotonic()
                end_s = min(max(begun_s, self._moved_s) + patience_s, begun_s + at_most_s)
                if now_s >= end_s:
                    return False
                self._changed.wait(end_s - now_s)
            return True

    def _note_lost(self, text: bytes) -> None:
        lines = text.count(b"\n")
        self._lost_lines, self._lost_bytes = self._lost_lines + lines, self._lost_bytes + len(text)
        self._untold_lines, self._untold_bytes = self._untold_lines + lines, self._untold_bytes + len(text)

    def _notice(self) -> bytes:
        amount = f"{self._untold_lines} lines of text ({self._untold_bytes} bytes)"
        self._untold_lines = self._untold_bytes = 0
        return f"\n[{amount} were dropped: nobody read them]\n".encode()

    def _handed_out(self, text: bytes) -> bytes:
        self._taken_bytes += len(text)
        return text
