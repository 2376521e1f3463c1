"""Description of the cell in every view's file, so that it can be used without rig and plan: LEDs and lens."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from coupole.plan.rig import Rig
from coupole.preflight.job import Job
from coupole.storage.frame_file_creation import Collections, Quantity

_BASE = "the robot's base"
_IN_PX = ("fx", "fy", "cx", "cy")
_MODEL = "OpenCV's: pinhole, distortion k1 k2 p1 p2 k3; pixel (0, 0) has its centre at (0, 0)"


def described_cell(job: Job) -> Collections:
    """The LEDs as the rig's table has them, and the lens: of the camera record in force, or else of the rig."""
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
    """A pinhole without distortion that is focused at the rig's distance."""
    image_mm = 1 / (1 / rig.lens.focal_length_mm - 1 / rig.lens.focus_distance_mm)
    f_px = image_mm / (rig.sensor.pixel_pitch_um * 1e-3)
    centre_px = (rig.sensor.width_px - 1) / 2, (rig.sensor.height_px - 1) / 2
    return {
        **_pinhole({"fx": f_px, "fy": f_px, "cx": centre_px[0], "cy": centre_px[1]}),
        "source": Quantity("nominal, from the rig: no calibration of the camera was in force"),
    }
