"""Description of a run in run.json, and of the cell in every view's file. With this description, the run can be
used without its rig and plan.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coupole.acquisition.opened_cell import OpenedCell
from coupole.acquisition.verdict import PROOF_BY
from coupole.plan.rig import Rig
from coupole.plan.schedule import Schedule
from coupole.preflight.job import Job
from coupole.storage.frame_file_creation import Collections, Quantity

_BASE = "the robot's base"
_IN_PX = ("fx", "fy", "cx", "cy")
_MODEL = "OpenCV's: pinhole, distortion k1 k2 p1 p2 k3; pixel (0, 0) has its centre at (0, 0)"


def described_cell(job: Job) -> Collections:
    """Return the LEDs as in the rig's table, and the lens: from the camera record in force, or otherwise from the
    rig."""
    leds = job.cell.leds
    return {
        "instrument/leds": {
            "id": leds.ids,
            "board": leds.boards,
            "position_mm": Quantity(leds.positions_mm, "mm", _BASE),
            "normal": Quantity(leds.normals, "", _BASE),
            "flux_lm": Quantity(leds.flux_lm, "lm"),
            "emission": Quantity(job.cell.rig.dome.emission),
        },
        "instrument/lens": _lens(job),
    }


def _lens(job: Job) -> dict[str, Quantity]:
    rig = job.cell.rig
    flange_from_camera = rig.flange_from_camera.matrix()
    quantities = {
        "focal_length": Quantity(rig.lens.focal_length_mm, "mm"),
        "f_number": Quantity(rig.lens.f_number),
        "focus_distance": Quantity(rig.lens.focus_distance_mm, "mm", "from the projection centre"),
        "flange_from_camera": Quantity(
            flange_from_camera, "mm", "maps camera coordinates to the flange, by the rig"
        ),
    }
    records = [item for item in job.calibrations or () if item.record.kind == "camera"]
    if not records:
        return {**quantities, **_nominal(rig)}
    from coupole.calibration.record import intrinsics_of

    intrinsics, _ = intrinsics_of(records[0].record)
    return {
        **quantities,
        **_pinhole(vars(intrinsics)),
        "source": Quantity(f"calibration record {Path(records[0].path).name}, {records[0].record.sha256}"),
    }


def _pinhole(values: Mapping[str, float]) -> dict[str, Quantity]:
    units = {name: Quantity(value, "px" if name in _IN_PX else "1") for name, value in values.items()}
    return {**units, "model": Quantity(_MODEL)}


def _nominal(rig: Rig) -> dict[str, Quantity]:
    """Return a pinhole camera without distortion, focused at the rig's distance."""
    image_mm = 1 / (1 / rig.lens.focal_length_mm - 1 / rig.lens.focus_distance_mm)
    f_px = image_mm / (rig.sensor.pixel_pitch_um * 1e-3)
    centre_px = (rig.sensor.width_px - 1) / 2, (rig.sensor.height_px - 1) / 2
    return {
        **_pinhole({"fx": f_px, "fy": f_px, "cx": centre_px[0], "cy": centre_px[1]}),
        "source": Quantity("nominal, from the rig: no calibration of the camera was in force"),
    }


def camera_name(cell: OpenedCell) -> str:
    """The camera's name in calibration records."""
    return " ".join((cell.identities["camera"].model, cell.identities["camera"].serial))


def about_run(job: Job, cell: OpenedCell) -> dict[str, Any]:
    """The contents of run.json in addition to the inputs."""
    return {
        "simulated": cell.is_simulated,
        "proof": _proof(job),
        **({"discard": job.plan.discard} if job.plan.discard else {}),
        "licence": job.plan.licence or job.cell.rig.licence,
        "contact": job.plan.contact or job.cell.rig.contact,
        "object": job.plan.object.id if job.plan.object else None,
        "calibrations": {item.record.kind: item.record.sha256 for item in job.calibrations or ()} or "none",
        "devices": {kind: vars(identity) for kind, identity in cell.identities.items()},
        "scaling": cell.world_endpoints["camera"]["scaling"] if cell.world_endpoints else None,
        "views": [view.name for view in job.schedule.views],
        "labels": [] if job.schedule.is_open else _labels(job.schedule),
        "chosen_in_the_run": job.schedule.is_open,
        **({"most_views": job.schedule.view_count} if job.plan.chooses_views else {}),
        "hidden_leds": job.hidden_leds,
        "expected": {"shots": job.schedule.shots, "frames": job.schedule.frames},
    }


def _labels(schedule: Schedule) -> list[str] | dict[str, list[str]]:
    """One list if all views have the same frames; otherwise one for each view, by its name."""
    if len(set(schedule.labels)) == 1:
        return list(map(str, schedule.labels[0]))
    return {
        view.name: list(map(str, labels)) for view, labels in zip(schedule.views, schedule.labels, strict=True)
    }


def _proof(job: Job) -> str:
    """The kind of proof of the run's frames."""
    return PROOF_BY[job.schedule.planned_bursts()[0][0].marks]


def metadata_of_views(job: Job, cell: OpenedCell) -> dict[str, Any]:
    """Attributes of every view's file."""
    rig = job.cell.rig
    return {
        "program_name": "coupole",
        "sample": job.plan.object.id if job.plan.object else "none",
        "simulated": cell.is_simulated,
        "proof": _proof(job),
        "pixel_pitch_um": cell.sensor.pixel_pitch_um,
        "focal_length_mm": rig.lens.focal_length_mm,
        "f_number": rig.lens.f_number,
        "focus_distance_mm": rig.lens.focus_distance_mm,
        "base_from_support": rig.support.base_from_support.matrix(),
        "camera": camera_name(cell),
        "gain_db": job.plan.gain_db,
    }
