"""What the sequencer asks of a device, and nothing more: one Protocol for each kind.

Units are in the names. Times are nanoseconds of the clock that is named: the box's, the camera's or the rig's.
Every blocking call has a time-out; a call that cannot do what it says raises a `coupole.errors.DeviceError`.
After `close()`, and after any exception, a device is safe: lights off, camera disarmed, robot standing still.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform

NO_LIGHT = 0xFFFF
"""The `led` of a dark step."""

FLAG_NO_TRIGGER = 1
"""Step flag: light the LED but send no trigger edge."""

STEP_DTYPE = np.dtype(
    [
        ("led", "<u2"),
        ("flags", "<u2"),
        ("on_us", "<u4"),
        ("trigger_delay_us", "<u4"),
        ("period_us", "<u4"),
    ]
)
"""One record of the box's table, 16 bytes as on the wire. `trigger_delay_us` runs from LED on to edge."""

STEP_RECORD_DTYPE = np.dtype(
    [
        ("step", "<u4"),
        ("led", "<u2"),
        ("status", "<u2"),
        ("t_on_ns", "<u8"),
        ("t_trigger_ns", "<u8"),
        ("board_temperature_dc", "<i2"),
        ("led_current_ma", "<u2"),
    ]
)
"""One record of the box's log, 28 bytes as on the wire: what a step really did, on the box's clock.
`board_temperature_dc` is in tenths of a degree Celsius."""

STATUS_LED_OPEN = 1
"""Log status: the LED drew no current though it was switched on (dead LED or broken wire)."""
STATUS_OVER_TEMPERATURE = 2
"""Log status: the board was over its limit; the burst ends with this step."""
STATUS_NO_EDGE = 4
"""Log status: no trigger edge was sent in this step."""
STATUS_WAITED = 8
"""Log status: the step was held back until the camera's exposure-ready line rose."""


class Clock(Protocol):
    """The rig's clock. On a simulated rig it is the world's, which may run faster or wait."""

    def now_ns(self) -> int: ...

    def sleep(self, seconds: float) -> None:
        """Wait `seconds` on this clock; returns early only if the clock's source is gone."""
        ...

    def hurry(self, until_ns: int) -> None:
        """Until then the caller only waits: a simulated clock may run fast. A real one cannot."""
        ...


class SystemClock:
    """The clock of a rig of real devices: the machine's monotonic one."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)

    def hurry(self, until_ns: int) -> None:
        """Real time does not hurry."""


class Deadline:
    """Expires `seconds` from now on the rig's clock, or when that clock itself seems dead.

    The guard on the machine's own clock (`10 * seconds + 20 s`) matters only where the rig's clock can stand
    still: a simulated world that died or hangs.
    """

    def __init__(self, clock: Clock, seconds: float) -> None:
        self._clock = clock
        self._end_ns = clock.now_ns() + int(seconds * 1e9)
        self._guard = time.monotonic() + 10.0 * seconds + 20.0
        self.seconds = seconds

    @property
    def remaining_s(self) -> float:
        """Seconds left on the rig's clock, 0 when expired."""
        if time.monotonic() > self._guard:
            return 0.0
        return max(0.0, (self._end_ns - self._clock.now_ns()) / 1e9)

    @property
    def expired(self) -> bool:
        return self.remaining_s <= 0.0


@dataclass(frozen=True)
class Identity:
    """Who a device says it is."""

    vendor: str
    model: str
    serial: str
    firmware: str
    simulated: bool = False


class LedBox(Protocol):
    """The LED control box: runs a table of steps by itself, lights LEDs and sends trigger edges."""

    led_count: int

    def identify(self) -> Identity: ...

    def self_test(self) -> Mapping[str, str]:
        """What the box reports of itself, for `coupole devices`; raises where it is not fit for use."""
        ...

    def load(self, table: NDArray[np.void]) -> None:
        """Bring a table (STEP_DTYPE [n]) into the bank that is not running; a no-op if it is there already.

        May be called while the other bank runs. Raises DeviceRefused, naming the record, for a table out of the
        box's limits.
        """
        ...

    def start(self, table: NDArray[np.void]) -> None:
        """Run a loaded table, after reading its CRC back. Returns at once."""
        ...

    def poll_log(self) -> NDArray[np.void]:
        """Records (STEP_RECORD_DTYPE [k]) of all steps that finished since the last poll; may be empty.

        Raises DeviceFault if the burst ended by a fault of the box.
        """
        ...

    def running(self) -> bool:
        """True while a table runs."""
        ...

    def edges(self) -> int:
        """Trigger edges sent since the last `start`."""
        ...

    def lights_off(self) -> None:
        """Abort what runs, all LEDs and panels dark. Safe to call at any time."""
        ...

    def panel(self, panel: int, on: bool) -> None:
        """Switch a flat white panel (1 to 4)."""
        ...

    def board_temperature_c(self, board: int) -> float: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class FrameFormat:
    """What every frame of an armed camera looks like."""

    height_px: int
    width_px: int
    bit_depth: int
    bayer_pattern: str
    """2x2 from the top left, row by row: GBRG, GRBG, RGGB, BGGR, or MONO."""
    black_dn: int
    white_dn: int
    """Saturation, DN."""

    @property
    def frame_bytes(self) -> int:
        return self.height_px * self.width_px * 2


