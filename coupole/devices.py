"""The device contracts: one Protocol for each kind of device, with only the calls that the sequencer needs.

Units are in the names. Times are nanoseconds of the named clock: the box's, the camera's or the rig's. Every
blocking call has a time-out. A call that fails raises a `coupole.errors.DeviceError`. A call that never returns is
left behind (`coupole.bounded`): session and process end, and the device is not closed. After `close()`, and after
any exception, a device is safe: lights off, camera disarmed, robot at rest.
"""

from __future__ import annotations

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
"""A time that is not available: the box has no clock, or the event did not happen."""


@dataclass(frozen=True)
class Step:
    """One step of a table that a box runs by itself."""

    led: int
    """The LED that the step lights; NO_LED for none."""
    on_us: int
    """On-time of the LED. For a dark step it is the nominal time."""
    trigger_delay_us: int
    """Time from LED on to the trigger edge."""
    period_us: int
    """Time from this step's LED on to the next step's."""
    sends_edge: bool = True
    """True if the camera is triggered in this step."""


@dataclass(frozen=True)
class StepRecord:
    """The actual execution of a step of a table, or of a flash, from the box's log or its driver."""

    step: int
    """Index in the table, from 0; 0 for a flash."""
    led: int
    """LED, as in `Step`."""
    edge_sent: bool
    """True if a trigger edge was sent."""
    led_open: bool
    """True if the LED drew no current though it was switched on (dead LED, broken wire). False if the box does not
    measure it."""
    over_temperature: bool
    """True if the board was over its limit; a burst ends with this step. False if the box does not measure it."""
    waited: bool
    """True if the step was delayed until the camera's exposure-ready line rose."""
    on_us: float
    """Upper bound of the time that the LED was lit; 0 without light."""
    t_on_ns: int
    """Time when the LED was switched on, on the box's clock; UNKNOWN_NS if the box has none."""
    t_trigger_ns: int
    """Time when the edge was sent, on the box's clock; UNKNOWN_NS if no edge was sent, or if the box has no
    clock."""
    board_temperature_c: float
    """Temperature of the LED's board, C; NaN if the box does not measure it."""
    led_current_ma: float
    """Current through the LED, mA; NaN if the box does not measure it."""

    @property
    def invalid_exposure(self) -> bool:
        """True if a picture under this light must not be used."""
        return self.led != NO_LED and (self.led_open or self.over_temperature)


STEP_DTYPE = np.dtype(list(get_type_hints(Step).items()))
"""Type of tables, which are arrays [n]: the fields of `Step`, as int64 and bool."""
STEP_RECORD_DTYPE = np.dtype(list(get_type_hints(StepRecord).items()))
"""Type of logs, which are arrays [n]: the fields of `StepRecord`, as int64, bool and float64."""


@dataclass(frozen=True)
class Identity:
    """Identity reported by a device."""

    vendor: str
    model: str
    serial: str
    firmware: str
    simulated: bool = False
    settings: Mapping[str, str] = field(default_factory=dict, hash=False)
    """Settings, read back from the device after its driver has set them. A run records them."""


@dataclass(frozen=True)
class HostNeed:
    """A driver's need of the machine on which it runs. A `Settings` model may have a method `host_needs`. It
    returns a list of needs without touching the device; `coupole doctor` shows them."""

    name: str
    """Right, library, file or setting of the system that is needed."""
    is_met: bool
    state: str
    """The state that was found, in words."""
    remedy: str
    """Action of a person that meets the need, as a sentence."""
    is_vital: bool = True
    """False if the device works even if the need is not met, but slower or with losses."""


