"""The invariant of every answer, whichever packets came in:

From one answer to the next, the target of the corrections moves by at most the highest speed times the cycle. If
the commanded axes advance, this step differs from the previous one by at most the highest acceleration times the
cycle squared. The only other allowed change is to no step at all.

A place is the axes, or the flange's pose. The trajectory obeys this invariant by construction. This module checks
the invariant again on the answer that is about to be sent, from the sent numbers alone. So no earlier mistake can
reach the arm. Limits of the pose follow from the limits of the axes: no point of the arm moves faster than its
reach times the sum of all axis speeds.
"""

from __future__ import annotations

from math import degrees, hypot, radians

from coupole.wrist_lengths import WristLengths

Six = tuple[float, ...]

_ROUNDING = 1e-5
"""Allowance for rounding. Numbers on the wire have six decimals; a step and its change contain up to four of
them."""
_SLACK = 1.001
_POSE_SLACK = 2.0
"""Factor of allowance for the change of a pose's step: the angles A, B, C of a turn differ from its rotation
vector in second order."""


class StepBounds:
    """Checks the invariant. `step` is six numbers: degrees of the axes, or mm and degrees of the flange."""

    def __init__(
        self, corrects: str, cycle_s: float, velocity_deg_s: Six, acceleration_deg_s2: Six, geometry: WristLengths
    ) -> None:
        if corrects == "axes":
            self.farthest: Six = tuple(_SLACK * speed * cycle_s + _ROUNDING for speed in velocity_deg_s)
            self._change: Six = tuple(_SLACK * a * cycle_s**2 + 2 * _ROUNDING for a in acceleration_deg_s2)
        else:
            turn = sum(map(radians, velocity_deg_s)) * cycle_s
            change = sum(map(radians, acceleration_deg_s2)) * cycle_s**2 + turn**2
            self.farthest = _pose_bounds(_SLACK * turn, geometry)
            self._change = _pose_bounds(_POSE_SLACK * change, geometry)
        self._last: Six = (0.0,) * 6
        """The step of the last cycle in which the axes advanced."""

    def at_rest(self) -> None:
        """Note that the arm has halted. The next advance begins from rest."""
        self._last = (0.0,) * 6

    def violation(self, step: Six, *, advances: bool) -> str:
        """Return why an answer with this step must not be sent, or ""."""
        for number, (length, farthest) in enumerate(zip(step, self.farthest, strict=True), start=1):
            if not abs(length) <= farthest:
                return f"correction {number} would step by {length:.4f} in one cycle, the limit is {farthest:.4f}"
        if not advances:
            return ""
        last, self._last = self._last, step
        for number, (length, before, most) in enumerate(zip(step, last, self._change, strict=True), start=1):
            if not abs(length - before) <= most:
                change = length - before
                return f"the step of correction {number} would change by {change:.4f}, the limit is {most:.4f}"
        return ""


def follow_bounds(corrects: str, follow_deg: float, geometry: WristLengths) -> Six:
    """Return the greatest allowed distance of a place from another, if each axis is within `follow_deg`."""
    return (follow_deg,) * 6 if corrects == "axes" else _pose_bounds(6.0 * radians(follow_deg), geometry)


def _pose_bounds(turn: float, geometry: WristLengths) -> Six:
    """Return the largest step of a pose while all axes together turn by `turn` radians."""
    reach_mm = geometry.a1_mm + abs(geometry.b_mm) + geometry.c2_mm + hypot(geometry.a2_mm, geometry.c3_mm)
    return ((reach_mm + geometry.c4_mm) * turn + _ROUNDING,) * 3 + (degrees(turn) + _ROUNDING,) * 3
