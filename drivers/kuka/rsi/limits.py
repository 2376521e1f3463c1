"""Limits of corrections. They are checked before a motion begins, because beyond them the controller would stop
RSI on the path."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.kinematics import Arm, forward
from drivers.kuka.rsi.settings import Settings

_STEP_DEG = 2.0
"""Largest axis step between two checked points of a path. Between such points a line bulges by about a
millimetre."""
_STARTS = 9
"""Number of checked starting points between the commanded axes and the last target, for a target that is given
during a motion."""


def correction_violations(
    settings: Settings, arm: Arm, start_deg: ArrayLike, on_the_way_deg: ArrayLike, target_deg: ArrayLike
) -> str:
    """Return why a straight motion in joint space to `target_deg` [6] is not possible, as text for messages;
    otherwise "".

    `start_deg` [6] are the axes where RSI was started. `on_the_way_deg` [1 or 2, 6] is the start of the motion:
    one point, or any point between two.
    """
    start, target = np.asarray(start_deg, dtype=np.float64), np.asarray(target_deg, dtype=np.float64)
    if settings.corrects == "axes":
        return "; ".join(
            f"A{axis} would be {away:.3f} deg from where RSI was started, {limit:g} deg are allowed"
            for axis, (away, limit) in enumerate(zip(target - start, settings.most_correction_deg, strict=True), 1)
            if abs(away) > limit
        )
    starts_deg = _places(np.asarray(on_the_way_deg, dtype=np.float64))
    paths_deg = np.concatenate([_path(place, target) for place in starts_deg])
    return _too_far(settings, arm, start, paths_deg) or _singular(settings, paths_deg)


def _places(on_the_way_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    if len(on_the_way_deg) == 1:
        return on_the_way_deg
    shares = np.linspace(0.0, 1.0, _STARTS)[:, None]
    places: NDArray[np.float64] = (1.0 - shares) * on_the_way_deg[0] + shares * on_the_way_deg[1]
    return places


def _path(from_deg: NDArray[np.float64], to_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axes [n, 6] along the line."""
    count = int(np.ceil(np.abs(to_deg - from_deg).max() / _STEP_DEG)) + 1
    return np.linspace(from_deg, to_deg, max(2, count))


def _too_far(settings: Settings, arm: Arm, start_deg: NDArray[np.float64], paths_deg: NDArray[np.float64]) -> str:
    start, poses = forward(arm, start_deg), forward(arm, paths_deg)
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


def _singular(settings: Settings, paths_deg: NDArray[np.float64]) -> str:
    """Return why paths come too near to a singularity. At a singularity a pose does not determine the axes, or
    needs unlimited axis speeds. Beyond it the controller may choose other axes than the planned ones.
    """
    arm, margin_deg = settings.wrist.lengths, settings.singularity_margin_deg
    theta = settings.wrist.theta(paths_deg)
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
            return (
                f"the motion comes within {margin_deg:g} deg of {name} singularity, where a pose does not "
                "determine the axes"
            )
    return ""