class LedBox(Protocol):
    """An LED control box with the functions that every box has: it lights one LED at a time on command.

    Each call may raise a DeviceError; all lights are then off, provided that the box still accepts commands.
    """

    runs_tables: bool
    """True for a `TableLedBox`. The driver's class declares it, so that a rig can be checked before a box is
    opened."""
    led_count: int
    """Number of LEDs; they are numbered from 0."""
    panel_count: int
    """Number of flat white panels, numbered from 1; 0 if there are none."""

    def identify(self) -> Identity: ...

    def self_test(self) -> Mapping[str, str]:
        """Return the self-test report of the box, for `coupole devices`. Raises if the box is not usable."""

    def flash(self, led: int, on_us: int) -> None:
        """Light one LED (NO_LED: none) for `on_us`; returns as soon as the box has confirmed that it is lit.

        The box or the driver switches the light off after that time, independently of the caller. The camera is
        not triggered. Raises DeviceRefused for an LED that the box does not have.
        """

    def lit(self) -> bool:
        """True only if the light of the last `flash` has been on without interruption since that call returned.
        For a flash without light, it is true while the light would be on."""

    def end_flash(self) -> StepRecord:
        """End the last `flash`, possibly before its time. Returns its record; its LED is then off.

        Raises DeviceTimeout if the box does not confirm the end in time.
        """

    def lights_off(self) -> None:
        """Abort a running burst, and switch all LEDs and panels off. Returns when the box has confirmed this.

        Any thread may call this at any moment, even while another call is in progress. It does not wait for that
        call: a box that has a device clear is dark within 100 ms, even while a table is being uploaded. Other
        calls in progress end with a DeviceError, and give no light after this call has returned.
        """

    def acknowledge(self) -> None:
        """Clear a latched fault (such as the watchdog's) after a person has confirmed it, as opening does. All is
        dark afterwards, and tables must be loaded again."""

    def panel(self, panel: int, on: bool) -> None:
        """Switch a flat white panel (1 to `panel_count`). Raises DeviceRefused for any other number."""

    def board_temperature_c(self, board: int) -> float | None:
        """Return the temperature of an LED board, C; None if the box does not measure it."""

    def presence(self) -> bool | None:
        """Tell whether a person at the cell holds the enabling switch; None if the box has no input for one."""

    def close(self) -> None:
        """Switch the lights off if the box still accepts commands. Never raises because of a lost link."""


class TableLedBox(LedBox, Protocol):
    """A box that runs a table of steps by itself, sends trigger edges and keeps a log. It runs bursts at full
    speed."""

    def load(self, table: NDArray[np.void]) -> None:
        """Upload a table (STEP_DTYPE [n]) to the bank that is not running. It has no effect if the table is
        already there.

        May be called while the other bank runs. Raises DeviceRefused, which names the record, for a table out of
        the box's limits.
        """

    def start(self, table: NDArray[np.void]) -> None:
        """Run a loaded table, after checking that the box still has it unchanged. Returns at once."""

    def poll_log(self) -> NDArray[np.void]:
        """Return the records (STEP_RECORD_DTYPE [k]) of all steps that finished since the last poll; there may be
        none.

        Raises DeviceFault if a fault of the box ended the burst.
        """

    def running(self) -> bool:
        """True while a table runs."""

    def edges(self) -> int:
        """Number of trigger edges sent since the last `start`."""


def table_box(box: LedBox) -> TableLedBox:
    """Return the box as one that runs tables. Raises DeviceRefused if it does not run tables."""
    if not box.runs_tables:
        raise DeviceRefused(
            "led box",
            expected="a box that runs tables and triggers the camera, for `trigger: hardware`",
            happened="this box only switches single LEDs on command",
            remedy="Set `trigger: software` in the plan: then the host triggers the camera.",
        )
    return cast(TableLedBox, box)


@dataclass(frozen=True)
class FrameFormat:
    """Format of all frames of an armed camera."""

    height_px: int
    width_px: int
    bit_depth: int
    bayer_pattern: str
    """Colours of the 2 x 2 pixels from the top left, row by row: GBRG, GRBG, RGGB, BGGR, or MONO."""
    black_dn: int
    white_dn: int
    """Value of a saturated pixel, DN."""

    @property
    def frame_bytes(self) -> int:
        return self.height_px * self.width_px * 2


@dataclass(frozen=True)
class Exposure:
    """Exposure of a burst."""

    exposure_us: int
    gain_db: float = 0.0
    hardware_trigger: bool = True


@dataclass
class Frame:
    """One frame as the camera delivered it. `pixels` is valid until `release()`."""

    frame_id: int
    """Number of the frame among those that the camera exposed, modulo the transport's range (see
    `Camera.id_modulus`)."""
    timestamp_ns: int
    """Start of exposure on the camera's clock."""
    pixels: NDArray[np.uint16] = field(repr=False)
    """[height_px, width_px], DN, in page-aligned memory of the driver; it is not copied."""
    release: Any = field(default=lambda: None, repr=False)
    """Function that returns the buffer to the camera. Call it once, when the bytes are no longer needed."""
    rendered: bool = True
    """False for a frame without a picture, which the simulated camera may deliver in a dry run."""


@dataclass(frozen=True)
class CameraStatistics:
    """The camera's own counters since `arm`; -1 if the camera has no such counter."""

    exposed: int
    """Frames that the sensor exposed."""
    delivered: int
    """Frames that reached the host completely."""
    lost_transfers: int
    over_triggers: int
    """Edges that came too early and were ignored."""
    overflows: int
    """Frames lost because the host had no buffer free."""


