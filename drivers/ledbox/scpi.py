"""SCPI, host side: each message is followed by a query of the device's error queue, in the same line.

Responses follow IEEE 488.2, chapter 8: units separated by `;`, ended by LF; a unit is text or a block.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import NoReturn, Protocol

from coupole.devices import Clock, Deadline
from coupole.errors import DeviceError, DeviceFault, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.fair_lock import FairLock

REPLY_MARGIN_S = 2.0
"""Time that a device may take to answer, without the transmission of the bytes."""
_SHORT_REPLY_BYTES = 200
_ERROR = re.compile(r'([+-]?[0-9]+),"(.*)"')
_MAX_TEXT_BYTES = 4096

Unit = str | bytes
"""Text as received, or the content of a definite-length block."""


class Link(Protocol):
    """Transports bytes. Raises TimeoutError when a deadline passes, ConnectionError when the link is lost."""

    bytes_per_s: float

    def write(self, data: bytes, deadline: Deadline) -> None: ...
    def read(self, deadline: Deadline) -> bytes: ...
    def clear(self) -> None: ...
    def close(self) -> None: ...


class ScpiSession:
    """Messages to `name`, the device at `port`. Input left on the line by an earlier session is discarded first.

    Positive error numbers are latched faults of the device: they raise DeviceFault.
    """

    def __init__(self, name: str, port: str, link: Link, clock: Clock) -> None:
        self._name, self._port, self._link, self._clock = name, port, link, clock
        self.bytes_per_s = link.bytes_per_s
        self._lock = FairLock()
        self._out_of_step = True

    def ask(self, command: str | bytes, replies: int, reply_bytes: int = 0) -> tuple[Unit, ...]:
        """Send a message and return its `replies` response units, which may contain `reply_bytes` of blocks.

        Raises DeviceRefused or DeviceFault with the device's error, DeviceTimeout, DeviceLost.
        """
        message = (command if isinstance(command, bytes) else command.encode("ascii")) + b";:SYST:ERR?\n"
        shown = (command if isinstance(command, str) else command[:40].split(b"#")[0].decode("ascii")).strip()
        seconds = REPLY_MARGIN_S + (len(message) + reply_bytes + _SHORT_REPLY_BYTES) / self.bytes_per_s
        with self._lock:
            units = self._exchange(message, shown, seconds)
            self._raise_errors(units[-1], shown)
        if len(units) != replies + 1:
            self.unexpected(f"{replies} replies to {shown}", f"{len(units) - 1} came")
        return tuple(units[:-1])

    def number(self, unit: Unit) -> float:
        """A response unit that must be a decimal number."""
        try:
            return float(unit)
        except ValueError:
            self.unexpected("a number", f"{unit!r} came")

    def unexpected(self, expected: str, happened: str) -> NoReturn:
        """Raise DeviceError for an invalid reply; before the next message the line is cleared."""
        self._out_of_step = True
        raise DeviceError(
            self._name,
            expected=expected,
            happened=happened,
            remedy="Check the line for interference, and the firmware against the protocol's reference.",
        )

    def close(self) -> None:
        self._link.close()

    def _exchange(self, message: bytes, shown: str, seconds: float) -> list[Unit]:
        try:
            if self._out_of_step:
                self._link.clear()
                message = b"\n" + message
            self._out_of_step = True
            deadline = Deadline(self._clock, seconds)
            self._link.write(message, deadline)
            units = _read_response(lambda: self._link.read(deadline))
            self._out_of_step = False
        except TimeoutError as error:
            raise DeviceTimeout(
                self._name,
                expected=f"an answer to {shown} within {seconds:.2f} s",
                happened=str(error),
                remedy=f"Check that the device at {self._port} has power and the rig's baud rate, then resume.",
            ) from error
        except ConnectionError as error:
            raise DeviceLost(
                self._name,
                expected=f"an answer to {shown}",
                happened=str(error),
                remedy=f"Check the cable at {self._port} and the device's power, then resume.",
            ) from error
        except ValueError as error:
            self.unexpected(f"a SCPI response to {shown}", str(error))
        return units

    def _raise_errors(self, unit: Unit, shown: str) -> None:
        """Empty the device's error queue, whose first entry is `unit`, and raise if it holds errors."""
        errors = [self._error(unit, shown)]
        while errors[-1][0]:
            units = self._exchange(b"SYST:ERR?\n", "SYST:ERR?", REPLY_MARGIN_S)
            errors.append(self._error(units[-1], "SYST:ERR?"))
        if len(errors) == 1:
            return
        kind = DeviceFault if any(code > 0 for code, _ in errors) else DeviceRefused
        raise kind(
            self._name,
            expected=f"{shown} to be executed",
            happened="; ".join(f"{code} {text}" for code, text in errors[:-1]),
            remedy="Find and correct what the device names"
            + ("; reopening it resets the fault." if kind is DeviceFault else "."),
        )

    def _error(self, unit: Unit, shown: str) -> tuple[int, str]:
        try:
            return _error_of(unit)
        except ValueError as error:
            self.unexpected(f"the error state after {shown}", str(error))


def _read_response(read: Callable[[], bytes]) -> list[Unit]:
    """The units of one response line; `read` returns the next bytes at each call.

    Raises ValueError for an invalid response; errors of `read` are raised unchanged.
    """
    data = bytearray()

    def at_least(count: int) -> None:
        while len(data) < count:
            data.extend(read())

    units: list[Unit] = []
    while True:
        at_least(1)
        if data[:1] == b"#":
            at_least(2)
            digits = int(data[1:2].decode("latin-1"))
            at_least(2 + digits)
            length = int(data[2 : 2 + digits].decode("latin-1"))
            at_least(2 + digits + length + 1)
            units.append(bytes(data[2 + digits : 2 + digits + length]))
            del data[: 2 + digits + length]
        else:
            end = _text_end(data)
            while end is None:
                if len(data) > _MAX_TEXT_BYTES:
                    raise ValueError(f"{len(data)} bytes came without an end: {bytes(data[:40])!r}...")
                data.extend(read())
                end = _text_end(data)
            units.append(data[:end].decode("ascii"))
            del data[:end]
        separator = data.pop(0)
        if separator == ord("\n"):
            if data:
                raise ValueError(f"bytes came after the response's end: {bytes(data[:40])!r}")
            return units
        if separator != ord(";"):
            raise ValueError(f"byte {separator:#04x} follows a response unit")


def _error_of(unit: Unit) -> tuple[int, str]:
    """Number and text of an answer to `SYSTem:ERRor?`; raises ValueError if it is not one."""
    match = _ERROR.fullmatch(unit) if isinstance(unit, str) else None
    if match is None:
        raise ValueError(f'{unit!r} is not <number>,"<text>"')
    return int(match[1]), match[2]


def _text_end(data: bytearray) -> int | None:
    """Index of the end of the text unit at the start of `data`: `;` or LF outside quotes; None if not there."""
    quoted = False
    for index, byte in enumerate(data):
        if byte == ord('"'):
            quoted = not quoted
        elif byte == ord("\n") or (byte == ord(";") and not quoted):
            return index
    return None
