"""Describes a motion of the camera in words and an arrow, for a person at the cell."""

from __future__ import annotations

import numpy as np

from coupole.geometry import Transform, inverse

_LEAST_MM = 5.0
_LEAST_SHARE = 0.3
"""A component smaller than this share of the whole motion is not named."""
_ARROWS = "→↗↑↖←↙↓↘"


def described_motion(base_from_support: Transform, before: Transform, after: Transform) -> str:
    """Describe the motion from one `base_from_camera` to another.

    If the lens moves, the text gives its way in the support frame, with an arrow as seen from above (x to the
    right, y up the page). If the lens stays where it is, the text gives the sense in which the camera turns, as
    seen from behind.
    """
    support_from_base = inverse(base_from_support)
    way_mm = support_from_base[:3, :3] @ (after[:3, 3] - before[:3, 3])
    if np.linalg.norm(way_mm) < _LEAST_MM:
        return _described_turn(before, after)
    length_mm = float(np.linalg.norm(way_mm))
    parts = []
    if np.linalg.norm(way_mm[:2]) >= _LEAST_SHARE * length_mm:
        azimuth_deg = float(np.degrees(np.arctan2(way_mm[1], way_mm[0]))) % 360.0
        arrow = _ARROWS[round(azimuth_deg / 45.0) % 8]
        parts.append(
            f"{np.linalg.norm(way_mm[:2]):.0f} mm towards azimuth {azimuth_deg:.0f} deg of the support "
            f"({arrow} seen from above, the support's x axis to the right)"
        )
    if abs(way_mm[2]) >= _LEAST_SHARE * length_mm:
        parts.append(f"{abs(way_mm[2]):.0f} mm {'up ⇧' if way_mm[2] > 0 else 'down ⇩'}")
    return f"The camera moves {' and '.join(parts)}."


def _described_turn(before: Transform, after: Transform) -> str:
    turn = before[:3, :3].T @ after[:3, :3]
    rotation = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle_deg = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))))
    senses = {
        2: ("clockwise ↻, seen from behind it", "counter-clockwise ↺, seen from behind it"),
        1: ("its lens turns to its own right", "its lens turns to its own left"),
        0: ("its lens turns up", "its lens turns down"),
    }
    main = int(np.argmax(np.abs(rotation)))
    return f"The camera turns in place by {angle_deg:.1f} deg: {senses[main][0 if rotation[main] > 0 else 1]}."
