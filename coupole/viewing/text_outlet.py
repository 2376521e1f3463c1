"""Standard output and standard error of a command that holds a cell: nothing in it waits for a reader of text.

A terminal may stand still (Ctrl-S, a half-dead ssh), a pipe may be full, or a disk may hang. A write to them may
block for ever, and would block the supervising thread too. `install` puts a queue in between. Text of Python goes
into it at once. File descriptors 1 and 2 become pipes into it, for libraries and for children that inherit them.
Only one thread writes to the reader and may wait. When the queue is full the oldest text is dropped; a message
says so when somebody reads again. `finish` gives the reader a bounded time at the end.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import select
import signal
import sys
import threading

from coupole.viewing.text_queue import TextQueue, Unread

PATIENCE_S = 1.0
"""A command at its end waits this long for a reader who takes nothing."""
AT_MOST_S = 10.0
"""A command at its end waits at most this long for a slow reader."""
DOCUMENT_PATIENCE_S = 10.0
"""A command at its end waits this long for a reader of standard output who takes nothing, because half a document
is useless."""
_DOCUMENT_BYTES = 1 << 24
_WRITE_BYTES = 4096
_FIRST_KEPT_FD = 10


class Outlet:
    """The way of a standard stream from this process, its libraries and children to its reader."""

    def __init__(self, fd: int, queue: TextQueue) -> None:
        """Lead descriptor `fd` into the queue from now on. Only a thread of this outlet writes to its former
        target."""
        self.fd, self.queue = fd, queue
        self.reader_fd = fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, _FIRST_KEPT_FD)
        read_fd, write_fd = os.pipe()
        self._pipe = fcntl.fcntl(read_fd, fcntl.F_DUPFD_CLOEXEC, _FIRST_KEPT_FD)
        os.set_blocking(self._pipe, False)
        os.dup2(write_fd, fd)
        os.close(read_fd)
        os.close(write_fd)
        self._order = threading.RLock()
        threading.Thread(target=self._give, name=f"text {fd}", daemon=True).start()
        threading.Thread(target=self._listen, name=f"text into {fd}", daemon=True).start()

    def append(self, text: bytes) -> None:
        """Append text after the text of libraries and children so far. Never waits."""
        with self._order:
            self.collect()
            self.queue.append(text)

    def collect(self) -> bool:
        """Put the text of libraries and children into the queue. Return whether any library or child can still
        write.
        """
        with self._order, contextlib.suppress(BlockingIOError):
            while text := os.read(self._pipe, 65536):
                self.queue.append(text)
            return False
        return True

    def _listen(self) -> None:
        while True:
            select.select([self._pipe], [], [])
            if not self.collect():  # somebody has closed the descriptor
                return

    def _give(self) -> None:
        # In the background of a terminal with `tostop` a write would stop the whole process (SIGTTOU).
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        while True:
            text = self.queue.take()
            while text:
                try:
                    count = os.write(self.reader_fd, text[:_WRITE_BYTES])
                except BlockingIOError:  # whoever gave us the stream had made it so
                    select.select([], [self.reader_fd], [])
                except OSError:  # a closed pipe, a terminal that is gone, a full disk
                    self.queue.note_refused(text)
                    break
                else:
                    self.queue.gave(count)
                    text = text[count:]


class _Stream(io.RawIOBase):
    """Stream to which `sys.stdout` and `sys.stderr` write."""

    def __init__(self, outlet: Outlet) -> None:
        self._outlet = outlet

    def write(self, text: bytes) -> int:  # type: ignore[override]
        self._outlet.append(bytes(text))
        return len(text)

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._outlet.fd

    def isatty(self) -> bool:
        return os.isatty(self._outlet.reader_fd)


class _Noticed(io.TextIOWrapper):
    """A standard stream that knows whether anything was written to it."""

    has_text = False

    def write(self, text: str) -> int:
        self.has_text = self.has_text or bool(text)
        return super().write(text)


_outlets: dict[str, Outlet] = {}


def keep_standard_places() -> None:
    """Replace closed standard streams by ones that lead nowhere. Otherwise a device or pipe that is opened could
    take their place and receive text, and writers would have to check for them. Call this before anything is
    opened.

    Standard output keeps what it could not write (PYTHONUNBUFFERED would drop it): see `full_stdout`."""
    for fd, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        _lead_nowhere_if_closed(fd)
        stream = getattr(sys, name)
        if stream is None or (fd == 1 and isinstance(getattr(stream, "buffer", None), io.FileIO)):
            stream = open(fd, mode, buffering=1, encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
            setattr(sys, name, stream)


def notice_stdout() -> None:
    """Notice from now on whether anything is written to standard output (`has_written_stdout`)."""
    before = sys.stdout
    if _is(before, 1):
        file = open(1, "wb", closefd=False)  # noqa: SIM115
        sys.stdout = _Noticed(file, before.encoding, before.errors, line_buffering=before.isatty())


def has_written_stdout() -> bool:
    """Tell whether this process has written to standard output; True if that is not known."""
    return not isinstance(sys.stdout, _Noticed) or sys.stdout.has_text


def install() -> None:
    """Let no output of this process wait for a reader, from now to its end. Streams that somebody has replaced
    (tests) stay as they are."""
    keep_standard_places()
    for fd, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if name in _outlets or not _is(stream, fd):
            continue
        outlet = Outlet(fd, TextQueue() if fd == 2 else TextQueue(_DOCUMENT_BYTES, tells=False))
        _outlets[name] = outlet
        encoding, errors = getattr(stream, "encoding", "utf-8"), getattr(stream, "errors", "backslashreplace")
        setattr(
            sys,
            name,
            _Noticed(
                _Stream(outlet),  # type: ignore[arg-type]
                encoding=encoding,
                errors=errors,
                line_buffering=True,
            ),
        )


def full_stdout() -> str:
    """Return why standard output takes no text; empty if it takes text, or if its reader has gone. Text that
    it did not take is dropped.
    """
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        return ""
    except OSError as error:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.stdout.flush()
        return error.strerror or str(error)
    return ""


def unread() -> Unread | None:
    """Return the text of standard error that was not taken so far. None if all text was taken, or if its reader is
    only a little late."""
    outlet = _outlets.get("stderr")
    text = outlet.queue.unread() if outlet else None
    return text if text and (text.lost_bytes or text.stalled_s >= PATIENCE_S) else None


def terminal_size() -> os.terminal_size | None:
    """Return the size of the terminal that reads standard error. None if there is no terminal, or if text does not
    go there through a queue."""
    outlet = _outlets.get("stderr")
    with contextlib.suppress(OSError):
        return os.get_terminal_size(outlet.reader_fd) if outlet else None
    return None


def say_now(text: str, patience_s: float) -> None:
    """Write text to standard error, and give its reader this time to take it. Never waits longer."""
    with contextlib.suppress(OSError, ValueError, AttributeError):  # nobody is there
        if "stderr" in _outlets:
            sys.stderr.write(text)
            finish(patience_s, 0.0)
        elif select.select([], [sys.stderr.fileno()], [], patience_s)[1]:
            os.write(sys.stderr.fileno(), text.encode())


def lead_blocked_nowhere(patience_s: float) -> None:
    """Drop the text of a standard stream from now on, if its reader takes nothing for this time. After a signal
    nothing may wait for the reader. Streams with a queue drop text by themselves."""
    for fd, name in ((1, "stdout"), (2, "stderr")):
        with contextlib.suppress(OSError):
            if name not in _outlets and not select.select([], [fd], [], patience_s)[1]:
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, fd)
                os.close(nowhere)


def finish(patience_s: float = PATIENCE_S, document_s: float = DOCUMENT_PATIENCE_S) -> None:
    """Wait a bounded time until the readers have taken everything. `document_s` is the time for standard
    output."""
    for name, outlet in _outlets.items():
        with contextlib.suppress(OSError, ValueError):
            getattr(sys, name).flush()
        outlet.collect()
    for name, outlet in _outlets.items():
        outlet.queue.wait_until_drained(document_s if name == "stdout" else patience_s, AT_MOST_S)


def _is(stream: object, fd: int) -> bool:
    """Tell whether a stream leads to a descriptor."""
    try:
        return bool(stream.fileno() == fd)  # type: ignore[attr-defined]
    except (AttributeError, OSError, ValueError):
        return False


def _lead_nowhere_if_closed(fd: int) -> None:
    try:
        fcntl.fcntl(fd, fcntl.F_GETFD)
    except OSError:
        nowhere = os.open(os.devnull, os.O_RDWR)
        if nowhere != fd:
            os.dup2(nowhere, fd)
            os.close(nowhere)
