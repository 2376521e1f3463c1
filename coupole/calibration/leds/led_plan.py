"""The plan for the calibration of a dome's LEDs: postures from which all boards are seen often enough, and the
boards that are lit at each.

Postures are drawn at random and kept if the arm may take them and the camera sees some boards completely;
`led_views` chooses among them. A view to which no path is found is replaced by another one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from coupole import kinematics
from coupole.calibration.leds.boards import Boards, boards_of
from coupole.calibration.leds.views import ENOUGH, LedView, boards_seen, led_views
from coupole.calibration.optics import Intrinsics
from coupole.calibration.rotations import Floats
from coupole.errors import InputError
from coupole.motion import singularities
from coupole.motion.collisions import CellBodies
from coupole.motion.itinerary import arm_of, bodies_of, plan_itinerary
from coupole.plan.cell import Cell
from coupole.plan.rig import Rig
from coupole.plan.schedule import ViewPose

_DRAWN = 60_000
_MOST_CANDIDATES = 2_000
_LEAST_BOARDS = 2
_ROUNDS = 6
_WRIST_DEG, _TURN_DEG = 120.0, 90.0
"""Largest angle of axes 4 and 6, because of cables."""
_MARGIN = 0.025
"""Margin as a share of the frame's width: a spot nearer to the edge may be cut off."""

_HEAD = """\
# Views of the dome's LEDs themselves, for `coupole calibrate leds` (docs/how-to/calibrate-leds.md): {views} views,
# {images} images, each board seen {enough} times.
schema_version: 1
name: {name}
rig: {rig}
calibrations: none
views:
"""
_TAIL = """\
lights: {kind: none}
exposure: {kind: fixed, exposure_us: 1000}
darks_per_view: 1
"""


def led_plan(
    cell: Cell,
    *,
    name: str,
    rig: str,
    seed: int = 1,
    draw_count: int = _DRAWN,
    enough: int = ENOUGH,
    tell: Callable[[str], None] = lambda what: None,
) -> str:
    """The plan's text. Raises InputError, with the numbers of the boards, if boards cannot be seen often
    enough."""
    boards = boards_of(cell.leds)
    bodies = bodies_of(cell.rig, cell.leds, np.zeros((0, 3, 3)))
    tell("drawing postures of the arm")
    joints_deg = _candidates(cell.rig, boards, bodies, np.random.default_rng(seed), draw_count)
    for _ in range(_ROUNDS):
        tell(f"choosing views among {len(joints_deg)} postures")
        lens, size_px, margin_px = _camera(cell.rig)
        choice = led_views(
            boards, _cameras(cell.rig, joints_deg), lens, size_px, enough=enough, margin_px=margin_px
        )
        if choice.few:
            raise InputError(
                f"leds: expected to see each board {enough} times; of {len(joints_deg)} postures too few see "
                f"boards {', '.join(map(str, choice.few[:12]))}. Draw more, or another --seed"
            )
        tell(f"planning paths to {len(choice.views)} views")
        views = [
            ViewPose(f"l{number:03d}", None, tuple(joints_deg[view.candidate].tolist()), None)
            for number, view in enumerate(choice.views)
        ]
        visits = plan_itinerary(views, cell.rig, bodies, cell.rig.motion.home_joints_deg).visits
        cut_off = [view.candidate for view, visit in zip(choice.views, visits, strict=True) if visit is None]
        if not cut_off:
            lines = [_line(number, joints_deg, view) for number, view in enumerate(choice.views)]
            head = _HEAD.format(views=len(lines), images=choice.images, enough=enough, name=name, rig=rig)
            return head + "\n".join(lines) + "\n" + _TAIL
        joints_deg = np.delete(joints_deg, cut_off, axis=0)
    raise InputError(f"leds: no paths to all of the views were found in {_ROUNDS} rounds. Try another --seed")


def _candidates(
    rig: Rig, boards: Boards, bodies: CellBodies, random: np.random.Generator, draw_count: int
) -> Floats:
    """[n, 6] postures without collision and singularity from which some boards are seen completely."""
    arm = arm_of(rig)
    low, high = np.array(arm.limits_deg).T
    low[3], high[3] = max(low[3], -_WRIST_DEG), min(high[3], _WRIST_DEG)
    low[5], high[5] = max(low[5], -_TURN_DEG), min(high[5], _TURN_DEG)
    joints_deg = np.round(random.uniform(np.ceil(low), np.floor(high), (draw_count, 6)))
    lens, size_px, margin_px = _camera(rig)
    visible = boards_seen(boards, _cameras(rig, joints_deg), lens, size_px, margin_px)
    keep = np.flatnonzero(visible.sum(axis=1) >= _LEAST_BOARDS)
    keep = keep[singularities.margin(arm, joints_deg[keep]) >= 1.0]
    tightest_mm = [bodies.tightest_mm(joints_deg[part]) for part in np.array_split(keep, -(-len(keep) // 500))]
    keep = keep[np.concatenate(tightest_mm) >= 0.0] if len(keep) else keep
    visible = visible[keep]
    # Some are kept because they see many boards, some because they see boards that few others see.
    rare = visible @ (1.0 / np.maximum(visible.sum(axis=0), 1))
    half = _MOST_CANDIDATES // 2
    best = np.unique(np.concatenate([np.argsort(-rare)[:half], np.argsort(-visible.sum(axis=1))[:half]]))
    return np.asarray(joints_deg[keep[best]])


def _cameras(rig: Rig, joints_deg: Floats) -> Floats:
    """[n, 4, 4] base_from_camera."""
    flange_from_camera = rig.flange_from_camera.matrix()
    return kinematics.forward(arm_of(rig), joints_deg) @ flange_from_camera


def _camera(rig: Rig) -> tuple[Intrinsics, tuple[int, int], float]:
    """Return the lens as the rig describes it, the frame size, and the least distance of a spot from the edge."""
    lens, sensor = rig.lens, rig.sensor
    focal_px = 1e3 / sensor.pixel_pitch_um / (1.0 / lens.focal_length_mm - 1.0 / lens.focus_distance_mm)
    size = (sensor.width_px, sensor.height_px)
    return (
        Intrinsics(focal_px, focal_px, 0.5 * (size[0] - 1), 0.5 * (size[1] - 1)),
        size,
        _MARGIN * sensor.width_px,
    )


def _line(number: int, joints_deg: NDArray[np.float64], view: LedView) -> str:
    angles = ", ".join(f"{angle:g}" for angle in joints_deg[view.candidate])
    lights = f"{{kind: boards, boards: {list(view.boards)}}}"
    return f"  - {{kind: joints, name: l{number:03d}, joints_deg: [{angles}],\n     lights: {lights}}}"
