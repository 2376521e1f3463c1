"""The settings of a rig's world and its stand-ins."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coupole.errors import InputError
from coupole.intake.input_files import InputFiles
from coupole.plan.cell import Cell
from coupole.plan.rig import Rig, Sensor
from coupole.plan.rig_devices import camera_kind, device_for, ledbox_stand_in, stand_in_for, world_problems
from coupole.preflight.exposure_scale import exposure_scale, white_share

if TYPE_CHECKING:
    from coupole.preflight.job import Job

DRY_RUN_WIDTH_PX = 128
DRY_RUN_PICTURES = 48
"""Approximate number of frames of each burst that a dry run renders, for evaluating the exposure."""


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


def world_config(
    cell: Cell, job: Job | None, sensor: Sensor, *, dry_run: bool = False, speed: float | None = None
) -> dict[str, Any]:
    """The rig's world, as `sim.world.config.Config` in JSON form. Raises InputError if the world's settings are
    invalid."""
    rig = cell.rig
    settings: dict[str, Any] = dict(rig.world.settings) if rig.world else {}
    if speed is not None:
        settings |= {"speed": speed, "hurry_only_when_told": dry_run}
    if dry_run:
        settings |= {"shading": "flat", "detail": (), "interreflection": None}
    settings["robot"] = _robot_config(rig, settings.get("robot", {}), dry_run=dry_run)
    settings["camera"] = _camera_config(rig, settings.get("camera", {}), job if dry_run else None, dry_run=dry_run)
    settings["ledbox"] = _ledbox_config(rig, settings.get("ledbox", {}), dry_run=dry_run)
    if problems := world_problems(cell.document, rig, settings):
        raise InputError(problems)
    exposures_us = job.plan.exposure.exposures_us if job else (8000,)
    nominal_us = settings.get("white_at_us") or exposures_us[len(exposures_us) // 2]
    scale = exposure_scale(job) if job is not None and dry_run else None
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
            "nominal_exposure_us": nominal_us,
            **({"white_share": white_share(job, scale, nominal_us)} if job is not None and scale else {}),
        },
    }


@contextmanager
def frozen(config: dict[str, Any], files: InputFiles) -> Iterator[dict[str, Any]]:
    """Give the settings of the same world, with copies of the files as they were read. Use them while the world
    starts. The world reads its files itself, in another process, and must read the bytes that were checked.
    """
    scene = config["scene"]
    with tempfile.TemporaryDirectory(prefix="coupole-inputs-") as folder:

        def copied_path(path: str, place: str) -> str:
            copy = Path(folder, place, Path(path).name)
            copy.parent.mkdir()
            copy.write_bytes(files.read_bytes(Path(path)))
            return str(copy)

        objects = [
            {
                **scene_object,
                "path": copied_path(scene_object["path"], f"object{number}"),
                "pictures_beside": scene_object["path"],
            }
            for number, scene_object in enumerate(scene["objects"])
        ]
        yield {**config, "scene": {**scene, "leds": copied_path(scene["leds"], "dome"), "objects": objects}}


def _robot_config(rig: Rig, overrides: Mapping[str, Any], *, dry_run: bool) -> dict[str, Any]:
    """Settings of the robot's stand-in: from the rig, and from its driver's settings."""
    _, settings = device_for(rig, "robot", dry_run=dry_run)
    stand_in = stand_in_for(rig, dry_run=dry_run)
    alike = {name: settings[name] for name in stand_in.alike if name in settings}
    start = {"start_joints_deg": list(rig.motion.home_joints_deg)}
    return {"kind": stand_in.kind, **start, **stand_in.settings, **alike, **overrides}


def _ledbox_config(rig: Rig, overrides: Mapping[str, Any], *, dry_run: bool) -> dict[str, Any]:
    """Settings of the LED box's stand-in: from the rig, and from its driver's settings."""
    _, settings = device_for(rig, "ledbox", dry_run=dry_run)
    stand_in = ledbox_stand_in(rig, dry_run=dry_run)
    alike = {name: settings[name] for name in stand_in.alike if name in settings}
    return {"kind": stand_in.kind, **alike, **overrides}


def _camera_config(
    rig: Rig, overrides: Mapping[str, Any], rehearsed_job: Job | None, *, dry_run: bool
) -> dict[str, Any]:
    """Settings of the camera's stand-in from the rig; none if a dry run uses another kind of camera."""
    kind = camera_kind(rig, dry_run=dry_run)
    if rehearsed_job is not None:
        frames_of_view = rehearsed_job.schedule.frames // len(rehearsed_job.schedule.views)
        every = 1 if rehearsed_job.schedule.is_open else max(1, frames_of_view // DRY_RUN_PICTURES)
        overrides = {"render_every": every, **overrides}
    if kind != camera_kind(rig, dry_run=False):
        overrides = {name: value for name, value in overrides.items() if name == "render_every"}
    return {"kind": kind, **overrides}


def _objects(job: Job | None) -> list[dict[str, Any]]:
    if job is None or job.shape.mesh_path is None or job.plan.object is None:
        return []
    return [
        {
            "path": str(job.shape.mesh_path),
            "unit": job.plan.object.mesh_unit,
            "support_from_object": job.plan.object.support_from_object.matrix().tolist(),
        }
    ]
