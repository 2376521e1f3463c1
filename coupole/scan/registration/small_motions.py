"""Rigid motions [..., 4, 4] in mm and their small steps [..., 6]: translation in mm, then rotation in rad, both in
the target frame of a motion (from the left)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from coupole.scan.registration.viewpoint import Floats


def inverse_of(motion: Floats) -> Floats:
    """The inverse of a rigid motion [4, 4]."""
    back = np.eye(4)
    back[:3, :3] = motion[:3, :3].T
    back[:3, 3] = -motion[:3, :3].T @ motion[:3, 3]
    return back


def moved_points(motion: Floats, points_mm: Floats) -> Floats:
    """Points [n, 3] after a motion."""
    return np.asarray(points_mm @ motion[:3, :3].T + motion[:3, 3])


def stepped_motion(motion: Floats, step: Floats, pivot_mm: Floats) -> Floats:
    """Return a motion [4, 4] after a step [6] about a point of its target frame."""
    turn = Rotation.from_rotvec(step[3:]).as_matrix()
    new_motion = np.eye(4)
    new_motion[:3, :3] = turn @ motion[:3, :3]
    new_motion[:3, 3] = turn @ (motion[:3, 3] - pivot_mm) + pivot_mm + step[:3]
    return new_motion


def step_between(before: Floats, after: Floats, pivot_mm: Floats) -> Floats:
    """Return the step [6] about a point from one motion to another."""
    turn = after[:3, :3] @ before[:3, :3].T
    rest = after[:3, 3] - pivot_mm - turn @ (before[:3, 3] - pivot_mm)
    return np.concatenate([rest, Rotation.from_matrix(turn).as_rotvec()])


def displacement_mm(first_motion: Floats, second_motion: Floats, points_mm: Floats) -> float:
    """Return the root mean square distance between the positions of points [n, 3] after two motions."""
    apart = points_mm @ (first_motion - second_motion)[:3, :3].T + (first_motion - second_motion)[:3, 3]
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


def motion_of_points(from_mm: Floats, to_mm: Floats) -> Floats:
    """Return the 4x4 transform that maps points [n, 3] to others by least squares."""
    middle_from, middle_to = from_mm.mean(axis=0), to_mm.mean(axis=0)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.align_vectors(to_mm - middle_to, from_mm - middle_from)[0].as_matrix()
    motion[:3, 3] = middle_to - motion[:3, :3] @ middle_from
    return motion
