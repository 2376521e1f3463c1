"""Opened devices of a rig, real or simulated, that are made safe on every exit."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from coupole.acquisition.cell_marks import in_use
from coupole.acquisition.noted_devices import NAMES, NotedDevice
from coupole.acquisition.safeguard import Safeguard
from coupole.acquisition.signals import drop_signals
from coupole.bounded import NOW, hangs, run_bounded, under_way
from coupole.clock import Clock, SystemClock
from coupole.devices import Camera, Identity, LedBox, Robot
from coupole.errors import DeviceTimeout
from coupole.plan.cell import Cell
from coupole.plan.controller_places import remember_controller
from coupole.plan.registry import WORLD, load_class, settings_class
from coupole.plan.rig import Rig, Sensor
from coupole.plan.rig_devices import device_for, in_world
from coupole.preflight.simulated_world import coarse, frozen, world_config
from coupole.viewing.terminal import alarm

if TYPE_CHECKING:
    from coupole.preflight.job import Job

_LONGEST_WATCHDOG_S = 60.0
_WORLD_STARTS_S, _OPENS_S = 900.0, 30.0
_SLOW_START_S = 15.0
_WORLD_COMPILES = (
    "the simulated cell compiles its code, once on each machine: a minute or two, longer on a busy machine ..."
)


ARM_STOPPED = "arm stopped"
"""Name of the safeguard of the arm."""


@dataclass
class OpenedCell:
    """Devices in use. `make_safe` and `close` never raise; their errors are in `trouble`."""

    clock: Clock
    ledbox: LedBox
    camera: Camera
    robot: Robot
    sensor: Sensor
    """The frame format: the rig's sensor, or its reduced twin in a dry run."""
    is_simulated: bool
    world_endpoints: Mapping[str, Any] | None
    identities: dict[str, Identity]
    trouble: list[str] = field(default_factory=list)
    arm_confirmed: bool = True
    """False if the arm was not confirmed to be at rest at the end."""
    lights_confirmed: bool = True
    """False if the lights were not confirmed to be off at the end."""
    switched_off_ns: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=16))
    """Pairs of times on the rig's clock, the newest last: when the box was told to switch the lights off, and when
    it had answered."""
    _made_safe: threading.Event = field(default_factory=threading.Event, repr=False)
    """Shared with the devices, which light and move nothing once it is set."""
    _first: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _safeguards_ended: threading.Event = field(default_factory=threading.Event, repr=False)

    @property
    def made_safe(self) -> bool:
        """True after `make_safe` was called: nothing is lit or moved any more."""
        return self._made_safe.is_set()

    def halt(self) -> list[Safeguard]:
        """Begin to switch the lights off and to stop the arm, side by side; returns at once. From any thread."""
        return [
            Safeguard("lights off", self.switch_off),
            Safeguard(ARM_STOPPED, self.robot.stop),
        ]

    def switch_off(self) -> None:
        """Switch the lights off, and note the time. The lights go off even if the clock fails."""
        times_ns = []
        with contextlib.suppress(Exception):
            times_ns.append(self.clock.now_ns())
        self.ledbox.lights_off()
        with contextlib.suppress(Exception):
            begun_ns, ended_ns = *times_ns, self.clock.now_ns()
            self.switched_off_ns.append((begun_ns, ended_ns))

    def make_safe(self) -> None:
        """Switch the lights off and stop the arm, side by side, then disarm the camera. Each is tried even if
        another fails or hangs. Signals wait. Only the first call acts; other calls wait for it. Nothing may be lit
        or moved afterwards."""
        with self._first:
            is_first = not self.made_safe
            self._made_safe.set()
        if not is_first:
            self._safeguards_ended.wait()  # each safeguard is given up after its time
            return
        try:
            self._make_safe()
        finally:
            self._safeguards_ended.set()

    def _make_safe(self) -> None:
        with drop_signals():
            safeguards = self.halt()
            for safeguard in safeguards:
                safeguard.wait()
            safeguards.append(Safeguard("camera disarmed", self.camera.disarm))
            safeguards[-1].wait()
        for safeguard in safeguards:
            if safeguard.trouble:
                self.trouble.append(f"not sure that it is safe ({safeguard.what}): {safeguard.trouble}")
        self.lights_confirmed, self.arm_confirmed = not safeguards[0].trouble, not safeguards[1].trouble


