"""Lengths and joint conventions of arms with a spherical wrist, for processes that do not import numpy."""

from __future__ import annotations

from typing import NamedTuple


class WristLengths(NamedTuple):
    """Ortho-parallel basis and spherical wrist (OPW): axes 2 and 3 are parallel, axes 4, 5 and 6 meet in a point.

    The lengths are defined by Brandstoetter, Angerer, Hofbaur: "An Analytical Solution of the Inverse Kinematics
    Problem of Industrial Serial Manipulators with an Ortho-parallel Basis and a Spherical Wrist" (2014), fig. 2.
    The angles there are the joints' angles, negated where `flip_axes` is True, minus `offsets_deg`.
    """

    a1_mm: float
    a2_mm: float
    b_mm: float
    c1_mm: float
    c2_mm: float
    c3_mm: float
    c4_mm: float
    offsets_deg: tuple[float, ...]
    flip_axes: tuple[bool, ...]
    """True for an axis that turns opposite to OPW's sense."""
