"""Carries bytes to and from a device on a serial line, with any URL that pyserial accepts.

Time-outs are counted on the rig's clock, so that they are right in a simulated world that runs faster or slower.
pyserial's own time-outs, in machine time, determine only how often the rig's clock is read.

A device clear is a BREAK on a serial line, and RFC 2217's BREAK on an `rfc2217://` port. On a `socket://`, which
carries only bytes, it is the end of the connection.
"""

from __future__ import annotations

import contextlib
import io
import select
import socket
import struct
import threading
from typing import Any

from coupole.clock import Clock, Deadline
from coupole.errors import DeviceLost
from drivers.ledbox.link import Cleared

_LOOK_S = 0.02
"""Machine time between two readings of the rig's clock."""
_BITS_PER_BYTE = 10
_QUIET_S, _DRAIN_S = 0.05, 2.0
_BREAK_BITS, _SHORTEST_BREAK_S = 25, 0.002
"""A BREAK is longer than any character, which has 10 bits, or 12 with parity and a second stop bit."""
_RECONNECT_S = 2.0
"""Time that a server may need until it accepts the next connection."""


class SerialLink:
    """An open serial port: a `drivers.ledbox.link.Link`."""

    def __init__(self, url: str, baud: int, clock: Clock) -> None:
        import serial

        # ValueError: a socket that another thread has closed has no file descriptor
        self._lost: tuple[type[Exception], ...] = (serial.SerialException, OSError, ValueError)
        with contextlib.suppress(ImportError):  # termios does not exist on Windows
            import termios

            self._lost += (termios.error,)  # pyserial does not convert it when it flushes a hung-up terminal
        self._url, self._baud, self._clock = url, baud, clock
        self.bytes_per_s = baud / _BITS_PER_BYTE
        self.clears = 0
        self._gate = threading.Lock()
        """Held for the moment of one write, and at the begin of a device clear. So no byte of an exchange follows
        the clear."""
        self._is_socket, self._hung_up = url.startswith("socket://"), False
        self._port: Any = self._open_port()

    def write(self, data: bytes, deadline: Deadline, clears: int) -> None:
        """Send all of `data`."""
        rest = memoryview(data)
        while rest:
            self._refuse_closed(clears)
            try:
                # A non-blocking write of pyserial 3.5 to a full port loops for ever: wait for room first
                if self._fileno is None or select.select([], [self._fileno], [], _LOOK_S)[1]:
                    with self._gate:
                        self._refuse_closed(clears)
                        rest = rest[self._port.write(rest) :]
                    continue
            except self._lost as error:
                raise self._failure(error, clears) from error
            if deadline.has_expired:
                raise TimeoutError(f"{len(rest)} of {len(data)} bytes could not be sent")

    def read_bytes(self, deadline: Deadline, clears: int) -> bytes:
        """Read at least one byte, and all others that have arrived."""
        while True:
            self._refuse_closed(clears)
            late = deadline.has_expired  # read first: bytes that arrived in time are accepted even if read late
            try:
                data: bytes = self._port.read(max(1, self._port.in_waiting))
            except self._lost as error:
                raise self._failure(error, clears) from error
            if data:
                return data
            if late:
                raise TimeoutError("nothing came")

    def waiting(self) -> bytes:
        """Return bytes that have already arrived, possibly none. Does not wait."""
        self._refuse_closed(self.clears)
        try:
            data: bytes = self._port.read(count) if (count := self._port.in_waiting) else b""
        except self._lost as error:
            raise ConnectionError(str(error)) from error
        return data

    def end_exchanges(self) -> None:
        """Make a device clear only on this side: nothing is sent, and running exchanges end with Cleared."""
        with self._gate:
            self.clears += 1

    def device_clear(self) -> None:
        """Discard unsent bytes, then send BREAK. On a socket, end the connection and drop its bytes."""
        self.end_exchanges()
        with self._gate:
            if not self._port.is_open:
                return
            if self._is_socket:
                self._hang_up()
                return
            try:
                self._port.reset_output_buffer()
            except self._lost as error:
                raise ConnectionError(str(error)) from error
            # an adapter without BREAK: the following commands reach the box all the same
            with contextlib.suppress(*self._lost):
                self._port.break_condition = True
                self._clock.sleep(max(_SHORTEST_BREAK_S, _BREAK_BITS / self._baud))
                self._port.break_condition = False

    def clear(self) -> None:
        """Discard input until the line is quiet. Connect again if a device clear has ended the connection."""
        if self._hung_up:
            self._connect_again()
        deadline, clears = Deadline(self._clock, _DRAIN_S), self.clears
        with contextlib.suppress(TimeoutError):
            while not deadline.has_expired:
                self.read_bytes(Deadline(self._clock, _QUIET_S), clears)

    def close(self) -> None:
        """Release the port; a second call does nothing."""
        self._url = ""
        if not self._port.is_open:
            return
        with contextlib.suppress(*self._lost):
            self._port.reset_output_buffer()  # otherwise close() may wait for a dead line to drain
        connection = getattr(self._port, "_socket", None)
        with contextlib.suppress(*self._lost):
            self._port.close()
        if connection is not None:
            connection.close()  # pyserial 3.5 does not, if the other side of a socket:// has hung up

    def _open_port(self) -> Any:
        import serial

        own_port = {} if "://" in self._url else {"exclusive": True}
        try:
            port = serial.serial_for_url(self._url, baudrate=self._baud, timeout=_LOOK_S, **own_port)
        except (serial.SerialException, OSError, ValueError) as error:
            raise ConnectionError(str(error)) from error
        try:
            self._fileno: int | None = port.fileno()
            port.write_timeout = 0
        except (AttributeError, io.UnsupportedOperation):
            self._fileno = None  # rfc2217: writes go to a socket, all at once
        return port

    def _hang_up(self) -> None:
        """Reset the connection: bytes that are still on their way are discarded, here and at the box. The port
        stays open, because another thread may be reading from it; its socket is closed."""
        connection: socket.socket = self._port._socket
        with contextlib.suppress(OSError):  # the socket is already closed
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()
        self._hung_up = True

    def _connect_again(self) -> None:
        self._port._socket, self._port.is_open = None, False  # otherwise pyserial would wait 0.3 s for it to close
        deadline = Deadline(self._clock, _RECONNECT_S)
        while True:
            if not self._url:
                raise ConnectionError("the port was closed")
            try:
                self._port, self._hung_up = self._open_port(), False
            except ConnectionError:
                if deadline.has_expired:
                    raise
                self._clock.sleep(_QUIET_S)
            else:
                return

    def _refuse_closed(self, clears: int) -> None:
        if self.clears != clears:
            raise Cleared
        if not self._port.is_open:
            raise ConnectionError("the port was closed")

    def _failure(self, error: Exception, clears: int) -> Exception:
        """Return the exception to raise for an error of the port: a device clear may have closed it."""
        return Cleared() if self.clears != clears else ConnectionError(str(error))


def open_serial(name: str, url: str, baud: int, clock: Clock) -> SerialLink:
    """The link to the device `name`. Raises DeviceLost if there is no such port, or if it is in use."""
    try:
        return SerialLink(url, baud, clock)
    except ConnectionError as error:
        raise no_port(name, url, error) from error


def no_port(name: str, url: str, error: Exception) -> DeviceLost:
    """The error to raise if the device `name` cannot be opened."""
    return DeviceLost(
        name,
        expected=f"a port {url}",
        happened=str(error),
        remedy="Check the cable, the port's name in the rig, and that no other program has it open.",
    )
