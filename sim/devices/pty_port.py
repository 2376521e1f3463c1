"""A serial port without a wire: a pseudo-terminal, read by the world at the rate of a serial line.

A pseudo-terminal carries no BREAK: the kernel drops it. But in packet mode (tty_ioctl(2), TIOCPKT) it tells the
master, ahead of all bytes, that the client has discarded its output (tcflush(3), TCOFLUSH). A host discards its
output before a BREAK, so that the BREAK does not wait for unsent bytes. Here this discarding represents the BREAK.
"""

from __future__ import annotations

import fcntl
import os
import struct
import termios
import tty
from collections.abc import Callable

from sim.world.reactor import Reactor, Timer

_PIECE_BYTES, _PIECE_S = 64, 0.006
"""Largest size and duration of the pieces in which bytes are transferred; a piece has at least one byte."""
_UNPACED_BYTES = 4096
"""Largest piece if the rate is not limited."""
_MOST_UNREAD_BYTES = 2**20
"""Largest output buffer. If a client does not read, further output is lost."""
_RETRY_S = 0.001
_BITS_PER_BYTE = 10


class PtyPort:
    """The box's end of a serial line. `port` is what a client opens; `baud` 0: the rate is not limited.

    The world keeps the client's side open too, so the line does not hang up when a client leaves.
    """

    def __init__(self, reactor: Reactor, baud: int) -> None:
        self._reactor = reactor
        self._byte_s = _BITS_PER_BYTE / baud if baud else 0.0
        self._piece_bytes = max(1, min(_PIECE_BYTES, int(_PIECE_S / self._byte_s))) if baud else _UNPACED_BYTES
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self._received: Callable[[bytes], None] | None = None
        self._on_break: Callable[[], None] | None = None
        self._output = bytearray()
        self._timers: dict[str, Timer] = {}
        self._reading = self._sending = False

    def listen(self, on_bytes: Callable[[bytes], None], on_break: Callable[[], None] | None = None) -> None:
        """Call `on_bytes` with bytes as they arrive, and `on_break`, if given, at a BREAK."""
        self._received, self._on_break = on_bytes, on_break
        fcntl.ioctl(self._master, termios.TIOCPKT, struct.pack("i", 1))
        self._wait_for_bytes()

    def drop_output(self) -> None:
        """Forget the bytes that are queued for the client."""
        self._output.clear()

    def send(self, data: bytes) -> bool:
        """Queue bytes for the client. False if the client has left too many bytes unread; the new ones are then
        lost."""
        if self._received is None:
            return True
        if len(self._output) + len(data) > _MOST_UNREAD_BYTES:
            return False
        self._output += data
        if not self._sending:
            self._sending = True
            if self._byte_s:
                self._write_later()
            else:
                self._write()
        return True

    def mute(self) -> None:
        """Stop reading and writing; the line stays up."""
        self._received = None
        self._output.clear()
        for timer in self._timers.values():
            timer.cancel()
        self._stop_waiting()

    def close(self) -> None:
        """Close the line: the client sees a hang-up. A second call does nothing."""
        self.mute()
        if self._master >= 0:
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1

    def _wait_for_bytes(self) -> None:
        if not self._reading:
            self._reactor.add_reader(self._master, self._read_piece)
            self._reading = True

    def _stop_waiting(self) -> None:
        if self._reading:
            self._reactor.remove_reader(self._master)
            self._reading = False

    def _read_piece(self) -> None:
        """Read a piece from the terminal. It is passed on at the time at which its last bit would have arrived."""
        try:
            packet = os.read(self._master, 1 + self._piece_bytes)
        except BlockingIOError:
            self._wait_for_bytes()
            return
        piece = packet[1:]
        if not piece:
            self._take_status(packet[0])
            return
        if self._byte_s:
            self._stop_waiting()
            callback = self._deliver_and_read_on(piece)
            self._timers["read"] = self._reactor.after(len(piece) * self._byte_s, callback)
        elif self._received is not None:
            self._received(piece)

    def _take_status(self, status: int) -> None:
        """Act on the status that a packet without bytes reports: if the client has discarded input, a BREAK
        follows."""
        if status & termios.TIOCPKT_FLUSHWRITE and self._on_break is not None:
            termios.tcflush(self._master, termios.TCIFLUSH)  # bytes that the kernel had already passed on
            self._on_break()
        self._wait_for_bytes()

    def _deliver_and_read_on(self, piece: bytes) -> Callable[[], None]:
        def callback() -> None:
            if self._received is not None:
                self._received(piece)
            if self._received is not None:  # a fault may have muted the line meanwhile
                self._read_piece()

        return callback

    def _write(self) -> None:
        """Write the part of a piece that the terminal accepts. Call it again when the bits of the next piece have
        passed."""
        try:
            byte_count = os.write(self._master, self._output[: self._piece_bytes])
        except BlockingIOError:
            byte_count = 0
        del self._output[:byte_count]
        self._sending = bool(self._output)
        if self._sending:
            self._write_later()

    def _write_later(self) -> None:
        piece_s = min(len(self._output), self._piece_bytes) * self._byte_s
        self._timers["write"] = self._reactor.after(piece_s or _RETRY_S, self._write)
