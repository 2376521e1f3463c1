"""Links that carry bytes to a box and back, with a device clear that waits for no exchange."""

from __future__ import annotations

from typing import Protocol

from coupole.clock import Deadline
from coupole.errors import DeviceError


class Cleared(Exception):
    """A device clear ended the exchange; nothing more of it is sent."""


class CallEnded(DeviceError):
    """`lights_off`, called in another thread, ended the call. Nothing more of it was sent."""

    def __init__(self, device: str, doing: str) -> None:
        super().__init__(
            device,
            expected=f"time for {doing}",
            happened="meanwhile the lights were switched off, which ends all other calls",
            remedy="Find out why they were switched off.",
        )


class Link(Protocol):
    """Transports bytes. `write` and `read_bytes` belong to one thread at a time, `device_clear` to any at any
    moment.

    Both raise TimeoutError when the deadline passes, ConnectionError when the link is lost, and Cleared if
    `clears` is no longer the link's own: then a device clear came after the exchange had begun.
    """

    bytes_per_s: float
    clears: int
    """Device clears begun so far."""

    def write(self, data: bytes, deadline: Deadline, clears: int) -> None: ...
    def read_bytes(self, deadline: Deadline, clears: int) -> bytes: ...

    def device_clear(self) -> None:
        """Tell the box out of band to go dark and to forget what it was sent; returns at once. Unsent bytes are
        discarded, and running exchanges end with Cleared. Raises ConnectionError."""
        ...

    def clear(self) -> None:
        """Bring both ends in step, also after a device clear: discard what is still on its way. Raises
        ConnectionError."""
        ...

    def close(self) -> None: ...
