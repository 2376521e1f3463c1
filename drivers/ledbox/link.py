"""Links that carry bytes to a box and back. Their device clear waits for no exchange."""

from __future__ import annotations

from typing import Protocol

from coupole.clock import Deadline
from coupole.errors import DeviceError


class Cleared(Exception):
    """A device clear ended the exchange. Nothing more of the exchange is sent."""


class CallEnded(DeviceError):
    """Another thread called `lights_off`, which ended the call. Nothing more of the call was sent."""

    def __init__(self, device: str, doing: str) -> None:
        super().__init__(
            device,
            expected=f"time for {doing}",
            happened="meanwhile the lights were switched off, which ends all other calls",
            remedy="Find out why they were switched off.",
        )


class Link(Protocol):
    """Transports bytes. Only one thread at a time may call `write` and `read_bytes`. Any thread may call
    `device_clear` at any moment.

    `write` and `read_bytes` raise TimeoutError when the deadline passes, and ConnectionError when the link is
    lost. They raise Cleared if `clears` is no longer the link's own number, because a device clear came after the
    exchange had begun.
    """

    bytes_per_s: float
    clears: int
    """Number of device clears begun so far."""

    def write(self, data: bytes, deadline: Deadline, clears: int) -> None: ...
    def read_bytes(self, deadline: Deadline, clears: int) -> bytes: ...

    def device_clear(self) -> None:
        """Tell the box out of band to go dark and to forget all that was sent to it. Returns at once. Unsent bytes
        are discarded, and running exchanges end with Cleared. Raises ConnectionError."""
        ...

    def clear(self) -> None:
        """Bring both ends in step, also after a device clear: discard bytes that are still on their way. Raises
        ConnectionError."""
        ...

    def close(self) -> None: ...