@dataclass(frozen=True)
class Exposure:
    """How a burst is exposed."""

    exposure_us: int
    gain_db: float = 0.0
    hardware_trigger: bool = True


@dataclass
class Frame:
    """One frame as the camera delivered it. `pixels` is valid until `release()`."""

    frame_id: int
    """Counts frames that the camera exposed, modulo the transport's range (see `Camera.id_modulus`)."""
    timestamp_ns: int
    """Start of exposure on the camera's clock."""
    pixels: NDArray[np.uint16] = field(repr=False)
    """[height_px, width_px], DN; page-aligned memory of the driver, not copied."""
    release: Any = field(default=lambda: None, repr=False)
    """Call once, when the bytes are needed no more: the buffer goes back to the camera."""
    rendered: bool = True
    """False for a frame without picture, which the simulated camera may deliver in a dry run."""


@dataclass(frozen=True)
class CameraStatistics:
    """The camera's own counters since `arm`; -1 where the camera has no such counter."""

    exposed: int
    """Frames that the sensor exposed."""
    delivered: int
    """Frames that reached the host whole."""
    lost_transfers: int
    over_triggers: int
    """Edges that came too early and were ignored."""
    overflows: int
    """Frames lost because the host had no buffer free."""


class Camera(Protocol):
    """The camera. `configure`, then `arm`, then `next_frame` until done, then `disarm`."""

    id_modulus: tuple[int, int]
    """First and last frame id of the transport: (1, 65535) on GigE Vision 1; after last comes first."""
    timestamp_jitter_us: float
    """Largest deviation of a timestamp from its edge, clock drift apart."""
    delivery_s: float
    """Longest time from the end of a readout until the frame has reached the host."""

    def identify(self) -> Identity: ...

    def self_test(self) -> Mapping[str, str]: ...

    def configure(self, exposure: Exposure) -> FrameFormat:
        """Set exposure, gain and trigger; returns what frames will look like. The camera must be disarmed."""
        ...

    def min_period_us(self, exposure: Exposure) -> int:
        """Shortest time between two edges that this exposure and the sensor's readout allow."""
        ...

    def arm(self, buffers: int) -> None:
        """Queue `buffers` buffers at least and start acquisition: edges make frames from now on."""
        ...

    def next_frame(self, timeout_s: float) -> Frame | None:
        """The oldest frame not yet taken, or None if none came in time."""
        ...

    def trigger(self) -> None:
        """Software trigger; only with `hardware_trigger=False`."""
        ...

    def statistics(self) -> CameraStatistics: ...

    def disarm(self) -> None:
        """Stop acquisition and take all buffers back. Safe to call at any time."""
        ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class ArmState:
    """Where the arm is, as measured by its controller."""

    joints_deg: tuple[float, float, float, float, float, float]
    base_from_flange: Transform
    t_ns: int
    """When this was first seen, on the rig's clock: a later time means that the controller was heard since."""
    moving: bool
    fault: str = ""
    """Name and reason of a latched fault; empty when there is none."""


class Robot(Protocol):
    """The arm that carries the camera."""

    def identify(self) -> Identity: ...

    def self_test(self) -> Mapping[str, str]: ...

    def move_to(self, joints_deg: NDArray[np.float64]) -> None:
        """Start a jerk-limited motion to joint angles [6]; returns at once. Raises DeviceRefused out of limits."""
        ...

    def wait_settled(self) -> ArmState:
        """Wait until the arm stands at the target and still; the time-out is derived from the motion asked.

        Raises DeviceFault on a latched fault, DeviceLost if the link is gone, DeviceTimeout.
        """
        ...

    def measured(self) -> ArmState: ...

    def stop(self) -> None:
        """Bring the arm to rest along its path, as fast as its limits allow. Safe to call at any time.

        From any motion that `move_to` began, each axis turns by at most `stopping_deg` more.
        """
        ...

    def stopping_deg(self) -> NDArray[np.float64]:
        """Farthest that each axis [6] still turns after `stop` is called: what this driver's speeds,
        accelerations and delays make of it."""
        ...

    def statistics(self) -> Mapping[str, float]:
        """Figures of the link since it was opened (answers, late answers, ...), for the journal."""
        ...

    def close(self) -> None: ...
