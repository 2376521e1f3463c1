"""Makes the pictures of the README: the simulated cell (SVG) and a synthetic frame of the showpiece (PNG).

`python tools/make_pictures.py` writes docs/pictures/cell.svg and docs/pictures/frame.png.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole import kinematics
from coupole.geometry import apply, inverse
from coupole.motion.itinerary import plan_itinerary
from coupole.plan.arm_description import shipped_arm
from coupole.preflight.job import Job, read_job
from coupole.preflight.simulated_world import world_config
from coupole.viewing.raw_preview import develop, png
from sim.devices.camera_body import Exposed
from sim.optics.photographer import Photographer
from sim.world.config import Config

ROOT = Path(__file__).resolve().parent.parent
PICTURES = ROOT / "docs/pictures"
SHOWN_VIEW = 1
"""View of the demo in which the arm is drawn."""
FRAME_VIEW, FRAME_LED, FRAME_S = 0, 996, 8e-3
"""View of the showpiece, LED, and exposure of the frame."""
_WIDTH, _HEIGHT, _SCALE = 900, 600, 0.26
_EYE_AZIMUTH_DEG, _EYE_ELEVATION_DEG = -62.0, 16.0
ARM = shipped_arm("kr10_r1100_sixx").arm


def project(points_support_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Support coordinates [n, 3] to picture coordinates [n, 3]: x, y and depth (towards the eye)."""
    azimuth, elevation = np.radians([_EYE_AZIMUTH_DEG, _EYE_ELEVATION_DEG])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    towards = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    up = np.cross(towards, right)
    x, y, depth = (np.atleast_2d(points_support_mm) @ np.stack([right, up, towards], axis=1)).T
    return np.stack([_WIDTH / 2 + _SCALE * x, _HEIGHT - 90 - _SCALE * y, depth], axis=1)


def elbow_points(joints_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Joint origins [8, 3] of the arm in the base frame, mm, from base to flange."""
    return kinematics.link_frames(ARM, joints_deg)[:, :3, 3]


def polyline(points: NDArray[np.float64], style: str) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y, _ in project(points))
    return f'<polyline points="{path}" {style}/>'


def joints_of_view(job: Job, number: int) -> NDArray[np.float64]:
    rig = job.cell.rig
    visits = plan_itinerary(job.schedule.views, rig, job.motion.bodies, rig.motion.home_joints_deg).visits
    visit = visits[number]
    assert visit is not None
    return visit.joints_deg


def draw_cell(job: Job) -> str:
    """Draw the dome, the disk, the arm in one view of the plan, and the camera's field."""
    rig = job.cell.rig
    support_from_base = inverse(rig.support.base_from_support.matrix())
    there = joints_of_view(job, SHOWN_VIEW)
    arm = apply(support_from_base, elbow_points(there))
    flange = support_from_base @ kinematics.forward(ARM, there)
    camera = flange @ rig.flange_from_camera.matrix()
    half = rig.lens.focus_distance_mm * rig.sensor.pixel_pitch_um * 1e-3 / rig.lens.focal_length_mm / 2
    corners = [
        [sx * rig.sensor.width_px * half, sy * rig.sensor.height_px * half, rig.lens.focus_distance_mm]
        for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))
    ]
    field = apply(camera, corners)
    angle = np.linspace(0, 2 * np.pi, 90)
    rim = 0.5 * rig.support.diameter_mm * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    leds = project(apply(support_from_base, job.cell.leds.positions_mm))
    nearest, farthest = leds[:, 2].max(), leds[:, 2].min()
    box = job.shape.dose_points_mm[:8]
    edges = [(0, 1), (0, 2), (0, 4), (1, 3), (1, 5), (2, 3), (2, 6), (3, 7), (4, 5), (4, 6), (5, 7), (6, 7)]
    parts = [polyline(rim, 'fill="#20242a" stroke="#4a525c"')]
    for x, y, depth in leds[np.argsort(leds[:, 2])]:
        near = (depth - farthest) / (nearest - farthest)
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{1.2 + near:.1f}" fill="#ffd27a" '
            f'opacity="{0.75 - 0.5 * near:.2f}"/>'
        )
    parts += [polyline(box[list(edge)], 'stroke="#d8c8a8" stroke-width="1.5"') for edge in edges]
    parts += [polyline(np.stack([camera[:3, 3], c]), 'stroke="#6fb7ff" stroke-width="1"') for c in field[:4]]
    parts.append(polyline(field, 'fill="#6fb7ff" fill-opacity="0.15" stroke="#6fb7ff" stroke-width="1"'))
    parts.append(
        polyline(
            arm, 'fill="none" stroke="#f08a3c" stroke-width="13" stroke-linejoin="round" stroke-linecap="round"'
        )
    )
    parts.append(
        polyline(
            np.stack([flange[:3, 3], camera[:3, 3]]),
            'fill="none" stroke="#dfe5ec" stroke-width="15" stroke-linecap="square"',
        )
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" '
        f'width="{_WIDTH}" height="{_HEIGHT}"><title>The simulated cell: 1080 LEDs, support disk, arm and '
        f'camera in one view of the demo plan</title><rect width="{_WIDTH}" height="{_HEIGHT}" fill="#12151a"/>'
        + "".join(parts)
        + "</svg>\n"
    )


def synthetic_frame(job: Job) -> bytes:
    """Return one frame of the showpiece, rendered at twice its resolution and developed at its resolution, as
    PNG."""
    sensor = job.cell.rig.sensor
    fine = {
        "width_px": 2 * sensor.width_px,
        "height_px": 2 * sensor.height_px,
        "pixel_pitch_um": 0.5 * sensor.pixel_pitch_um,
    }
    config = Config.model_validate(world_config(job.cell, job, sensor.model_copy(update=fine)))
    photographer = Photographer(config.scene, config.rendered_camera, config.settings)
    flange = kinematics.forward(ARM, joints_of_view(job, FRAME_VIEW))
    raw = np.zeros((2 * sensor.height_px, 2 * sensor.width_px), np.uint16)
    photographer.render(raw, Exposed({FRAME_LED: FRAME_S}, [], FRAME_S, 1.0, 0, flange))
    model = photographer.sensor
    return png(develop(raw, pattern=model.bayer_pattern, black_dn=model.black_dn, white_dn=model.white_dn))


def main() -> None:
    """Write both pictures."""
    demo, showpiece = (read_job(ROOT / f"configs/plans/{name}.yaml") for name in ("demo", "showpiece"))
    PICTURES.mkdir(parents=True, exist_ok=True)
    (PICTURES / "cell.svg").write_text(draw_cell(demo), encoding="utf-8")
    (PICTURES / "frame.png").write_bytes(synthetic_frame(showpiece))


if __name__ == "__main__":
    main()
