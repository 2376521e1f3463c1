"""What the sequencer asks of a device, and nothing more: one Protocol for each kind.

Units are in the names. Times are nanoseconds of the clock that is named: the box's, the camera's or the rig's.
Every blocking call has a time-out; a call that cannot do what it says raises a `coupole.errors.DeviceError`.
After `close()`, and after any exception, a device is safe: lights off, camera disarmed, robot standing still.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, cast, get_type_hints

import numpy as np
from numpy.typing import NDArray

from coupole.errors import DeviceRefused
from coupole.geometry import Transform

NO_LED = -1
"""The `led` of a step or a flash without light."""
UNKNOWN_NS = -1
"""A time that a box cannot tell: it has no clock, or nothing happened at that time."""


@dataclass(frozen=True)
class Step:
    """One step of a table that a box runs by itself."""

    led: int
    """The LED that it lights, NO_LED for none."""
    on_us: int
    """How long the LED is lit; of a dark step, how long it would be."""
    trigger_delay_us: int
    """From LED on to the trigger edge."""
    period_us: int
    """From this step's LED on to the next one's."""
    sends_edge: bool = True
    """Whether the camera is triggered in this step."""


@dataclass(frozen=True)
class StepRecord:
    """What a step of a table, or a flash, really did: as the box's log says, or its driver saw."""

    step: int
    """Place in the table, from 0; 0 of a flash."""
    led: int
    """As in `Step`."""
    edge_sent: bool
    """A trigger edge was sent."""
    led_open: bool
    """The LED drew no current though it was switched on (dead LED, broken wire); False if the box cannot tell."""
    over_temperature: bool
    """The board was over its limit; a burst ends with this step. False if the box cannot tell."""
    waited: bool
    """The step was held back until the camera's exposure-ready line rose."""
    on_us: float
    """How long the LED was lit, at the longest; 0 without light."""
    t_on_ns: int
    """When the LED was switched on, on the box's clock; UNKNOWN_NS of a box without one."""
    t_trigger_ns: int
    """When the edge was sent, on the box's clock; UNKNOWN_NS if none was, or of a box without clock."""
    board_temperature_c: float
    """Of the LED's board, C; NaN if the box cannot tell."""
    led_current_ma: float
    """Through the LED, mA; NaN if the box cannot tell."""

    @property
    def invalid_exposure(self) -> bool:
        """True if a picture under this light must not be used."""
        return self.led != NO_LED and (self.led_open or self.over_temperature)


STEP_DTYPE = np.dtype(list(get_type_hints(Step).items()))
"""Tables are arrays [n] of this: the fields of `Step`, as int64 and bool."""
STEP_RECORD_DTYPE = np.dtype(list(get_type_hints(StepRecord).items()))
"""Logs are arrays [n] of this: the fields of `StepRecord`, as int64, bool and float64."""


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
    """The LED control box, as far as every one can go: it lights one LED at a time when it is told to.

    Each call may raise a DeviceError; whatever was lit is dark then, as far as the box still obeys.
    """

    runs_tables: bool
    """True of a `TableLedBox`. Declared by the driver's class, so that a rig is judged before a box is opened."""
    led_count: int
    """LEDs are numbered from 0 to one less."""
    panel_count: int
    """Flat white panels that it switches, numbered from 1; 0 for none."""

    def identify(self) -> Identity: ...

    def self_test(self) -> Mapping[str, str]:
        """What the box reports of itself, for `coupole devices`; raises where it is not fit for use."""
        ...

    def flash(self, led: int, on_us: int) -> None:
        """Light one LED (NO_LED: none) for `on_us`; returns as soon as the box has confirmed that it shines.

        Box or driver end the light at that time by themselves, whatever the caller does meanwhile. Nothing is
        triggered. Raises DeviceRefused for an LED that the box does not have.
        """
        ...

    def lit(self) -> bool:
        """True only if the light of the last `flash` has shone without a break since that call returned. Without
        light: as it would be with it."""
        ...

    def end_flash(self) -> StepRecord:
        """See the last `flash` end: it may be cut short. Returns what it did; its `led` is dark.

        Raises DeviceTimeout if the box does not say in time that it has ended.
        """
        ...

    def lights_off(self) -> None:
        """Abort what runs, all LEDs and panels dark. Safe to call at any time."""
        ...

    def panel(self, panel: int, on: bool) -> None:
        """Switch a flat white panel (1 to `panel_count`); raises DeviceRefused for another."""
        ...

    def board_temperature_c(self, board: int) -> float | None:
        """Of an LED board, C; None if the box cannot tell."""
        ...

    def close(self) -> None:
        """Lights off if the box still listens; never raises for a link that is dead."""
        ...


class TableLedBox(LedBox, Protocol):
    """A box that runs a table of steps by itself, sends trigger edges and keeps a log: bursts at full speed."""

    def load(self, table: NDArray[np.void]) -> None:
        """Bring a table (STEP_DTYPE [n]) into the bank that is not running; a no-op if it is there already.

        May be called while the other bank runs. Raises DeviceRefused, naming the record, for a table out of the
        box's limits.
        """
        ...

    def start(self, table: NDArray[np.void]) -> None:
        """Run a loaded table, after making sure that the box still has it as it was loaded. Returns at once."""
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


def table_box(box: LedBox) -> TableLedBox:
    """The box as one that runs tables. Raises DeviceRefused if it does not."""
    if not box.runs_tables:
        raise DeviceRefused(
            "led box",
            expected="a box that runs tables and triggers the camera, for `trigger: hardware`",
            happened="this one only lights one LED when it is told to",
            remedy="Set `trigger: software` in the plan: then the host triggers the camera.",
        )
    return cast(TableLedBox, box)


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
