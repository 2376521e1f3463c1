"""SCPI in the box's firmware: messages from a byte stream, commands by name, an error queue.

No input makes this raise an exception. Each error becomes an entry of the error queue (SCPI-1999 volume 2, chapter
21) and a bit of the event status register (IEEE 488.2, chapter 11).
"""

from __future__ import annotations

import itertools
import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

MAX_TEXT_BYTES = 1024
"""Longest program message, without its blocks."""
QUEUE_LENGTH = 32

STANDARD_ERRORS = {
    -101: "Invalid character",
    -104: "Data type error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -113: "Undefined header",
    -114: "Header suffix out of range",
    -161: "Invalid block data",
    -200: "Execution error",
    -213: "Init ignored",
    -221: "Settings conflict",
    -222: "Data out of range",
    -224: "Illegal parameter value",
    -350: "Queue overflow",
    -363: "Input buffer overrun",
    -430: "Query DEADLOCKED",
    101: "Watchdog expired",
    102: "Over-temperature",
}

Argument = str | bytes
"""A parameter: text, or the content of a block."""


class ScpiError(Exception):
    """A command that cannot be executed: SCPI error number and details."""

    def __init__(self, code: int, detail: str = "") -> None:
        self.code, self.detail = code, detail
        super().__init__(code, detail)


@dataclass(frozen=True)
class Command:
    """A command. The handler gets the header's numeric suffix first if the pattern has one (`#`), then the
    parameters; it returns the response of a query, or None."""

    handler: Callable[..., str | bytes | None]
    min_arguments: int = 0
    max_arguments: int = 0


