"""Opened devices of a rig, real or in a world, that are made safe on every way out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from coupole.devices import Camera, Clock, Identity, LedBox, Robot, SystemClock
from coupole.errors import CoupoleError, InputError
from coupole.plan.rig import (
    DEFAULT_WORLD,
    Rig,
    Sensor,
    camera_kind,
    device_for,
    in_world,
    ledbox_stand_in,
    load_class,
    settings_class,
    stand_in_for,
    world_problems,
)
from coupole.preflight.job import Cell, Job

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
        known = settings_class(driver).model_fields
        settings |= {name: value for name, value in endpoints[kind].items() if name in known}
    return load_class(driver)(settings_class(driver)(**settings), clock)


def _get_world(cell: Cell, job: Job | None, sensor: Sensor, *, dry_run: bool, speed: float | None) -> Any:
    section = cell.rig.world
    driver = section.driver if section else DEFAULT_WORLD
    world_class = load_class(driver)
    if section is not None and section.join is not None and not dry_run:
        return world_class.join(cell.document.resolve(section.join))
    return world_class.start(world_config(cell, job, sensor, dry_run=dry_run, speed=speed))


def world_config(
    cell: Cell, job: Job | None, sensor: Sensor, *, dry_run: bool = False, speed: float | None = None
) -> dict[str, Any]:
    """The world that a rig describes, as `sim.world.config.Config` in JSON form. Raises InputError where there is
    no such world."""
    rig = cell.rig
    settings: dict[str, Any] = dict(rig.world.settings) if rig.world else {}
    if speed is not None:
        settings |= {"speed": speed, "hurry_only_when_told": dry_run}
    settings["robot"] = _robot_config(rig, settings.get("robot", {}), dry_run=dry_run)
    settings["camera"] = _camera_config(rig, settings.get("camera", {}), job if dry_run else None, dry_run=dry_run)
    settings["ledbox"] = _ledbox_config(rig, settings.get("ledbox", {}), dry_run=dry_run)
    if problems := world_problems(cell.document, rig, settings):
        raise InputError(problems)
    exposures_us = job.plan.exposure.exposures_us if job else (8000,)
    return {
        "settings": settings,
        "scene": {
            "leds": str(cell.leds_path),
            "emission": rig.dome.emission,
            "base_from_support": rig.support.base_from_support.matrix().tolist(),
            "support_diameter_mm": rig.support.diameter_mm,
            "objects": _objects(job),
            "tool": [body.model_dump() for body in rig.tool],
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
            "f_number": rig.lens.f_number,
            "flange_from_camera": rig.flange_from_camera.matrix().tolist(),
            "nominal_exposure_us": exposures_us[len(exposures_us) // 2],
        },
    }


def _robot_config(rig: Rig, given: Mapping[str, Any], *, dry_run: bool) -> dict[str, Any]:
    """The robot's stand-in: what the rig says of it, and what follows from the driver at the other end."""
    _, settings = device_for(rig, "robot", dry_run=dry_run)
    stand_in = stand_in_for(rig, dry_run=dry_run)
    alike = {name: settings[name] for name in stand_in.alike if name in settings}
    start = {"start_joints_deg": list(rig.motion.home_joints_deg)}
    return {"kind": stand_in.kind, **start, **stand_in.settings, **alike, **given}


def _ledbox_config(rig: Rig, given: Mapping[str, Any], *, dry_run: bool) -> dict[str, Any]:
    """The LED box's stand-in: what the rig says of it, and what follows from the driver at the other end."""
    _, settings = device_for(rig, "ledbox", dry_run=dry_run)
    stand_in = ledbox_stand_in(rig, dry_run=dry_run)
    alike = {name: settings[name] for name in stand_in.alike if name in settings}
    return {"kind": stand_in.kind, **alike, **given}


def _camera_config(rig: Rig, given: Mapping[str, Any], rehearsed: Job | None, *, dry_run: bool) -> dict[str, Any]:
    """The camera's stand-in, as the rig describes it; not where a rehearsal has another kind of camera."""
    kind = camera_kind(rig, dry_run=dry_run)
    if rehearsed is not None:
        every = max(1, rehearsed.schedule.frames // len(rehearsed.schedule.views) // DRY_RUN_PICTURES)
        given = {"render_every": every, **given}
    if kind != camera_kind(rig, dry_run=False):
        given = {name: value for name, value in given.items() if name == "render_every"}
    return {"kind": kind, **given}


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
