"""Opened devices of a rig, real or in a world, that are made safe on every way out."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from coupole.devices import Camera, Clock, Identity, LedBox, Robot, SystemClock
from coupole.errors import CoupoleError
from coupole.job import Cell, Job
from coupole.rig import (
    ENDPOINT_SETTINGS,
    Rig,
    Sensor,
    device_for,
    in_world,
    load_class,
    settings_class,
)

DRY_RUN_WIDTH_PX = 128
_LONGEST_WATCHDOG_S = 60.0
DRY_RUN_PICTURES = 48
"""Frames of each burst that a dry run renders, about: the sample that exposure is judged on."""


@dataclass
class OpenedCell:
    """Devices in use. `make_safe` and `close` never raise; what goes wrong there is in `trouble`."""

    clock: Clock
    ledbox: LedBox
    camera: Camera
    robot: Robot
    sensor: Sensor
    """What frames look like: the rig's sensor, or its coarse twin in a dry run."""
    simulated: bool
    world_endpoints: Mapping[str, Any] | None
    identities: dict[str, Identity]
    trouble: list[str] = field(default_factory=list)

    def make_safe(self) -> None:
        """Lights off, arm still, camera disarmed; each is tried whatever happens to the others."""
        for what, act in (
            ("lights off", self.ledbox.lights_off),
            ("arm stopped", self.robot.stop),
            ("camera disarmed", self.camera.disarm),
        ):
            try:
                act()
            except CoupoleError as error:
                self.trouble.append(f"not sure that it is safe ({what}): {error}")


def coarse(sensor: Sensor) -> Sensor:
    """The same field of view with far fewer pixels, for dry runs; sides stay even for the Bayer pattern."""
    factor = max(1, -(-sensor.width_px // DRY_RUN_WIDTH_PX))
    return sensor.model_copy(
        update={
            "width_px": max(8, sensor.width_px // factor // 2 * 2),
            "height_px": max(8, sensor.height_px // factor // 2 * 2),
            "pixel_pitch_um": sensor.pixel_pitch_um * factor,
        }
    )


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

    Raises DeviceError if one cannot be opened; those opened before it are closed.
    """
    with contextlib.ExitStack() as stack:
        clock: Clock = SystemClock()
        endpoints: Mapping[str, Any] | None = None
        sensor = coarse(cell.rig.sensor) if dry_run else cell.rig.sensor
        if in_world(cell.rig, dry_run=dry_run):
            world = _get_world(cell, job, sensor, dry_run=dry_run, speed=speed)
            stack.callback(world.close)
            clock, endpoints = world.clock, world.endpoints
        opened: dict[str, Any] = {}
        identities: dict[str, Identity] = {}
        for kind in ("ledbox", "camera", "robot"):
            opened[kind] = _open_device(cell.rig, kind, clock, endpoints, dry_run=dry_run, speed=speed or 1.0)
            stack.callback(opened[kind].close)
            identities[kind] = opened[kind].identify()
            on_opened(kind, identities[kind])
        opened_cell = OpenedCell(
            clock,
            **opened,
            sensor=sensor,
            simulated=endpoints is not None,
            world_endpoints=endpoints,
            identities=identities,
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
        # The world's seconds pass faster than the host's: its watchdog must not bite a host that is on time.
        settings["watchdog_s"] = min(_LONGEST_WATCHDOG_S, settings.get("watchdog_s", 2.0) * speed)
    if endpoints is not None:
        endpoint_key, setting, _ = ENDPOINT_SETTINGS[kind]
        settings[setting] = endpoints[kind][endpoint_key]
    return load_class(driver)(settings_class(driver)(**settings), clock)


def _get_world(cell: Cell, job: Job | None, sensor: Sensor, *, dry_run: bool, speed: float | None) -> Any:
    section = cell.rig.world
    driver = section.driver if section else "sim.client:World"
    world_class = load_class(driver)
    if section is not None and section.join is not None and not dry_run:
        return world_class.join(cell.document.resolve(section.join))
    return world_class.start(world_config(cell, job, sensor, dry_run=dry_run, speed=speed))


def world_config(
    cell: Cell, job: Job | None, sensor: Sensor, *, dry_run: bool = False, speed: float | None = None
) -> dict[str, Any]:
    """The world that a rig describes, as `sim.world.Config` in JSON form."""
    rig = cell.rig
    settings: dict[str, Any] = dict(rig.world.settings) if rig.world else {}
    if speed is not None:
        settings |= {"speed": speed, "hurry_only_when_told": dry_run}
    robot = {"start_joints_deg": list(rig.motion.home_joints_deg), **settings.get("robot", {})}
    robot.setdefault("sends_to", f"127.0.0.1:{_free_udp_port()}")
    robot.setdefault("cycle_ms", rig.robot.settings.get("cycle_ms", 4))
    settings["robot"] = robot
    if dry_run and job is not None:
        every = max(1, job.schedule.frames // len(job.schedule.views) // DRY_RUN_PICTURES)
        settings["camera"] = {"render_every": every, **settings.get("camera", {})}
    exposures_us = job.plan.exposure.exposures_us if job else (8000,)
    return {
        "settings": settings,
        "scene": {
            "leds": str(cell.leds_path),
            "emission": rig.dome.emission,
            "base_from_support": rig.support.base_from_support.matrix().tolist(),
            "support_diameter_mm": rig.support.diameter_mm,
            "objects": _objects(job),
        },
        "camera": {
            **sensor.model_dump(
                include={
                    "width_px",
                    "height_px",
                    "pixel_pitch_um",
                    "bit_depth",
                    "bayer_pattern",
                    "black_dn",
                    "max_frames_per_s",
                    "exposure_gap_us",
                }
            ),
            "focal_length_mm": rig.lens.focal_length_mm,
            "focus_distance_mm": rig.lens.focus_distance_mm,
            "flange_from_camera": rig.flange_from_camera.matrix().tolist(),
            "nominal_exposure_us": exposures_us[len(exposures_us) // 2],
        },
    }


def _objects(job: Job | None) -> list[dict[str, Any]]:
    if job is None or job.mesh_path is None or job.plan.object is None:
        return []
    path: Path = job.mesh_path
    return [
        {
            "path": str(path),
            "unit": job.plan.object.mesh_unit,
            "support_from_object": job.plan.object.support_from_object.matrix().tolist(),
        }
    ]


def _free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port
