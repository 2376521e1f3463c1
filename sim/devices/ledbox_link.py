"""Links that carry bytes to the simulated LED box and back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class Link(Protocol):
    """Transport of bytes to and from the box: a `PtyPort`, or the far end of a USB cable.

    `on_break` is its device clear: a BREAK, INITIATE_CLEAR, the end of a TCP connection."""

    port: str

    def listen(self, on_bytes: Callable[[bytes], None], on_break: Callable[[], None] | None = None) -> None: ...
    def send(self, data: bytes) -> bool: ...
    def drop_output(self) -> None: ...
    def mute(self) -> None: ...
    def close(self) -> None: ...
