"""Rigid transforms (4x4 float64, millimetres and degrees), and a selection of points that are far apart.

A transform is named after its two frames: `base_from_camera` maps camera coordinates to base coordinates. KUKA's
A, B, C are Euler angles about z, y', x'': R = Rz(A) Ry(B) Rx(C). The camera frame has x to the right of the image,
y down, z forward (the OpenCV convention).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

Transform = NDArray[np.float64]
"""4x4 matrix with the last row 0 0 0 1; the translation is in mm."""

_GIMBAL_LOCK = 1e-9


def rotation_from_abc(a_deg: float, b_deg: float, c_deg: float) -> NDArray[np.float64]:
    """Return the 3x3 rotation for KUKA's A, B, C in degrees: Rz(A) Ry(B) Rx(C)."""
    a, b, c = np.radians([a_deg, b_deg, c_deg])
    ca, sa, cb, sb, cc, sc = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(c), np.sin(c)
    return np.array(
        [
            [ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc],
            [sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc],
            [-sb, cb * sc, cb * cc],
        ]
    )


def abc_from_rotation(rotation: ArrayLike) -> tuple[float, float, float]:
    """Return KUKA's A, B, C in degrees for a 3x3 rotation. At gimbal lock (B = +-90), C is 0."""
    r = np.asarray(rotation, dtype=np.float64)
    cos_b = float(np.hypot(r[0, 0], r[1, 0]))
    b = np.arctan2(-r[2, 0], cos_b)
    if cos_b < _GIMBAL_LOCK:
        a, c = np.arctan2(-r[0, 1], r[1, 1]), 0.0
    else:
        a, c = np.arctan2(r[1, 0], r[0, 0]), np.arctan2(r[2, 1], r[2, 2])
    return float(np.degrees(a)), float(np.degrees(b)), float(np.degrees(c))


def transform(translation_mm: ArrayLike = (0.0, 0.0, 0.0), abc_deg: ArrayLike = (0.0, 0.0, 0.0)) -> Transform:
    """Return the 4x4 transform for a translation in mm and KUKA's A, B, C in degrees."""
    t = np.eye(4)
    a, b, c = (float(v) for v in np.asarray(abc_deg, dtype=np.float64))
    t[:3, :3] = rotation_from_abc(a, b, c)
    t[:3, 3] = np.asarray(translation_mm, dtype=np.float64)
    return t


def inverse(a_from_b: Transform) -> Transform:
    """Return `b_from_a`, by transposition, which is exact for rigid transforms."""
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = a_from_b[:3, :3].T
    b_from_a[:3, 3] = -a_from_b[:3, :3].T @ a_from_b[:3, 3]
    return b_from_a


def apply(a_from_b: Transform, points_b: ArrayLike) -> NDArray[np.float64]:
    """Map points [..., 3], mm, from frame b to frame a."""
    result: NDArray[np.float64] = np.asarray(points_b, dtype=np.float64) @ a_from_b[:3, :3].T + a_from_b[:3, 3]
    return result


def direction(azimuth_deg: float, elevation_deg: float) -> NDArray[np.float64]:
    """Return the unit vector [3] of a direction, degrees. The azimuth is about z from x towards y, the elevation
    is above the xy plane."""
    az, el = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])


def look_at(
    target_mm: ArrayLike, distance_mm: float, azimuth_deg: float, elevation_deg: float, roll_deg: float = 0.0
) -> Transform:
    """Return `support_from_camera` for a camera whose projection centre is `distance_mm` from the target.

    The camera is in direction (azimuth, elevation) from the target and looks at it. The image is upright: the
    support's z axis points up in it. For a camera straight above, the direction away from its azimuth points up
    instead. `roll_deg` turns the camera about its optical axis, clockwise as seen from behind it.
    """
    towards_camera = direction(azimuth_deg, elevation_deg)
    forward = -towards_camera
    az = np.radians(azimuth_deg)
    right = np.array([-np.sin(az), np.cos(az), 0.0])
    down = np.cross(forward, right)
    roll = np.radians(roll_deg)
    support_from_camera = np.eye(4)
    support_from_camera[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    support_from_camera[:3, 1] = -np.sin(roll) * right + np.cos(roll) * down
    support_from_camera[:3, 2] = forward
    support_from_camera[:3, 3] = np.asarray(target_mm, dtype=np.float64) + distance_mm * towards_camera
    return support_from_camera


def farthest_first(points: ArrayLike, first: int) -> Iterator[tuple[int, float]]:
    """Yield the indices of points [n, d] with a distance. The first index is `first`, with an infinite distance.
    Each further point is the one that is farthest from all points before it, and its distance is the distance from
    these points. Among equal points the lowest index comes first.
    """
    points_array = np.asarray(points, dtype=np.float64)
    index, distance = first, np.inf
    nearest = np.full(len(points_array), np.inf)
    for _ in range(len(points_array)):
        yield index, float(distance)
        nearest = np.minimum(nearest, np.linalg.norm(points_array - points_array[index], axis=1))
        index = int(np.argmax(nearest))
        distance = nearest[index]


def rotation_angle_deg(a_from_b: Transform, a_from_c: Transform) -> float:
    """Return the angle in degrees between the orientations of frames b and c. It is accurate also near 0."""
    r = a_from_b[:3, :3].T @ a_from_c[:3, :3]
    sine = 0.5 * np.linalg.norm([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    return float(np.degrees(np.arctan2(sine, (np.trace(r) - 1.0) / 2.0)))
