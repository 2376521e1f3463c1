"""What corrections cannot bring about, known before anything moves: the controller would stop RSI on the way."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.kinematics import Arm, forward
from drivers.kuka.rsi.settings import Settings

_STEP_DEG = 2.0
"""No axis turns farther between two checked places; between them a line bulges by about a millimetre."""
_STARTS = 9
"""Places on the way to the last target that a new motion may set out from."""


def correction_violations(
    settings: Settings, arm: Arm, start_deg: ArrayLike, on_the_way_deg: ArrayLike, target_deg: ArrayLike
) -> str:
    """Why a straight motion of the axes to `target_deg` [6] cannot be made, as a phrase for messages; empty if it
    can. `start_deg` [6] is where RSI was started, `on_the_way_deg` [1 or 2, 6] where the motion sets out from: one
    place, or any between two."""
    start, target = np.asarray(start_deg, dtype=np.float64), np.asarray(target_deg, dtype=np.float64)
    if settings.corrects == "axes":
        return "; ".join(
            f"A{axis} would be {away:.3f} deg from where RSI was started, {limit:g} deg are allowed"
            for axis, (away, limit) in enumerate(zip(target - start, settings.most_correction_deg, strict=True), 1)
            if abs(away) > limit
        )
    ways = np.concatenate([_way(place, target) for place in _places(np.asarray(on_the_way_deg, dtype=np.float64))])
    return _too_far(settings, arm, start, ways) or _singular(settings, ways)


def _places(on_the_way_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    if len(on_the_way_deg) == 1:
        return on_the_way_deg
    shares = np.linspace(0.0, 1.0, _STARTS)[:, None]
    places: NDArray[np.float64] = (1.0 - shares) * on_the_way_deg[0] + shares * on_the_way_deg[1]
    return places


def _way(from_deg: NDArray[np.float64], to_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axes [n, 6] along the line."""
    count = int(np.ceil(np.abs(to_deg - from_deg).max() / _STEP_DEG)) + 1
    return np.linspace(from_deg, to_deg, max(2, count))


def _too_far(settings: Settings, arm: Arm, start_deg: NDArray[np.float64], ways_deg: NDArray[np.float64]) -> str:
    start, poses = forward(arm, start_deg), forward(arm, ways_deg)
    away_mm = float(np.linalg.norm(poses[:, :3, 3] - start[:3, 3], axis=1).max())
    if away_mm > settings.pose_correction_mm:
        return (
            f"the flange would come {away_mm:.0f} mm from where RSI was started, "
            f"{settings.pose_correction_mm:g} mm are allowed"
        )
    traces = np.einsum("nij,ij->n", poses[:, :3, :3], start[:3, :3])
    turned_deg = float(np.degrees(np.arccos(np.clip((traces.min() - 1.0) / 2.0, -1.0, 1.0))))
    if turned_deg > settings.pose_correction_deg:
        return (
            f"the flange would be turned by {turned_deg:.1f} deg from where RSI was started, "
            f"{settings.pose_correction_deg:g} deg are allowed"
        )
    return ""


def _singular(settings: Settings, ways_deg: NDArray[np.float64]) -> str:
    """Near a singularity the pose leaves axes open, or asks for any speed of them, and beyond it the controller's
    axes are not those that were planned."""
    arm, margin_deg = settings.wrist, settings.singularity_margin_deg
    theta = arm.theta(ways_deg)
    upper, fore = theta[:, 1], theta[:, 1] + theta[:, 2]
    elbow = theta[:, 2] + np.arctan2(arm.a2_mm, arm.c3_mm)
    out_mm = arm.c2_mm * np.sin(upper) + arm.c3_mm * np.sin(fore) + arm.a2_mm * np.cos(fore) + arm.a1_mm
    reach_mm = arm.c2_mm + np.hypot(arm.a2_mm, arm.c3_mm)
    for name, sines in (
        ("the wrist's (A5 at 0)", np.sin(theta[:, 4])),
        ("the elbow's (arm stretched out)", np.sin(elbow)),
        ("the shoulder's (wrist above axis 1)", out_mm / reach_mm),
    ):
        if np.abs(sines).min() < np.sin(np.radians(margin_deg)) or np.ptp(np.sign(sines)) > 0:
            return f"the motion comes within {margin_deg:g} deg of {name} singularity, where a pose is not enough"
    return ""
