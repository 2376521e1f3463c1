"""Settings of the LED control box, and the time that it takes to load a table."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from coupole.devices import HostNeed
from drivers.host_checks import serial_port
from drivers.ledbox.wire import STEP_BYTES

BLOCK_BYTES = 512
"""Largest part of a table in one message. With a box that has no device clear, another command may have to wait
for one such part."""
_BLOCK_OVERHEAD_BYTES, _BLOCK_OVERHEAD_S = 70, 0.003
_UPLOAD_OVERHEAD_S, _BITS_PER_BYTE = 0.1, 10


class Settings(BaseModel):
    """Settings of the LED box in a rig."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    port: str
    """A pyserial URL (`/dev/ttyACM0`, `COM3`, `socket://host:port`, `rfc2217://host:port`) or
    `usbtmc:VID:PID[:SERIAL]`, VID and PID in hexadecimal."""
    baud: int = Field(default=115200, ge=1200)
    led_count: int = Field(default=1080, ge=1, le=65535)
    """Number of LEDs that the box must report."""
    watchdog_s: float = Field(default=2.0, ge=0, le=60)
    """The box switches all light off after this time without a command; 0: never."""
    edge_width_us: int = Field(default=50, ge=10, le=10_000)
    edge_polarity: Literal["normal", "inverted"] = "normal"
    wait_for_ready: bool = False
    """True: each step is delayed until the camera's exposure-ready line is high. This needs the cable of that
    line."""
    name: str = "led box"

    def upload_s(self, steps: int) -> float:
        """Time to upload a table of `steps` steps over a serial line."""
        table_bytes = STEP_BYTES * steps
        blocks = -(-table_bytes // BLOCK_BYTES)
        line_s = (table_bytes + blocks * _BLOCK_OVERHEAD_BYTES) * _BITS_PER_BYTE / self.baud
        return line_s + blocks * _BLOCK_OVERHEAD_S + _UPLOAD_OVERHEAD_S

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        return serial_port(self.port)
