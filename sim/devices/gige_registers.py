"""Registers of the simulated GigE Vision camera: their addresses, and the values that a client may write.

Clients read and write them over the wire, in the camera's own process (`gige_server`). The world reads them in
shared memory, and writes its own registers there. No register is written from both sides. This module needs only
the standard library.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

DESCRIPTION = Path(__file__).with_name("gige.xml")

# Fixed by GigE Vision (bootstrap registers).
VERSION_OF_STANDARD, DEVICE_MODE = 0x0, 0x4
ADDRESS, VENDOR, MODEL, VERSION, SERIAL, DESCRIPTION_URL = 0x24, 0x48, 0x68, 0x88, 0xD8, 0x200
INTERFACES, STREAMS, CAPABILITIES = 0x600, 0x904, 0x934
HEARTBEAT_MS, TICKS_HZ_LOW = 0x938, 0x940
CONTROL_PRIVILEGE = 0xA00
HOST_PORT, PACKET_SIZE, PACKET_DELAY, HOST_ADDRESS = 0xD00, 0xD04, 0xD08, 0xD18

# The camera's own, as gige.xml has them: 32-bit integers; 64-bit floats from TEMPERATURE_C on.
WIDTH, HEIGHT, OFFSET_X, OFFSET_Y = 0x1100, 0x1104, 0x1108, 0x110C
SENSOR_WIDTH, SENSOR_HEIGHT, PIXEL_FORMAT = 0x1110, 0x1114, 0x1118
BINNING_X, BINNING_Y, DECIMATION_X, DECIMATION_Y = 0x1120, 0x1124, 0x1128, 0x112C
REVERSE_X, REVERSE_Y, TEST_PATTERN = 0x1130, 0x1134, 0x1138
ACQUISITION_MODE, ACQUISITION, FRAME_COUNT, FRAME_RATE_ENABLE = 0x1140, 0x1144, 0x1148, 0x114C
SESSION = 0x1150
"""Number of the present acquisition; 0 while there is none."""
EXPOSURE_MODE, EXPOSURE_AUTO, GAIN_AUTO, GAIN_SELECTOR = 0x1154, 0x1158, 0x115C, 0x1160
GAMMA_ENABLE, LUT_ENABLE, BALANCE_SELECTOR, LINE_INVERTER = 0x1164, 0x1168, 0x116C, 0x1170
TRIGGER_SELECTOR, TRIGGER_MODE, TRIGGER_SOURCE = 0x1180, 0x1184, 0x118C
"""Mode and source are two registers each: one for AcquisitionStart, one for FrameStart."""
TRIGGER_ACTIVATION, TRIGGER_OVERLAP, TRIGGER_DIVIDER, TRIGGER_SOFTWARE = 0x1194, 0x1198, 0x119C, 0x11A0
TRIGGERS = 0x11A4
"""Counts software triggers."""
COUNTER_SELECTOR, EXPOSED, OVER_TRIGGERS = 0x11A8, 0x11AC, 0x11B0
TEMPERATURE_C, FRAME_RATE_HZ, FRAME_RATE_MAX_HZ, EXPOSURE_US = 0x2000, 0x2008, 0x2010, 0x2018
READOUT_US, BLACK_LEVEL_DN, TRIGGER_DELAY_US, GAMMA = 0x2020, 0x2028, 0x2030, 0x2038
GAIN_DB, BALANCE_RATIO = 0x2040, 0x2050
"""Two registers each: analogue and digital gain; ratios of red and blue."""
REGISTER_BYTES = 0x3000
DESCRIPTION_PLACE = 0x10000

FRAME_START = 1
LINE0, SOFTWARE = 0, 1
CONTINUOUS, SINGLE_FRAME, MULTI_FRAME = 1, 2, 3
TRIGGER_WIDTH = 1
OVERLAP_READ_OUT, OVERLAP_PREVIOUS_FRAME = 1, 2
PIXEL_FORMATS = frozenset(
    {
        0x01080001,
        0x0108000A,
        0x010A0046,
        0x010A0054,
        0x01100005,
        0x01100012,
        0x010C0047,
        0x010C0055,
        0x010C0006,
        0x01100007,
        0x01100030,
    }
)

# Status codes of GVCP.
DONE, NOT_IMPLEMENTED, INVALID_PARAMETER, INVALID_ADDRESS = 0x0000, 0x8001, 0x8002, 0x8003
WRITE_PROTECTED, BAD_ALIGNMENT, ACCESS_DENIED, INVALID_HEADER = 0x8004, 0x8005, 0x8006, 0x800E

_FIRE_TEST_PACKET = 1 << 31


class Registers:
    """Register memory of one camera, big-endian as on the wire."""

    def __init__(self, memory: memoryview) -> None:
        self._memory = memory

    def read_bytes(self, address: int, size: int) -> bytes:
        return bytes(self._memory[address : address + size])

    def write(self, address: int, data: bytes) -> None:
        self._memory[address : address + len(data)] = data

    def integer(self, address: int) -> int:
        return int.from_bytes(self._memory[address : address + 4], "big")

    def real(self, address: int) -> float:
        number: float = struct.unpack_from(">d", self._memory, address)[0]
        return number

    def set_integer(self, address: int, number: int) -> None:
        self.write(address, struct.pack(">I", number % 2**32))

    def set_real(self, address: int, number: float) -> None:
        self.write(address, struct.pack(">d", number))

    def set_text(self, address: int, text: str, size: int = 32) -> None:
        self.write(address, text.encode().ljust(size, b"\0"))

    def widest(self) -> int:
        """Columns of a whole image with the present binning and decimation."""
        return self.integer(SENSOR_WIDTH) // (self.integer(BINNING_X) * self.integer(DECIMATION_X))

    def highest(self) -> int:
        """Rows of a whole image with the present binning and decimation."""
        return self.integer(SENSOR_HEIGHT) // (self.integer(BINNING_Y) * self.integer(DECIMATION_Y))


@dataclass(frozen=True)
class Writable:
    """Values that a client may write to a register: `low` to `high`, from `low` in steps of `step` if that is not
    0."""

    low: float
    high: float
    step: int = 0
    size: int = 4
    """Size in bytes; 8 is a float."""
    is_locked: bool = False
    """True if clients may not write it while the camera acquires."""
    most: Callable[[Registers], float] | None = None
    """Upper limit that depends on other registers."""
    among: frozenset[int] = frozenset()
    """All allowed values; empty: all values between `low` and `high`."""

    def allows(self, number: float, registers: Registers) -> bool:
        """Return False for a number out of the limits, and for a value that is not a number."""
        high = self.high if self.most is None else min(self.high, self.most(registers))
        if not self.low <= number <= high or (self.among and number not in self.among):
            return False
        return not self.step or (number - self.low) % self.step == 0


def _image(low: int, step: int, most: Callable[[Registers], float]) -> Writable:
    return Writable(low, math.inf, step, is_locked=True, most=most)


def _real(low: float, high: float, most: Callable[[Registers], float] | None = None) -> Writable:
    return Writable(low, high, size=8, most=most)


_ANY, _SWITCH = Writable(0, 2**32 - 1), Writable(0, 1)
_LOCKED_SWITCH, _FACTOR = Writable(0, 1, is_locked=True), Writable(1, 2, is_locked=True)
_GAIN, _RATIO = _real(0.0, 24.0), _real(0.125, 8.0)
WRITABLE: dict[int, Writable] = {
    HEARTBEAT_MS: Writable(500, 2**32 - 1),
    CONTROL_PRIVILEGE: Writable(0, 3),
    HOST_PORT: Writable(0, 65535),
    PACKET_SIZE: Writable(576, 65500, 4),
    PACKET_DELAY: _ANY,
    HOST_ADDRESS: _ANY,
    WIDTH: _image(8, 4, lambda held: held.widest() - held.integer(OFFSET_X)),
    HEIGHT: _image(8, 2, lambda held: held.highest() - held.integer(OFFSET_Y)),
    OFFSET_X: _image(0, 4, lambda held: held.widest() - held.integer(WIDTH)),
    OFFSET_Y: _image(0, 2, lambda held: held.highest() - held.integer(HEIGHT)),
    PIXEL_FORMAT: Writable(0, 2**32 - 1, is_locked=True, among=PIXEL_FORMATS),
    BINNING_X: _FACTOR,
    BINNING_Y: _FACTOR,
    DECIMATION_X: _FACTOR,
    DECIMATION_Y: _FACTOR,
    REVERSE_X: _LOCKED_SWITCH,
    REVERSE_Y: _LOCKED_SWITCH,
    TEST_PATTERN: _SWITCH,
    ACQUISITION_MODE: Writable(CONTINUOUS, MULTI_FRAME, is_locked=True),
    ACQUISITION: _SWITCH,
    FRAME_COUNT: Writable(1, 65535),
    FRAME_RATE_ENABLE: _SWITCH,
    EXPOSURE_MODE: _SWITCH,
    EXPOSURE_AUTO: Writable(0, 2),
    GAIN_AUTO: Writable(0, 2),
    GAIN_SELECTOR: _SWITCH,
    GAMMA_ENABLE: _SWITCH,
    LUT_ENABLE: _SWITCH,
    BALANCE_SELECTOR: _SWITCH,
    LINE_INVERTER: _SWITCH,
    TRIGGER_SELECTOR: _SWITCH,
    TRIGGER_MODE: _SWITCH,
    TRIGGER_MODE + 4: _SWITCH,
    TRIGGER_SOURCE: _SWITCH,
    TRIGGER_SOURCE + 4: _SWITCH,
    TRIGGER_ACTIVATION: _SWITCH,
    TRIGGER_OVERLAP: Writable(0, 2),
    TRIGGER_DIVIDER: Writable(1, 16),
    TRIGGER_SOFTWARE: Writable(1, 1),
    COUNTER_SELECTOR: _SWITCH,
    FRAME_RATE_HZ: _real(0.1, math.inf, lambda held: held.real(FRAME_RATE_MAX_HZ)),
    EXPOSURE_US: _real(10.0, 1e7),
    TRIGGER_DELAY_US: _real(0.0, 1e6),
    GAMMA: _real(0.25, 4.0),
    GAIN_DB: _GAIN,
    GAIN_DB + 8: _GAIN,
    BALANCE_RATIO: _RATIO,
    BALANCE_RATIO + 8: _RATIO,
}
"""Limits as in gige.xml, which clients can read."""


def refusal(registers: Registers, address: int, data: bytes) -> int:
    """Return the status with which the camera refuses `data` for the register at `address`; DONE if it accepts
    them."""
    if address % 4 or len(data) % 4:
        return BAD_ALIGNMENT
    if not 0 <= address <= REGISTER_BYTES - len(data):
        return INVALID_ADDRESS
    rule = WRITABLE.get(address)
    if rule is None or (rule.is_locked and registers.integer(ACQUISITION)):
        return WRITE_PROTECTED
    if len(data) != rule.size:
        return BAD_ALIGNMENT
    number: float = struct.unpack(">I" if rule.size == 4 else ">d", data)[0]
    if address == PACKET_SIZE:
        number = int(number) & 0xFFFF  # the other bits are flags
    return DONE if rule.allows(number, registers) else INVALID_PARAMETER


def fires_test_packet(registers: Registers) -> bool:
    """True if the client's last write to PACKET_SIZE asked for a test packet; the flag is then cleared."""
    register = registers.integer(PACKET_SIZE)
    registers.set_integer(PACKET_SIZE, register & ~_FIRE_TEST_PACKET)
    return bool(register & _FIRE_TEST_PACKET)