class Camera(Protocol):
    """The camera. Call `configure`, then `arm`, then `next_frame` as often as needed, then `disarm`."""

    id_modulus: tuple[int, int]
    """First and last frame id of the transport: (1, 65535) on GigE Vision 1. After the last id comes the first."""
    timestamp_jitter_us: float
    """Largest deviation of a timestamp from its edge, without clock drift."""
    delivery_s: float
    """Longest time from the end of a readout until the frame has reached the host."""

    def identify(self) -> Identity: ...

    def self_test(self) -> Mapping[str, str]: ...

    def configure(self, exposure: Exposure) -> FrameFormat:
        """Set exposure, gain and trigger; return the format of the frames. The camera must be disarmed."""

    def min_period_us(self, exposure: Exposure) -> int:
        """Shortest time between two edges that this exposure and the sensor's readout allow."""

    def arm(self, buffers: int) -> None:
        """Queue at least `buffers` buffers and start acquisition: from now on edges trigger frames."""

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Return the oldest frame not yet taken, or None if no frame arrived in time."""

    def trigger(self) -> None:
        """Trigger the camera by software. Only with `hardware_trigger=False`."""

    def statistics(self) -> CameraStatistics: ...

    def disarm(self) -> None:
        """Stop acquisition and take all buffers back. Safe to call at any time."""

    def close(self) -> None: ...


@dataclass(frozen=True)
class ArmCondition:
    """State of safety that the arm's controller reports. None, or an empty mode, means that it does not report
    it."""

    mode: str = ""
    """Operating mode in the controller's own word: `T1`, `automatic`, `running`."""
    emergency_stop: bool | None = None
    """True if an emergency stop is in force."""
    protective_stop: bool | None = None
    """True if a protective or safeguard stop is in force: collision, safety gate, enabling switch."""
    brakes_released: bool | None = None
    """True if the drives are on and hold the arm."""


@dataclass(frozen=True)
class ArmState:
    """The arm's state, as measured by its controller."""

    joints_deg: tuple[float, float, float, float, float, float]
    base_from_flange: Transform
    t_ns: int
    """Time when this state was received, on the rig's clock. Each new report of the controller has a later
    time."""
    moving: bool
    fault: str = ""
    """Name and reason of a latched fault; empty when there is none."""
    condition: ArmCondition = ArmCondition()
    unattended_s: float = 0.0
    """Time without a look at the arm, s, machine time, if this ended the last motion; otherwise 0."""


class Robot(Protocol):
    """The arm that carries the camera.

    A motion must be watched (`coupole.supervision`). The thread that called `move_to` calls `measured` at least
    every 0.1 s of the machine's time until the arm is at rest. Instead, the thread may wait in `wait_settled`,
    which does the same. Otherwise the axes brake on their path, even if this process hangs or has ended. No fault
    is latched then.
    """

    def identify(self) -> Identity: ...

    def self_test(self) -> Mapping[str, str]: ...

    def move_to(self, joints_deg: NDArray[np.float64], speed: float = 1.0) -> None:
        """Start a jerk-limited motion to joint angles [6]; returns at once. If the arm is moving, it first comes
        to rest. No axis exceeds the share `speed` (above 0, at most 1) of the driver's speeds.

        Raises DeviceRefused if the target is out of limits, or if another thread called `stop` since this call
        began. Then no motion is started.
        """

    def wait_settled(self) -> ArmState:
        """Wait until the arm is at rest at the target; the time-out is derived from the commanded motion.

        Raises DeviceFault for a latched fault, DeviceLost if the link is gone, and DeviceTimeout. Raises
        DeviceRefused if another thread commands the arm meanwhile, and ArmUnattended if the motion ended because
        nobody watched it.
        """

    def measured(self) -> ArmState:
        """Return the arm's latest state. A call from the thread that began a motion counts as a look at the
        motion."""

    def stop(self) -> None:
        """Stop the arm along its path, as fast as its limits allow; returns when it is at rest.

        Any thread may call this at any moment, even while another call on the same robot is in progress. A target
        that waits for the arm to be at rest is forgotten. After `stop`, each axis of a motion by `move_to` turns
        by at most `stopping_deg` more.
        """

    def stopping_deg(self) -> NDArray[np.float64]:
        """Largest further turn of each axis [6] after `stop`, from its speeds, accelerations and delays."""

    def statistics(self) -> Mapping[str, float]:
        """Return figures of the link since it was opened (answers, late answers, ...), for the journal."""

    def close(self) -> None: ...
