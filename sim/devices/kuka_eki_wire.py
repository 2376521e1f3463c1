"""Commands of an EthernetKRL client on the stand-in's side: XML over TCP, written independently of the drivers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

STOP, MOVE, ASK, BEAT = range(4)
_LONGEST_MESSAGE_BYTES = 4096


class Messages:
    """Splits a stream of documents: the parser reads them as children of one document that never ends."""

    def __init__(self) -> None:
        self._parser = _new_parser()
        self._parser.feed(b"<stream>")
        self._stream = next(self._parser.read_events())[1]
        self._open_bytes = 0

    def messages(self, data: bytes) -> list[ElementTree.Element]:
        """Return the messages that `data` complete. Raises ParseError for data that are not XML, ValueError for an
        endless message."""
        self._parser.feed(data)
        elements = [
            element for event, element in self._parser.read_events() if event == "end" and element.tag == "Coupole"
        ]
        self._stream.clear()  # removes messages that were taken, and elements that are not messages
        self._open_bytes = 0 if elements else self._open_bytes + len(data)
        if self._open_bytes > _LONGEST_MESSAGE_BYTES:
            raise ValueError(f"{self._open_bytes} bytes without a message")
        return elements


def _new_parser() -> Any:
    return ElementTree.XMLPullParser(["start", "end"])


@dataclass(frozen=True)
class Command:
    """One message. Its numbers are within the limits of the controller's program."""

    session: int
    number: int
    verb: int
    velocity_percent: int
    acceleration_percent: int
    axes_deg: tuple[float, ...]

    @staticmethod
    def of(message: ElementTree.Element) -> Command:
        """Read a message. Raises KeyError if it lacks an element, ValueError for a number out of its limits."""
        values = {f"{child.tag}/{name}": value for child in message for name, value in child.items()}
        largest = 2**31 - 1
        asks = values["Command/Verb"] in (str(ASK), str(BEAT))
        moves = values["Command/Verb"] == str(MOVE)
        return Command(
            _whole(values["Command/Session"], 0, largest),
            _whole(values["Command/Number"], 0, largest),
            _whole(values["Command/Verb"], STOP, BEAT),
            100 if not moves else _whole(values["Command/Velocity"], 1, 100),
            100 if asks else _whole(values["Command/Acceleration"], 1, 100),
            tuple(_angle(values[f"Axes/A{axis}"]) for axis in range(1, 7)) if moves else (),
        )


def _angle(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text} is no angle")
    return number


def _whole(text: str, low: int, high: int) -> int:
    number = int(text)
    if not low <= number <= high:
        raise ValueError(f"{number} is not {low} to {high}")
    return number