class Interpreter:
    """Executes a byte stream, in pieces of any size, and returns the response bytes.

    `commands` maps patterns to commands: capitals are the short form, `#` stands for a numeric suffix, as in
    `OUTPut:PANel#`. `SYSTem:ERRor?`, `*CLS`, `*ESR?` and `*OPC?` are the interpreter's own.
    """

    def __init__(self, commands: Mapping[str, Command], max_block_bytes: int) -> None:
        common_commands = {
            "SYSTem:ERRor?": Command(self._next_error),
            "*CLS": Command(self._clear),
            "*ESR?": Command(self._event_status),
            "*OPC?": Command(lambda: "1"),
        }
        self._commands = {
            spelling: command
            for pattern, command in {**commands, **common_commands}.items()
            for spelling in _spellings(pattern)
        }
        self._splitter = _Splitter(max_block_bytes)
        self._errors: deque[str] = deque()
        self._event_bits = 128  # power on

    @property
    def inside_block(self) -> bool:
        """True while a block is incomplete."""
        return self._splitter.inside_block

    def receive(self, data: bytes) -> bytes:
        """Execute the messages completed by `data`; returns one response line for each message with a query."""
        return b"".join(self.replies(data))

    def replies(self, data: bytes) -> Iterator[bytes]:
        """Execute messages as `receive` does, one after the other; the response of a message without query is
        empty."""
        return (self._execute(message) for message in self._splitter.feed(data))

    def clear(self) -> None:
        """Clear the device (IEEE 488.2, 5.8): forget the incomplete message. Error queue and event status stay."""
        self._splitter.reset()

    def drop_block(self) -> None:
        """Discard an incomplete message whose block's bytes did not come in time."""
        self._splitter.reset()
        self.report(ScpiError(-161, "bytes of a block did not come in time"))

    def report(self, error: ScpiError) -> None:
        """Put an error in the queue; a full queue ends in -350."""
        text = STANDARD_ERRORS[error.code] + (f"; {error.detail}" if error.detail else "")
        kinds = {-1: 32, -2: 16, -4: 4}  # command, execution and query errors; else a device's own
        self._event_bits |= kinds.get(-(-error.code // 100), 8)
        if len(self._errors) < QUEUE_LENGTH:
            self._errors.append(f'{error.code},"{_quotable(text)}"')
        else:
            self._errors[-1] = '-350,"Queue overflow"'

    def _execute(self, message: _Message) -> bytes:
        if isinstance(message, ScpiError):
            self.report(message)
            return b""
        blocks, path, replies = iter(message.blocks), "", []
        for unit in message.text.split(";"):
            own_blocks = list(itertools.islice(blocks, unit.count("\0")))
            try:
                header, arguments = _arguments(unit, own_blocks)
                if not header:
                    continue
                path, command, suffix = self._resolve(header, path)
                reply = _call(command, suffix, arguments)
            except ScpiError as error:
                self.report(error)
                continue
            if reply is not None:
                replies.append(reply.encode("ascii") if isinstance(reply, str) else reply)
        return b";".join(replies) + b"\n" if replies else b""

    def _resolve(self, header: str, path: str) -> tuple[str, Command, tuple[int, ...]]:
        """Return the path for the next header, the command, and the suffix. A header without a leading `:`
        continues the previous one."""
        if header.startswith("*"):
            full = header
        else:
            full = header[1:] if header.startswith(":") else path + header
            path = full[: full.rfind(":") + 1]
        if full in self._commands and "#" not in full:
            return path, self._commands[full], ()
        suffix_match = re.fullmatch(r"([A-Z:]+?)([0-9]{0,9})(\??)", full)
        if suffix_match and (command := self._commands.get(f"{suffix_match[1]}#{suffix_match[3]}")):
            return path, command, (int(suffix_match[2] or "1"),)
        raise ScpiError(-113, full[:40])

    def _next_error(self) -> str:
        return self._errors.popleft() if self._errors else '0,"No error"'

    def _clear(self) -> None:
        self._errors.clear()
        self._event_bits = 0

    def _event_status(self) -> str:
        bits, self._event_bits = self._event_bits, 0
        return str(bits)


def block(payload: bytes) -> bytes:
    """`payload` as an IEEE 488.2 definite-length block."""
    length = str(len(payload))
    return f"#{len(length)}{length}".encode("ascii") + payload


def number(argument: Argument, low: float, high: float) -> float:
    """A decimal numeric parameter within limits."""
    if isinstance(argument, bytes) or not re.fullmatch(
        r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(E[+-]?[0-9]{1,2})?", argument
    ):
        raise ScpiError(-104, "a decimal number is wanted")
    value = float(argument)
    if not low <= value <= high:
        raise ScpiError(-222, f"{argument[:40]} is outside {low:g} to {high:g}")
    return value


def integer(argument: Argument, low: int, high: int) -> int:
    """A numeric parameter without fraction within limits."""
    value = number(argument, low, high)
    if not value.is_integer():
        raise ScpiError(-104, "an integer is wanted")
    return int(value)


def keyword(argument: Argument, *patterns: str) -> str:
    """Return the pattern among `patterns` (capitals are the short form) that the parameter matches."""
    for pattern in patterns:
        if argument in _spellings(pattern):
            return pattern
    raise ScpiError(-224, f"one of {', '.join(patterns)} is wanted")


def boolean(argument: Argument) -> bool:
    return keyword(argument, "0", "OFF", "1", "ON") in ("1", "ON")


def _call(command: Command, suffix: tuple[int, ...], arguments: list[Argument]) -> str | bytes | None:
    if len(arguments) < command.min_arguments:
        raise ScpiError(-109)
    if len(arguments) > command.max_arguments:
        raise ScpiError(-108)
    return command.handler(*suffix, *arguments)


def _arguments(unit: str, blocks: list[bytes]) -> tuple[str, list[Argument]]:
    """Header and parameters of one program message unit; `\\0` marks the place of a block."""
    header, _, rest = unit.strip().replace("\t", " ").replace("\r", " ").partition(" ")
    if not rest.strip():
        return header.upper(), []
    arguments: list[Argument] = []
    for text in rest.split(","):
        word = text.strip().upper()
        if word == "\0":
            arguments.append(blocks.pop(0))
        elif "\0" in word:
            raise ScpiError(-161, "a comma or the message's end must follow a block")
        elif not word:
            raise ScpiError(-109)
        elif re.match("#[0-9]", word):
            raise ScpiError(-161, "only definite-length blocks are understood")
        else:
            arguments.append(word)
    return header.upper(), arguments


def _spellings(pattern: str) -> set[str]:
    """Every spelling of a header pattern, in capitals: each node in its long or its short form."""
    nodes = [{node.upper(), re.sub("[a-z]", "", node)} for node in pattern.split(":")]
    return {":".join(choice) for choice in itertools.product(*nodes)}


def _quotable(text: str) -> str:
    return text.replace('"', "'")


@dataclass(frozen=True)
class _Text:
    """One program message without its LF; each block is replaced by one `\\0`."""

    text: str
    blocks: tuple[bytes, ...]


_Message = _Text | ScpiError
_STOP = re.compile(rb"[\n#]")
_FORBIDDEN = re.compile(r"[^\x00\t\r -~]")


class _Splitter:
    """Splits a byte stream into messages at LF, except for LF within a block."""

    def __init__(self, max_block_bytes: int) -> None:
        self._max_block_bytes = max_block_bytes
        self.reset()

    def reset(self) -> None:
        self._input = bytearray()
        self._start_message()

    @property
    def inside_block(self) -> bool:
        return bool(self._block_left or self._input)

    def feed(self, data: bytes) -> Iterator[_Message]:
        self._input += data
        while self._input:
            if self._block_left:
                self._take_block()
            elif (stop := _STOP.search(self._input)) is None:
                self._take_text(len(self._input))
            else:
                self._take_text(stop.start())
                if self._input[0] == ord("\n"):
                    del self._input[0]
                    yield self._finish()
                elif not self._open_block():
                    return

    def _start_message(self) -> None:
        self._text = bytearray()
        self._blocks: list[bytes] = []
        self._block = bytearray()
        self._block_left = 0
        self._overrun = False

    def _finish(self) -> _Message:
        text, blocks, overrun = self._text.decode("latin-1"), tuple(self._blocks), self._overrun
        self._start_message()
        if overrun:
            return ScpiError(-363, "the message was discarded")
        if strange := _FORBIDDEN.search(text):
            return ScpiError(-101, f"byte {ord(strange[0]):#04x}; the message was discarded")
        return _Text(text, blocks)

    def _take_text(self, count: int) -> None:
        if not self._overrun:
            self._text += self._input[:count].replace(b"\0", b"\x7f")  # \0 marks the place of a block
            self._overrun = len(self._text) > MAX_TEXT_BYTES
        del self._input[:count]

    def _take_block(self) -> None:
        piece = self._input[: self._block_left]
        del self._input[: len(piece)]
        self._block += piece
        self._block_left -= len(piece)
        if not self._block_left:
            self._close_block()

    def _close_block(self) -> None:
        self._blocks.append(bytes(self._block))
        self._block = bytearray()
        self._text += b"\0"

    def _open_block(self) -> bool:
        """Read a block's header at a `#`; False if more bytes are needed to decide."""
        if self._overrun or not re.search(rb"[ \t\r,]\Z", self._text):
            self._take_text(1)
            return True
        head = re.match(rb"#([1-9]?)([0-9]*)", self._input[:11])
        digits = int(head[1]) if head and head[1] else 0
        if head is None or not digits or len(head[2]) < digits:
            if head is not None and head.end() == len(self._input):
                return False  # it may still become a header
            self._take_text(1)
            return True
        length = int(head[2][:digits])
        if length > self._max_block_bytes:
            self._overrun = True
            return True
        del self._input[: 2 + digits]
        self._block_left = length
        if not length:
            self._close_block()
        return True