@contextmanager
def open_cell(
    cell: Cell,
    *,
    job: Job | None = None,
    dry_run: bool = False,
    speed: float | None = None,
    on_opened: Callable[[str, Identity], None] = lambda kind, identity: None,
) -> Iterator[OpenedCell]:
    """Open the rig's devices (its twins in a dry run) and its world, if it has one; close all of it at the end.

    Raises DeviceError if a device cannot be opened; devices that were opened before it are closed.
    """
    with contextlib.ExitStack() as stack:
        if not dry_run:
            stack.enter_context(in_use(cell))
        clock: Clock = SystemClock()
        endpoints: Mapping[str, Any] | None = None
        sensor = coarse(cell.rig.sensor) if dry_run else cell.rig.sensor
        if in_world(cell.rig, dry_run=dry_run):
            begin = partial(_get_world, cell, job, sensor, dry_run=dry_run, speed=speed)
            world = run_bounded(begin, discard=lambda late: late.close())
            stack.callback(world.close)
            clock, endpoints = world.clock, world.endpoints
        devices: dict[str, Any] = {}
        made_safe = threading.Event()
        identities: dict[str, Identity] = {}
        for kind in ("ledbox", "camera", "robot"):
            begin = partial(_open_device, cell.rig, kind, clock, endpoints, dry_run=dry_run, speed=speed or 1.0)
            device = run_bounded(begin, discard=lambda late: late.close())
            devices[kind] = NotedDevice(device, kind, cell.rig, made_safe)
            stack.push(partial(_close, devices[kind], NAMES[kind]))
            identities[kind] = run_bounded(devices[kind].identify)
            on_opened(kind, identities[kind])
        if not dry_run:
            remember_controller(cell, identities["robot"])
        opened_cell = OpenedCell(
            clock,
            **devices,
            sensor=sensor,
            is_simulated=endpoints is not None,
            world_endpoints=endpoints,
            identities=identities,
            _made_safe=made_safe,
        )
        try:
            yield opened_cell
        finally:
            opened_cell.make_safe()


def _open_device(
    rig: Rig, kind: str, clock: Clock, endpoints: Mapping[str, Any] | None, *, dry_run: bool, speed: float
) -> Any:
    driver, settings = device_for(rig, kind, dry_run=dry_run)
    if speed > 1.0 and "watchdog_s" in settings_class(driver).model_fields:
        # World time may run faster than the host's: the box's watchdog must not trip because of that.
        settings["watchdog_s"] = min(_LONGEST_WATCHDOG_S, settings.get("watchdog_s", 2.0) * speed)
    if endpoints is not None:
        fields = settings_class(driver).model_fields
        settings |= {name: value for name, value in endpoints[kind].items() if name in fields}
    device_settings = settings_class(driver)(**settings)
    with under_way(NAMES[kind], "open", _OPENS_S + getattr(device_settings, "connect_timeout_s", 0.0)):
        return load_class(driver)(device_settings, clock)


def _close(device: Any, name: str, _: object, failing: BaseException | None, __: object) -> None:
    """Close a device, unless a call of it hangs. Raises the device's errors, and DeviceTimeout if the call does
    not return. If something has failed already, the time-out is only reported."""
    if call := hangs(name):
        alarm(f"{name}: not closed, because the call `{call}` has not returned; it ends with this process")
        return
    try:
        run_bounded(device.close, stop=NOW)
    except DeviceTimeout as error:
        if failing is None:
            raise
        alarm(str(error))


def _get_world(cell: Cell, job: Job | None, sensor: Sensor, *, dry_run: bool, speed: float | None) -> Any:
    section = cell.rig.world
    driver = section.driver if section else WORLD
    world_class = load_class(driver)
    if section is not None and section.join is not None and not dry_run:
        return world_class.join(cell.document.resolve(section.join))
    with (
        frozen(world_config(cell, job, sensor, dry_run=dry_run, speed=speed), cell.files) as config,
        under_way("world", "start", _WORLD_STARTS_S),
        told_if_slow(_WORLD_COMPILES),
    ):
        return world_class.start(config)


@contextmanager
def told_if_slow(words: str) -> Iterator[None]:
    """Tell a waiting user the reason for the wait."""
    timer = threading.Timer(_SLOW_START_S, alarm, (words,))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
