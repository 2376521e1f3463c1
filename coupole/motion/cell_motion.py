"""The arm in its cell: bodies, paths and occlusion, computed on first use and cached."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coupole.motion.collisions import CellBodies
from coupole.motion.itinerary import Itinerary, bodies_of, plan_itinerary
from coupole.motion.occlusion import Occlusion, Occlusions, occlusions_of
from coupole.motion.ways_from_home import WaysFromHome
from coupole.plan.cell import Cell
from coupole.plan.schedule import ViewPose

_SAME_PLACE_DEG = 1e-3


class CellMotion:
    """Bodies, paths and occlusion of a cell with an object, for all views of a plan."""

    def __init__(
        self,
        cell: Cell,
        object_corners_mm: NDArray[np.float64],
        targets_mm: Sequence[Sequence[float]],
        order: Literal["fastest", "as_written"],
        *,
        is_order_open: bool = False,
    ) -> None:
        """`object_corners_mm` [triangles, 3, 3] and `targets_mm` are in the support frame; the targets replace an
        object without a mesh. `is_order_open`: views and their order are chosen in the run, so that
        `planned_itinerary` has a way from home to each."""
        self._cell, self._object_corners_mm, self._order = cell, object_corners_mm, order
        self._targets_mm, self._is_order_open = targets_mm, is_order_open
        self._planned: list[tuple[tuple[str, ...], Sequence[float], Itinerary]] = []

    @cached_property
    def bodies(self) -> CellBodies:
        """Arm, tool and all obstacles."""
        cell = self._cell
        return bodies_of(cell.rig, cell.leds, self._object_corners_mm, cell.link_meshes, cell.files)

    @cached_property
    def occlusions(self) -> Occlusions:
        """Occlusion of LEDs by the object, and by arm and tool in each posture."""
        targets = self._targets_mm or [(0.0, 0.0, 0.0)]
        return occlusions_of(self._cell.rig, self._cell.leds, self._object_corners_mm, targets)

    def occluded_leds(self, occlusion: Occlusion) -> list[int]:
        """Return ids of the LEDs that light nothing that a view shows."""
        return [int(led) for led in self._cell.leds.ids[occlusion.occluded_leds()]]

    @cached_property
    def ways(self) -> WaysFromHome:
        """Ways among views whose order is not known beforehand."""
        return WaysFromHome(self._cell.rig, self.bodies)

    def planned_itinerary(self, views: Sequence[ViewPose], *, paths: bool = True) -> Itinerary:
        """Return the itinerary that is planned before a run, from home. Without `paths`, collisions are not
        checked."""
        rig = self._cell.rig
        if self._is_order_open:
            return (self.ways if paths else WaysFromHome(rig, None)).itinerary(views)
        if paths:
            return self.itinerary(views, rig.motion.home_joints_deg)
        return plan_itinerary(views, rig, None, rig.motion.home_joints_deg, self._order)

    def itinerary(self, views: Sequence[ViewPose], start_deg: Sequence[float]) -> Itinerary:
        """Return collision-free paths to views from the arm's posture. Paths are cached: if the arm is at home,
        preflight's paths from home are used again.
        """
        names = tuple(view.name for view in views)
        for planned_names, planned_deg, itinerary in self._planned:
            if planned_names == names and np.allclose(planned_deg, start_deg, rtol=0, atol=_SAME_PLACE_DEG):
                return itinerary
        itinerary = plan_itinerary(views, self._cell.rig, self.bodies, start_deg, self._order)
        self._planned.append((names, tuple(start_deg), itinerary))
        return itinerary
