"""SCPI, host side: each message is followed by a query of the device's error queue, in the same line.

Responses follow IEEE 488.2, chapter 8. Their units are separated by `;`, and the last one ends in LF. A unit is
text or a block.
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn

from coupole.clock import Clock, Deadline
from coupole.errors import DeviceError, DeviceFault, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.fair_lock import FairLock
from drivers.ledbox.link import CallEnded, Cleared, Link

REPLY_MARGIN_S = 2.0
"""Time that a device may take to answer, not counting the transmission of the bytes."""
_SHORT_REPLY_BYTES = 200
_ERROR = re.compile(r'([+-]?[0-9]+),"(.*)"')
_MAX_TEXT_BYTES = 4096
_MOST_ERRORS = 64
"""A queue that is not empty after this many errors will never be empty."""

Unit = str | bytes
"""Text as received, or the content of a definite-length block."""


class ScpiSession:
    """Messages to `name`, the device at `port`. Input left on the line by an earlier session is discarded first.

    Positive error numbers are latched faults of the device: they raise DeviceFault.
    """

    def __init__(self, name: str, port: str, link: Link, clock: Clock) -> None:
        self._name, self._port, self._link, self._clock = name, port, link, clock
        self.bytes_per_s = link.bytes_per_s
        self._lock = FairLock()
        self._in_step: int | None = None
        """Number of device clears when both ends were last in step; None if an exchange has gone wrong since."""
        self._calls = threading.local()
        self._ends = 0
        """Number of times that all calls in progress were ended."""

    def ask(self, command: str | bytes, replies: int, reply_bytes: int = 0) -> tuple[Unit, ...]:
        """Send a message and return its `replies` response units, which may contain `reply_bytes` of blocks.

        Raises DeviceRefused or DeviceFault with the device's error, DeviceTimeout, DeviceLost, CallEnded.
        """
        message = (command if isinstance(command, bytes) else command.encode("ascii")) + b";:SYST:ERR?\n"
        command_text = (
            command if isinstance(command, str) else command[:40].split(b"#")[0].decode("ascii")
        ).strip()
        seconds = REPLY_MARGIN_S + (len(message) + reply_bytes + _SHORT_REPLY_BYTES) / self.bytes_per_s
        with self._lock, self.call() as ends:
            clears = self._link.clears  # read before `ends` is compared: then no end of calls is overlooked
            if self._ends != ends:
                raise CallEnded(self._name, command_text)
            units = self._exchange(message, command_text, seconds, clears)
            self._raise_errors(units[-1], command_text, clears)
        if len(units) != replies + 1:
            self.raise_unexpected(f"{replies} replies to {command_text}", f"{len(units) - 1} came")
        return tuple(units[:-1])

    @contextlib.contextmanager
    def call(self) -> Iterator[int]:
        """Treat the messages in this context as one call of the driver: after `end_calls` no more of them are
        sent. Gives the number of times that calls had been ended when the outermost call of this thread began."""
        outer = getattr(self._calls, "ends", None)
        self._calls.ends = self._ends if outer is None else outer
        try:
            yield self._calls.ends
        finally:
            self._calls.ends = outer

    def end_calls(self) -> None:
        """End calls in progress with CallEnded, except for the message that is being sent. Any thread may call
        this."""
        self._ends += 1

    def device_clear(self) -> None:
        """Clear the device out of band, from any thread. It does not wait for a message that is being sent, and it
        ends all calls in progress with CallEnded. Raises DeviceLost."""
        self.end_calls()
        try:
            self._link.device_clear()
        except ConnectionError as error:
            raise self._loss("a device clear", error) from error

    def number(self, unit: Unit) -> float:
        """A response unit that must be a decimal number."""
        try:
            return float(unit)
        except ValueError:
            self.raise_unexpected("a number", f"{unit!r} came")

    def raise_unexpected(self, expectation: str, observation: str) -> NoReturn:
        """Raise DeviceError for an invalid reply. The line is cleared before the next message."""
        self._in_step = None
        raise DeviceError(
            self._name,
            expected=expectation,
            happened=observation,
            remedy="Check the line for interference, and the firmware against the protocol's reference.",
        )

    def close(self) -> None:
        self._link.close()

    def _exchange(self, message: bytes, message_text: str, seconds: float, clears: int) -> list[Unit]:
        link = self._link
        try:
            if self._in_step != clears:
                link.clear()
                message = b"\n" + message
            self._in_step = None
            deadline = Deadline(self._clock, seconds)
            link.write(message, deadline, clears)
            units = _read_response(lambda: link.read_bytes(deadline, clears))
            self._in_step = clears
        except Cleared as cleared:
            raise CallEnded(self._name, message_text) from cleared
        except TimeoutError as error:
            raise DeviceTimeout(
                self._name,
                expected=f"an answer to {message_text} within {seconds:.2f} s",
                happened=str(error),
                remedy=f"Check that the device at {self._port} has power and the rig's baud rate, then resume.",
            ) from error
        except ConnectionError as error:
            raise self._loss(f"an answer to {message_text}", error) from error
        except ValueError as error:
            self.raise_unexpected(f"a SCPI response to {message_text}", str(error))
        return units

    def _loss(self, expectation: str, error: Exception) -> DeviceLost:
        return DeviceLost(
            self._name,
            expected=expectation,
            happened=str(error),
            remedy=f"Check the cable at {self._port} and the device's power, then resume.",
        )

    def _raise_errors(self, unit: Unit, message_text: str, clears: int) -> None:
        """Empty the device's error queue, whose first entry is `unit`, and raise if it holds errors."""
        errors = [self._error(unit, message_text)]
        while errors[-1][0] and len(errors) <= _MOST_ERRORS:
            units = self._exchange(b"SYST:ERR?\n", "SYST:ERR?", REPLY_MARGIN_S, clears)
            errors.append(self._error(units[-1], "SYST:ERR?"))
        if len(errors) == 1:
            return
        kind = DeviceFault if any(code > 0 for code, _ in errors) else DeviceRefused
        raise kind(
            self._name,
            expected=f"{message_text} to be executed",
            happened="; ".join(f"{code} {text}" for code, text in errors if code),
            remedy="Find and correct what the device names"
            + ("; reopening it resets the fault." if kind is DeviceFault else "."),
        )

    def _error(self, unit: Unit, message_text: str) -> tuple[int, str]:
        try:
            return _error_of(unit)
        except ValueError as error:
            self.raise_unexpected(f"the error state after {message_text}", str(error))


def _read_response(receive: Callable[[], bytes]) -> list[Unit]:
    """The units of one response line; `receive` returns the next bytes at each call.

    Raises ValueError for an invalid response; errors of `receive` are raised unchanged.
    """
    data = bytearray()

    def at_least(count: int) -> None:
        while len(data) < count:
            data.extend(receive())

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
                data.extend(receive())
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
    """Return the index of the end of the text unit at the start of `data`: `;` or LF outside quotes. None if the
    end has not come yet."""
    in_quotes = False
    for index, byte in enumerate(data):
        if byte == ord('"'):
            in_quotes = not in_quotes
        elif byte == ord("\n") or (byte == ord(";") and not in_quotes):
            return index
    return None
