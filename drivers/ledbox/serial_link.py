"""Bytes to and from a device on a serial line, by any URL that pyserial accepts.

Time-outs are counted on the rig's clock, so that they hold in a simulated world that runs faster or slower.
pyserial's own time-outs, in machine time, only set how often the rig's clock is read.
"""

from __future__ import annotations

import contextlib
import io
import select
from typing import Any

from coupole.devices import Clock, Deadline
from coupole.errors import DeviceLost

_LOOK_S = 0.02
"""Machine time between two readings of the rig's clock."""
_BITS_PER_BYTE = 10
_QUIET_S, _DRAIN_S = 0.05, 2.0


class SerialLink:
    """An open serial port: a `drivers.ledbox.scpi.Link`."""

    def __init__(self, url: str, baud: int, clock: Clock) -> None:
        import serial

        self._lost: tuple[type[Exception], ...] = (serial.SerialException, OSError)
        with contextlib.suppress(ImportError):  # termios does not exist on Windows
            import termios

            self._lost += (termios.error,)  # pyserial does not convert it when it flushes a hung-up terminal
        self._clock = clock
        self.bytes_per_s = baud / _BITS_PER_BYTE
        own_port = {} if "://" in url else {"exclusive": True}
        try:
            self._port: Any = serial.serial_for_url(url, baudrate=baud, timeout=_LOOK_S, **own_port)
        except (serial.SerialException, OSError, ValueError) as error:
            raise ConnectionError(str(error)) from error
        try:
            self._fileno: int | None = self._port.fileno()
            self._port.write_timeout = 0
        except (AttributeError, io.UnsupportedOperation):
            self._fileno = None  # rfc2217: writes go to a socket, all at once

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Send all of `data`."""
        self._refuse_closed()
        rest = memoryview(data)
        while rest:
            try:
                # A non-blocking write of pyserial 3.5 to a full port loops for ever: wait for room first
                if self._fileno is None or select.select([], [self._fileno], [], _LOOK_S)[1]:
                    rest = rest[self._port.write(rest) :]
                    continue
            except self._lost as error:
                raise ConnectionError(str(error)) from error
            if deadline.expired:
                raise TimeoutError(f"{len(rest)} of {len(data)} bytes could not be sent")

    def read(self, deadline: Deadline) -> bytes:
        """At least one byte, and all others that have arrived."""
        self._refuse_closed()
        while True:
            late = deadline.expired  # read first: bytes that arrived in time are accepted even if read late
            try:
                data: bytes = self._port.read(max(1, self._port.in_waiting))
            except self._lost as error:
                raise ConnectionError(str(error)) from error
            if data:
                return data
            if late:
                raise TimeoutError("nothing came")

    def waiting(self) -> bytes:
        """Bytes that have already arrived, possibly none; does not wait."""
        self._refuse_closed()
        try:
            data: bytes = self._port.read(count) if (count := self._port.in_waiting) else b""
        except self._lost as error:
            raise ConnectionError(str(error)) from error
        return data

    def clear(self) -> None:
        """Discard input until the line is quiet."""
        deadline = Deadline(self._clock, _DRAIN_S)
        with contextlib.suppress(TimeoutError):
            while not deadline.expired:
                self.read(Deadline(self._clock, _QUIET_S))

    def close(self) -> None:
        """Release the port; a second call does nothing."""
        if not self._port.is_open:
            return
        with contextlib.suppress(*self._lost):
            self._port.reset_output_buffer()  # else close() may wait for a dead line to drain
        socket = getattr(self._port, "_socket", None)
        with contextlib.suppress(*self._lost):
            self._port.close()
        if socket is not None:
            socket.close()  # pyserial 3.5 does not, if the other side of a socket:// has hung up

    def _refuse_closed(self) -> None:
        if not self._port.is_open:
            raise ConnectionError("the port was closed")


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
