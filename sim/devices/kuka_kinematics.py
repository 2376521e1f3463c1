"""The stand-in's arm model: a joint chain from KUKA's drawing of the KR10 R1100 sixx.

Written independently of `coupole.kinematics`, so that each checks the other. Millimetres and degrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform
from sim.devices import newton
from sim.strangers.arm_stranger import NO_STRANGER, ArmStranger

_CHAIN = (
    ((0.0, 0.0, 400.0), (0.0, 0.0, -1.0)),
    ((25.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((560.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, 35.0), (-1.0, 0.0, 0.0)),
    ((515.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((80.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
)
"""Origin of each joint in the frame of the previous link, and its axis of rotation."""
AXIS_LIMITS_DEG = (
    (-170.0, 170.0),
    (-190.0, 45.0),
    (-120.0, 156.0),
    (-185.0, 185.0),
    (-120.0, 120.0),
    (-350.0, 350.0),
)
AXIS_SPEEDS_DEG_S = (300.0, 225.0, 225.0, 381.0, 311.0, 492.0)


def flange_pose(joints_deg: Sequence[float]) -> Transform:
    """`base_from_flange` of six joint angles."""
    return _chain(joints_deg)[0]


def joint_origins_mm(joints_deg: Sequence[float]) -> NDArray[np.float64]:
    """[6, 3] the joints' origins in the base frame."""
    return _chain(joints_deg)[1]


def _chain(joints_deg: Sequence[float]) -> tuple[Transform, NDArray[np.float64], NDArray[np.float64]]:
    """`base_from_flange`, and in the base frame the joints' origins in mm and their axes, each [6, 3]."""
    origins_mm, axes = np.zeros((6, 3)), np.zeros((6, 3))
    base_from_link = np.eye(4)
    for k, (angle_deg, (origin_mm, axis)) in enumerate(zip(joints_deg, _CHAIN, strict=True)):
        base_from_link[:3, 3] += base_from_link[:3, :3] @ origin_mm
        origins_mm[k], axes[k] = base_from_link[:3, 3], base_from_link[:3, :3] @ axis
        base_from_link[:3, :3] = base_from_link[:3, :3] @ turn(axis, angle_deg)
    base_from_link[:3, :3] = base_from_link[:3, :3] @ turn((0.0, 1.0, 0.0), 90.0)
    return base_from_link, origins_mm, axes


def joints_near(base_from_flange: Transform, joints_deg: Sequence[float]) -> tuple[float, ...] | None:
    """`sim.devices.newton.joints_near` for this arm."""
    return newton.joints_near(_chain, base_from_flange, joints_deg)


class ErrorSettings(Protocol):
    """Settings of a simulated controller that state its arm's errors."""

    @property
    def seed(self) -> int: ...
    @property
    def repeatability_um(self) -> float: ...
    @property
    def repeatability_deg(self) -> float: ...
    @property
    def absolute_mm(self) -> float: ...
    @property
    def absolute_deg(self) -> float: ...


@dataclass(frozen=True)
class PoseErrors:
    """Difference between the true flange pose and the controller's; reproducible by seed.

    Standard deviations per coordinate. An arm's absolute errors are drawn once: the flange's position in base
    coordinates, and the zero of each axis, which gives an error that varies over the cell. Errors of repeatability
    are drawn for each stop: position, and a rotation vector in the flange's coordinates.
    """

    seed: int
    repeatability_um: float
    repeatability_deg: float
    absolute_mm: float
    absolute_deg: float
    stranger: ArmStranger = NO_STRANGER
    """Errors that depend on the arm's present and previous place."""

    @classmethod
    def of(cls, settings: ErrorSettings, stranger: ArmStranger) -> PoseErrors:
        """The errors that a controller's settings state."""
        return cls(
            settings.seed,
            settings.repeatability_um,
            settings.repeatability_deg,
            settings.absolute_mm,
            settings.absolute_deg,
            stranger,
        )

    def base_error_mm(self) -> NDArray[np.float64]:
        """[3]."""
        return np.random.default_rng((self.seed, 0)).normal(0.0, 1.0, 3) * self.absolute_mm

    def axis_zero_error_deg(self) -> NDArray[np.float64]:
        """[6]."""
        return np.random.default_rng((self.seed, 1)).normal(0.0, 1.0, 6) * self.absolute_deg

    def true_flange_pose(
        self, joints_deg: Sequence[float], stop: int, came_from_deg: Sequence[float] | None = None
    ) -> Transform:
        """Return the true `base_from_flange` at the reported angles, in the arm's stop number `stop`.
        `came_from_deg` are the previous angles; None: the same angles."""
        error_deg = self.axis_zero_error_deg()
        if self.stranger != NO_STRANGER:
            flange, origins_mm, axes = _chain(joints_deg)
            origins_mm = np.vstack([origins_mm, flange[:3, 3]])
            came_from_deg = joints_deg if came_from_deg is None else came_from_deg
            error_deg = error_deg + self.stranger.errors_deg(joints_deg, came_from_deg, origins_mm, axes)
        base_from_flange = flange_pose((np.array(joints_deg) + error_deg).tolist())
        random = np.random.default_rng((self.seed, 2, stop))
        stop_error_mm = random.normal(0.0, 1.0, 3) * self.repeatability_um / 1e3
        turned_deg = random.normal(0.0, 1.0, 3) * self.repeatability_deg
        base_from_flange[:3, 3] += self.base_error_mm() + stop_error_mm
        angle_deg = float(np.linalg.norm(turned_deg))
        if angle_deg > 0.0:
            base_from_flange[:3, :3] = base_from_flange[:3, :3] @ turn(
                (turned_deg / angle_deg).tolist(), angle_deg
            )
        return base_from_flange


def turn(axis: Sequence[float], angle_deg: float) -> NDArray[np.float64]:
    """3x3 rotation about a unit axis by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = math.radians(angle_deg)
    rotation: NDArray[np.float64] = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    return rotation
