"""Distances between the arm and the other bodies of the cell, and the clearances to keep.

The arm is a set of capsules that enclose its links, or meshes of the links themselves; the camera and the space
for its cables are capsules too. Obstacles are the object (its scanned mesh), the support disk, the dome seen from
inside, and keep-out volumes. All distances are conservative. Bodies are unions of spheres (`motion.sphere_tree`)
that enclose the real bodies. No contact between two checked postures of a motion is missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.geometry import Transform, inverse
from coupole.intake.input_files import InputFiles
from coupole.motion.bodies import (
    Body,
    Capsule,
    bodies_of_capsules,
    bodies_of_meshes,
    capsules_of,
    part_apart,
    reach_mm,
)
from coupole.motion.sphere_tree import MESH_STEP_MM, Floats, Spheres, sphere_trees_of
from coupole.plan.arm_description import TOOL, ArmDescription

_NEIGHBOURLY_MM = 25.0
"""Distance in the postures `near_by_design_deg`. Parts of a body that stay farther away than this are still
checked."""


@dataclass(frozen=True)
class Contact:
    """Two bodies that are too close."""

    body: str
    other_name: str
    distance_mm: float
    """A conservative distance; negative if the bodies overlap."""
    required_mm: float

    def __str__(self) -> str:
        how = f"{self.distance_mm:.0f} mm from" if self.distance_mm > 0 else "inside"
        return f"{self.body} would be {how} {self.other_name}; {self.required_mm:.3g} mm must be kept"


@dataclass(frozen=True)
class Clearances:
    """Distances that must be kept, mm."""

    object_mm: float = 50.0
    support_mm: float = 10.0
    dome_mm: float = 20.0
    self_mm: float = 0.0
    keep_out_mm: float = 0.0
    path_tolerance_mm: float = 0.0
    """Largest path deviation of the arm (`motion.path_deviation`). The clearance of every pair is at least as
    large as the approach of the pair under this deviation."""


@dataclass(frozen=True)
class Surroundings:
    """Obstacles around the arm, in the support frame."""

    base_from_support: Transform
    support_radius_mm: float
    dome_radius_mm: float
    dome_top_deg: float
    """Elevation above which the dome is open."""
    object_points_mm: NDArray[np.float64]
    """[n, 3] points on the object's surface. No point of the surface is farther than MESH_STEP_MM from one of
    them."""
    keep_out_spheres: tuple[tuple[str, tuple[float, float, float], float], ...] = ()
    keep_out_boxes: tuple[tuple[str, tuple[float, float, float], tuple[float, float, float]], ...] = ()


@dataclass(frozen=True)
class _Pair:
    """A body and its obstacle, which is a solid (`kind`, `figures`) or another body (`SHAPE`)."""

    body: Body
    other_name: str
    required_mm: float
    reach_mm: Floats
    kind: int
    figures: tuple[float, ...] = ()
    other_body: Body | None = None

    def contact(self, margin_mm: float) -> Contact:
        return Contact(self.body.name, self.other_name, float(margin_mm + self.required_mm), self.required_mm)


class CellBodies:
    """The arm and its obstacles.

    `link_meshes` is a folder with the links' meshes (`motion.bodies.bodies_of_meshes`), which then replace the
    capsules. Meshes fit more closely, but are slower to check. Raises InputError if they cannot be read.
    """

    def __init__(
        self,
        arm: ArmDescription,
        surroundings: Surroundings,
        tool: Sequence[Capsule],
        clearances: Clearances | None = None,
        link_meshes: Path | None = None,
        files: InputFiles | None = None,
    ) -> None:
        self._described, self._arm = arm, arm.arm
        self._around, self._keep = surroundings, clearances or Clearances()
        self._has_meshes = link_meshes is not None
        meshes = bodies_of_meshes(link_meshes, arm, files) if link_meshes else None
        self._links = meshes or bodies_of_capsules(capsules_of(arm))
        self._tools = bodies_of_capsules(tool)
        self._pairs = [*self._pairs_with_surroundings(), *self._pairs_of_the_arm()]

    @cached_property
    def reach_mm(self) -> Floats:
        """Greatest distance [6] of any point of arm and tool from each axis."""
        reach: Floats = np.max([reach_mm(self._arm, body) for body in (*self._links, *self._tools)], axis=0)
        return reach

    def margins(self, joints_deg: ArrayLike, far_mm: float = np.inf) -> dict[tuple[str, str], Floats]:
        """Return the distance minus clearance [n] of each pair of bodies at joint angles [n, 6], mm. It is never
        more than the true value, and at most `far_mm` (to save time)."""
        margins = self._margins(np.atleast_2d(np.asarray(joints_deg, dtype=np.float64)), far_mm)
        return {(pair.body.name, pair.other_name): margins[:, n] for n, pair in enumerate(self._pairs)}

    def tightest_mm(self, joints_deg: ArrayLike) -> Floats:
        """Return [n] the least of all margins if it is negative, otherwise 0, for joint angles [n, 6]."""
        tightest: Floats = self._margins(np.asarray(joints_deg, dtype=np.float64), 0.0).min(axis=1)
        return tightest

    def contacts(self, joints_deg: ArrayLike) -> list[Contact]:
        """Return the pairs that are too close in one posture [6], nearest first."""
        (margins,) = self._margins(np.asarray(joints_deg, dtype=np.float64)[None], 0.0)
        order = np.argsort(margins, kind="stable")
        return [self._pairs[n].contact(margins[n]) for n in order if margins[n] < 0.0]

    def is_clear(self, from_deg: Floats, to_deg: Floats) -> bool:
        """True if no pair comes too close on a straight motion in joint space."""
        from coupole.motion.distances import CLEAR, blocked_at

        return bool(blocked_at(self._model, from_deg, to_deg)[0] == CLEAR)

    def contact_on_the_way(self, from_deg: ArrayLike, to_deg: ArrayLike) -> Contact | None:
        """Return the first contact found on a straight motion in joint space; None if there is none."""
        from coupole.motion.distances import CLEAR, blocked_at

        start, end = np.asarray(from_deg, dtype=np.float64), np.asarray(to_deg, dtype=np.float64)
        pair, share, moved_mm = blocked_at(self._model, start, end)
        if pair == CLEAR:
            return None
        margin_mm = self._margins((start + share * (end - start))[None], np.inf)[0, pair]
        contact: Contact = self._pairs[pair].contact(margin_mm if margin_mm < 0.0 else margin_mm - moved_mm)
        return contact

    def _margins(self, joints_deg: Floats, far_mm: float) -> Floats:
        from coupole.motion.distances import margins_at

        margins: Floats = margins_at(self._model, joints_deg, float(far_mm))
        return margins

    # -- pairs that are checked -------------------------------------------------------------------------------

    def _pairs_with_surroundings(self) -> list[_Pair]:
        from coupole.motion.distances import BOX, DISK, DOME, SHAPE, SPHERE, SUPPORT_FRAME

        around, keep = self._around, self._keep
        top = np.radians(around.dome_top_deg)
        solids: list[tuple[str, float, int, tuple[float, ...]]] = [
            ("the support", keep.support_mm, DISK, (around.support_radius_mm,)),
            ("the dome", keep.dome_mm, DOME, (around.dome_radius_mm, float(np.sin(top)), float(np.cos(top)))),
        ]
        solids += [
            (f"keep-out `{name}`", keep.keep_out_mm, SPHERE, (*center, radius))
            for name, center, radius in around.keep_out_spheres
        ]
        solids += [
            (f"keep-out `{name}`", keep.keep_out_mm, BOX, (*low, *high))
            for name, low, high in around.keep_out_boxes
        ]
        points = around.object_points_mm
        shape = Body("the object", SUPPORT_FRAME, Spheres(points, np.full(len(points), MESH_STEP_MM)))
        pairs = []
        for body in (*self._tools, *self._links[:0:-1]):
            reach = reach_mm(self._arm, body)
            if len(points):
                required_mm = self._required_mm(keep.object_mm, reach)
                pairs.append(_Pair(body, shape.name, required_mm, reach, SHAPE, other_body=shape))
            pairs += [
                _Pair(body, name, self._required_mm(keep_mm, reach), reach, kind, figures)
                for name, keep_mm, kind, figures in solids
            ]
        return pairs

    def _pairs_of_the_arm(self) -> list[_Pair]:
        from coupole.motion.distances import SHAPE

        pairs = []
        kept_apart = {(pair.body, pair.other): pair.near_by_design_deg for pair in self._described.kept_apart}
        for body in (*self._tools, *self._links):
            kind = TOOL if body in self._tools else body.name
            for other_body in self._links:
                if (kind, other_body.name) not in kept_apart:
                    continue
                near_deg = kept_apart[kind, other_body.name]
                postures_deg = list(product(*near_deg)) if near_deg and self._drawn_large(kind) else []
                part = (
                    part_apart(self._arm, body, other_body, postures_deg, _NEIGHBOURLY_MM)
                    if postures_deg
                    else body
                )
                if part is not None:
                    reach = reach_mm(self._arm, part, from_link=other_body.link)
                    required_mm = self._required_mm(self._keep.self_mm, reach)
                    pairs.append(
                        _Pair(
                            part, f"the arm's {other_body.name}", required_mm, reach, SHAPE, other_body=other_body
                        )
                    )
        return pairs

    def _drawn_large(self, kind: str) -> bool:
        return kind == TOOL or not self._has_meshes

    def _required_mm(self, keep_mm: float, reach: Floats) -> float:
        """Return the clearance of a pair: the rig's clearance, but at least the distance by which the largest path
        deviation can bring the pair closer. `deviation_at_rest_mm` multiplies each axis' deviation by `reach_mm`;
        the pair moves by the deviation times its own reach."""
        share = np.divide(reach, self.reach_mm, out=np.zeros(6), where=self.reach_mm > 0.0)
        return max(keep_mm, self._keep.path_tolerance_mm * float(share.max()))

    @cached_property
    def _model(self) -> Any:
        """Return the pairs as arrays for the compiled functions."""
        from coupole.motion.distances import SUPPORT_FRAME, Model

        all_bodies = [body for pair in self._pairs for body in (pair.body, pair.other_body) if body is not None]
        bodies = list({id(body): body for body in all_bodies}.values())
        tree_of = {id(body): tree for tree, body in enumerate(bodies)}
        numbers, figures = [], np.zeros((len(self._pairs), 13))
        for row, pair in zip(figures, self._pairs, strict=True):
            obstacle = pair.other_body or pair.body
            on_link = pair.other_body.link if pair.other_body and pair.other_body.link != SUPPORT_FRAME else 0
            trees = tree_of[id(pair.body)], tree_of[id(obstacle)]
            numbers.append((trees[0], pair.body.link, pair.kind, trees[1], obstacle.link, on_link))
            row[0], row[1:7] = pair.required_mm, pair.reach_mm
            row[7 : 7 + len(pair.figures)] = pair.figures
        chain = self._arm.chain
        return Model(
            inverse(self._around.base_from_support),
            np.column_stack([chain.origins_mm, chain.senses, chain.axis_numbers]),
            np.array(chain.link_6_from_flange),
            *sphere_trees_of([body.spheres for body in bodies]),
            np.array(numbers),
            figures,
        )
