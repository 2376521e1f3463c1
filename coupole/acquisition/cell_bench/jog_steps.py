"""Motions by hand, step by step: each step is a straight motion in joint space that touches nothing.

The arm comes to rest at the end of a step by its own speed profile. If it is stopped, it comes to rest earlier on
the same line. So it always stays on a line that was checked as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coupole.acquisition.cell_bench.bench_requests import Axis
from coupole.acquisition.commissioning.reduced_speed import REDUCED_MM_S
from coupole.errors import InputError
from coupole.geometry import Transform, inverse
from coupole.kinematics import Arm, forward, link_frames, move_duration_s, nearest
from coupole.kinematics import inverse as postures_of
from coupole.motion.collisions import CellBodies
from coupole.motion.itinerary import Visit
from coupole.motion.path_planner import Joints, Leg

_STEP_DEG, _STEP_MM = 30.0, 100.0
_LEAST_DEG, _LEAST_MM = 0.05, 1.0
_OFF_LINE_MM, _MOST_TURN_DEG = 1.0, 20.0
"""Greatest distance of the camera from its line within a step; greatest turn of any axis in a step along a
line."""
_HALVINGS = 10
_KEPT_MM = 2.0
"""A step towards a contact ends this length before the last clear posture, at every point of arm and tool."""
_SAMPLES, _ROUNDING_MM = 65, 1e-6


@dataclass(frozen=True)
class JogStep:
    """One step, and the share of the arm's speeds that keeps it slow enough."""

    visit: Visit
    speed: float


def jog_step(
    arm: Arm,
    bodies: CellBodies,
    flange_from_camera: Transform,
    here_deg: Joints,
    axis: Axis,
    direction: int,
    share: float,
) -> JogStep:
    """Return the next step. No point of arm and tool is faster than `share` of REDUCED_MM_S.

    Raises InputError that says why there is none: a limit, a contact, or a posture near a singularity.
    """
    if axis.startswith("A"):
        there_deg = _step_target_deg(arm, here_deg, int(axis[1]) - 1, direction)
    else:
        there_deg = _along(arm, flange_from_camera, here_deg, axis, direction)
    there_deg = _clear_part(bodies, here_deg, there_deg)
    duration_s = move_duration_s(arm, here_deg, there_deg)
    speed = min(1.0, share * REDUCED_MM_S / greatest_speed_mm_s(arm, bodies, here_deg, there_deg))
    return JogStep(Visit(there_deg, Leg((there_deg,), duration_s / speed)), speed)


def greatest_speed_mm_s(arm: Arm, bodies: CellBodies, from_deg: Joints, to_deg: Joints) -> float:
    """Return a bound of the speed of any point of arm and tool in a straight motion in joint space at full speed.
    The bound is a sum over the axes: the speed of an axis times the greatest distance of any point from it."""
    turn_deg = np.abs(to_deg - from_deg)
    line_s = float((turn_deg / np.array(arm.velocity_deg_s)).max())
    return float(np.radians(turn_deg / line_s) @ bodies.reach_mm)


def _step_target_deg(arm: Arm, here_deg: Joints, axis: int, direction: int) -> Joints:
    low, high = arm.limits_deg[axis]
    room_deg = high - here_deg[axis] if direction > 0 else here_deg[axis] - low
    if room_deg < _LEAST_DEG:
        raise InputError(f"A{axis + 1} is at its limit of {high if direction > 0 else low:g} deg")
    there_deg = here_deg.copy()
    there_deg[axis] += direction * min(_STEP_DEG, room_deg)
    return there_deg


def _along(arm: Arm, flange_from_camera: Transform, here_deg: Joints, axis: str, direction: int) -> Joints:
    """Return joint angles farther along the camera's line or turn. The step is so short that a straight motion in
    joint space stays close to the line."""
    start = forward(arm, here_deg) @ flange_from_camera
    part = 1.0
    while part * _STEP_MM >= _LEAST_MM:
        there_deg = _posture_at(arm, flange_from_camera, start, here_deg, axis, direction * part)
        if there_deg is not None:
            turns = here_deg + np.linspace(0.0, 1.0, 9)[1:-1, None] * (there_deg - here_deg)
            cameras = link_frames(arm, turns)[:, -1] @ flange_from_camera
            ends = [
                (frame @ flange_from_camera)[:3, 3] for frame in link_frames(arm, [here_deg, there_deg])[:, -1]
            ]
            if (
                np.abs(there_deg - here_deg).max() <= _MOST_TURN_DEG
                and _off_line_mm(cameras[:, :3, 3], *ends) <= _OFF_LINE_MM
            ):
                return there_deg
        part /= 2.0
    raise InputError(f"the camera cannot go on along {axis}: out of reach, at a limit, or near a singularity")


def _posture_at(
    arm: Arm, flange_from_camera: Transform, start: Transform, here_deg: Joints, axis: str, amount: float
) -> Joints | None:
    unit = np.eye(3)["xyz".index(axis[-1])]
    goal = start.copy()
    if axis.startswith("r"):
        goal[:3, :3] = Rotation.from_rotvec(np.radians(amount * _STEP_DEG) * unit).as_matrix() @ start[:3, :3]
    else:
        goal[:3, 3] += amount * _STEP_MM * unit
    postures = postures_of(arm, goal @ inverse(flange_from_camera))
    return nearest(arm, postures, here_deg) if len(postures) else None


def _off_line_mm(
    points_mm: NDArray[np.float64], from_mm: NDArray[np.float64], to_mm: NDArray[np.float64]
) -> float:
    """Return the greatest distance of points [n, 3] from a segment's line. If the segment has no length, it is the
    distance from its start."""
    along = to_mm - from_mm
    length = float(np.linalg.norm(along))
    off = points_mm - from_mm
    if length > _LEAST_MM / 10:
        off = off - np.outer(off @ along / length**2, along)
    return float(np.linalg.norm(off, axis=1).max())


def _clear_part(bodies: CellBodies, here_deg: Joints, there_deg: Joints) -> Joints:
    """Return the farthest posture on the way that is reached without contact, less a little, so that the arm can
    go on from there. If something is too close already, return a posture that leads away from it."""
    if bodies.tightest_mm(here_deg[None])[0] < 0.0:
        return _outwards(bodies, here_deg, there_deg)
    if bodies.is_clear(here_deg, there_deg):
        return there_deg
    clear_share, blocked_share = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (clear_share + blocked_share)
        if bodies.is_clear(here_deg, here_deg + middle * (there_deg - here_deg)):
            clear_share = middle
        else:
            blocked_share = middle
    turn_deg = np.abs(there_deg - here_deg)
    clear_share -= _KEPT_MM / float(np.radians(turn_deg) @ bodies.reach_mm)
    if clear_share * float(turn_deg.max()) < _LEAST_DEG:
        raise InputError(str(bodies.contact_on_the_way(here_deg, there_deg)))
    part_deg: Joints = here_deg + clear_share * (there_deg - here_deg)
    return part_deg


def _outwards(bodies: CellBodies, here_deg: Joints, there_deg: Joints) -> Joints:
    """Return the goal. Raises InputError if, on the way, a pair that is too close comes closer, or another pair
    becomes too close."""
    along_deg = here_deg + np.linspace(0.0, 1.0, _SAMPLES)[:, None] * (there_deg - here_deg)
    closer = [np.diff(margins).min() < -_ROUNDING_MM for margins in bodies.margins(along_deg, 0.0).values()]
    if any(closer):
        raise InputError(f"{bodies.contacts(here_deg)[0]}; from here the arm moves only away from it")
    return there_deg
