"""Ways of the arm among views whose order is not known beforehand.

Each view has one posture, which depends on no other view, and a checked path from home. So there is a way from
each view to each other: at worst back home, and from there. The time of that way bounds the way that is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coupole.errors import PreflightRefused
from coupole.motion import singularities
from coupole.motion.collisions import CellBodies
from coupole.motion.itinerary import POSTURE_COST_S, Itinerary, Visit, arm_of, postures_of, rig_refusals
from coupole.motion.path_planner import Joints, Leg, PathPlanner
from coupole.plan.rig import Rig
from coupole.plan.schedule import ViewPose


class WaysFromHome:
    """Postures of views, and the ways between them. The same rig and bodies give the same ways."""

    def __init__(self, rig: Rig, bodies: CellBodies | None) -> None:
        """Collisions are ignored if there are no `bodies`: all motions are then straight."""
        self._rig, self._bodies, self._arm = rig, bodies, arm_of(rig)
        self._home_deg = np.asarray(rig.motion.home_joints_deg, dtype=np.float64)
        self._planner = PathPlanner(self._arm, bodies, [rig.motion.home_joints_deg])
        self._visits: dict[str, Visit | str] = {}

    def itinerary(self, views: Sequence[ViewPose]) -> Itinerary:
        """Return the visits of views, each from home, in the order as given."""
        visits_or_reasons = [self._visit_or_reason(view) for view in views]
        return Itinerary(
            tuple(visit if isinstance(visit, Visit) else None for visit in visits_or_reasons),
            (*rig_refusals(self._rig), *(reason for reason in visits_or_reasons if isinstance(reason, str))),
            tuple(number for number, visit in enumerate(visits_or_reasons) if isinstance(visit, Visit)),
            is_from_home=True,
        )

    def visit(self, view: ViewPose) -> Visit:
        """Return the visit of a view from home. Raises PreflightRefused if there is none."""
        visit = self._visit_or_reason(view)
        if isinstance(visit, str):
            raise PreflightRefused([visit])
        return visit

    def leg(self, start_deg: Joints, view: ViewPose) -> Leg:
        """Return the leg to a view from the posture of another view, or from where the arm is. If that is another
        view, it takes at most as long as the way back home and the view's way from home."""
        goal_deg, leg = self.visit(view).joints_deg, self._planner.leg(start_deg, self.visit(view).joints_deg)
        back, there = self._planner.leg(start_deg, self._home_deg), self._planner.leg(self._home_deg, goal_deg)
        over_home_s = back.duration_s + there.duration_s
        if back.contact is None and there.contact is None and over_home_s < leg.duration_s:
            return Leg((*back.waypoints, *there.waypoints), over_home_s)
        return leg

    def least_s(self, start_deg: Joints, views: Sequence[ViewPose]) -> NDArray[np.float64]:
        """[n] lower bounds of the legs' times from a posture to views."""
        goals_deg = [self.visit(view).joints_deg for view in views]
        seconds: NDArray[np.float64] = self._planner.straight_s(np.stack([start_deg, *goals_deg]))[0, 1:]
        return seconds

    def _visit_or_reason(self, view: ViewPose) -> Visit | str:
        if view.name not in self._visits:
            self._visits[view.name] = self._find(view)
        return self._visits[view.name]

    def _find(self, view: ViewPose) -> Visit | str:
        """Return the visit in the posture that is reached soonest, or the reason why there is no visit."""
        postures, why_not = postures_of(view, self._rig, self._bodies)
        if why_not:
            return f"view {view.name}: {why_not}"
        least_s = self._planner.straight_s(np.concatenate([self._home_deg[None], postures]))[0, 1:]
        cost_s = least_s + POSTURE_COST_S * singularities.posture_cost(self._arm, postures)
        contact = None
        for number in np.argsort(cost_s, kind="stable"):
            leg = self._planner.leg(self._home_deg, postures[number])
            if leg.contact is None:
                return Visit(postures[number], leg)
            contact = contact or leg.contact
        return f"view {view.name}: no path to it was found from home: {contact}"
