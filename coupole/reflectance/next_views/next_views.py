"""Chooses the views of a run one after the other.

The best candidate has the largest expected decrease of the uncertainty in proportion to its cost. A view's cost is
the sum of its shares of the plan's limits: one of the number of views, and, where they are limited, of frames,
seconds and light. Among candidates that are nearly as good, the arm goes to the nearest one.

The same plan and the same earlier views give the same choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.plan.plan import EnoughViews
from coupole.plan.schedule import Schedule
from coupole.plan.view_choices import ChosenView
from coupole.preflight.job import Job
from coupole.preflight.preflight import CostOfViews
from coupole.reflectance.next_views.view_trials import Trials, trials_of

Floats = NDArray[np.float64]

_NEARLY = 0.02
"""Scores that differ by this share or less are nearly the same."""
_ALTERNATIVES = 5
"""Number of alternatives that the journal names."""


@dataclass(frozen=True)
class Spent:
    """Cost of some views."""

    frames: int
    seconds: float
    """Time of motions, bursts and choices."""
    lux_h: Floats
    """[points] light at each of the object's dose points."""

    def __add__(self, other_cost: Spent) -> Spent:
        return Spent(
            self.frames + other_cost.frames, self.seconds + other_cost.seconds, self.lux_h + other_cost.lux_h
        )

    def exceeded_limits(self, until: EnoughViews) -> list[str]:
        """Return the keys of the limits that it exceeds."""
        limits = {"frames": until.frames, "seconds": until.seconds, "lux_h": until.lux_h}
        figures = {"frames": self.frames, "seconds": self.seconds, "lux_h": float(self.lux_h.max())}
        return [key for key, limit in limits.items() if limit is not None and figures[key] > limit * (1 + 1e-9)]


@dataclass(frozen=True)
class _Weighed:
    """A candidate with its figures."""

    view: str
    gain: float
    score: float
    """Gain divided by the cost, which is a share of the limits."""
    leg_s: float
    """Time of the motion to it, s."""
    cost: Spent

    def figures(self) -> dict[str, Any]:
        return {
            "view": self.view,
            "score": _round_to_4(self.score),
            "gain": _round_to_4(self.gain),
            "move_s": round(self.leg_s, 3),
        }


class NextViews:
    """The choice of views for one job, whose schedule has all candidates."""

    def __init__(self, job: Job, until: EnoughViews) -> None:
        """It computes for some seconds what all candidates would show."""
        self._job, self._until = job, until
        self._trials: Trials = trials_of(job)
        self._numbers = {view.name: number for number, view in enumerate(job.schedule.views)}

    def choose(self, chosen_views: Sequence[ChosenView], schedule: Schedule) -> ChosenView:
        """Return the next view after the chosen ones, or the end of the choice. `schedule` has the same views as
        the job's, with the bursts of the chosen views as they were chosen in the run."""
        names = [choice.view for choice in chosen_views]
        costs = CostOfViews(
            self._job.plan, self._job.cell.rig, schedule, self._job.cell.leds, self._job.shape.dose_points_mm
        )
        spent_cost = self._sum_of_costs(names, costs, schedule)
        figures = self._figures(names, spent_cost)
        if reason := self._end_reason(names, figures):
            return ChosenView(view="", reason=reason, figures=figures)
        knowledge = self._trials.knowledge_after(names)
        gains = {name: self._trials.gain(knowledge, name) for name in self._numbers if name not in names}
        weighed_views, exceeded_keys = self._weigh_candidates(gains, names, spent_cost, costs, schedule)
        if not weighed_views:
            keys = " and ".join(f"`{key}`" for key in exceeded_keys)
            reason = f"enough by {keys}: the plan allows none of the {len(gains)} other views"
            return ChosenView(view="", reason=reason, figures=figures)
        ranked_views = sorted(
            weighed_views, key=lambda candidate: (-candidate.score, self._numbers[candidate.view])
        )
        best_gain = max(candidate.gain for candidate in ranked_views)
        if best_gain <= (self._until.gain or 0.0):
            return ChosenView(view="", reason=self._no_gain(best_gain), figures=figures)
        return self._best_of(ranked_views, names, figures)

    # -- limits -----------------------------------------------------------------------------------------------

    def _sum_of_costs(self, names: Sequence[str], costs: CostOfViews, schedule: Schedule) -> Spent:
        spent_cost = Spent(0, 0.0, np.zeros(len(self._job.shape.dose_points_mm)))
        for place, name in enumerate(names):
            spent_cost += self._cost(name, self._leg_s(names[:place], name), costs, schedule)
        return spent_cost

    def _cost(self, name: str, leg_s: float, costs: CostOfViews, schedule: Schedule) -> Spent:
        number = self._numbers[name]
        frames = sum(len(burst.labels) for burst in schedule.bursts[number])
        moving_s = leg_s + self._job.cell.rig.motion.settle_dwell_s
        return Spent(frames, moving_s + costs.standing_s(number), costs.dose_lux_h(number))

    def _end_reason(self, names: Sequence[str], figures: dict[str, Any]) -> str:
        """Return the reason why no candidate needs to be weighed; empty if there is none."""
        until = self._until
        if len(names) >= until.views:
            return f"enough by `views`: {until.views} views are taken, which show {figures['coverage']:.1%}"
        if len(names) == len(self._numbers):
            return "all candidates are taken"
        if until.coverage is not None and figures["coverage"] >= until.coverage:
            shown_text = f"{figures['coverage']:.1%} of what all candidates show"
            return f"enough by `coverage`: {shown_text}, at least {until.coverage:.1%}"
        return ""

    def _no_gain(self, best_gain: float) -> str:
        if best_gain <= 0.0:
            return "no further candidate shows anything new of the object"
        assert self._until.gain is not None
        return (
            f"enough by `gain`: the best further view would lower the uncertainty by {best_gain:.2%}, less than "
            f"{self._until.gain:.2%}"
        )

    # -- scores -----------------------------------------------------------------------------------------------

    def _weigh_candidates(
        self,
        gains: dict[str, float],
        names: Sequence[str],
        spent_cost: Spent,
        costs: CostOfViews,
        schedule: Schedule,
    ) -> tuple[list[_Weighed], list[str]]:
        """Return the best of the candidates that the limits allow, and the limits that the other candidates
        exceed.

        A straight motion is faster than any other, so a score with its time is an upper bound. Paths are planned
        from the highest bound on, until no other candidate can be nearly as good as the best, or gain more.
        """
        other_views = list(gains)
        views = [self._job.schedule.views[self._numbers[name]] for name in other_views]
        least_s = self._job.motion.ways.least_s(self._posture(names), views)
        bounds = [
            self._weigh_one(name, gains[name], leg_s, costs, schedule)
            for name, leg_s in zip(other_views, least_s.tolist(), strict=True)
        ]
        weighed_views: list[_Weighed] = []
        exceeded_keys: dict[str, None] = {}
        for bound in sorted(bounds, key=lambda candidate: (-candidate.score, self._numbers[candidate.view])):
            best = max((candidate.score for candidate in weighed_views), default=0.0)
            most_gain = max((candidate.gain for candidate in weighed_views), default=0.0)
            is_worse = bound.score < (1.0 - _NEARLY) * best and bound.gain <= most_gain
            if len(weighed_views) > _ALTERNATIVES and is_worse:
                continue
            leg_s = self._leg_s(names, bound.view)
            candidate = self._weigh_one(bound.view, bound.gain, leg_s, costs, schedule)
            if too_much := (spent_cost + candidate.cost).exceeded_limits(self._until):
                exceeded_keys |= dict.fromkeys(too_much)
            else:
                weighed_views.append(candidate)
        return weighed_views, list(exceeded_keys)

    def _weigh_one(self, name: str, gain: float, leg_s: float, costs: CostOfViews, schedule: Schedule) -> _Weighed:
        cost, until = self._cost(name, leg_s, costs, schedule), self._until
        share = 1.0 / until.views
        share += cost.frames / until.frames if until.frames else 0.0
        share += cost.seconds / until.seconds if until.seconds else 0.0
        share += float(cost.lux_h.max()) / until.lux_h if until.lux_h else 0.0
        return _Weighed(name, gain, gain / share, leg_s, cost)

    def _posture(self, names: Sequence[str]) -> Floats:
        """[6] posture of the arm after the last of some views; home without a view."""
        if not names:
            return np.asarray(self._job.cell.rig.motion.home_joints_deg, dtype=np.float64)
        return self._trials.of_view[names[-1]].joints_deg

    def _leg_s(self, names: Sequence[str], name: str) -> float:
        return self._job.motion.ways.leg(self._posture(names), self._trials.of_view[name].view).duration_s

    # -- words ------------------------------------------------------------------------------------------------

    def _figures(self, names: Sequence[str], spent_cost: Spent) -> dict[str, Any]:
        return {
            "views": len(names),
            "coverage": _round_to_4(self._trials.coverage(names)),
            "frames": spent_cost.frames,
            "seconds": round(spent_cost.seconds, 3),
            "lux_h": float(f"{float(spent_cost.lux_h.max()):.7g}"),
        }

    def _best_of(
        self, ranked_views: Sequence[_Weighed], names: Sequence[str], figures: dict[str, Any]
    ) -> ChosenView:
        nearly = [
            candidate for candidate in ranked_views if candidate.score >= (1.0 - _NEARLY) * ranked_views[0].score
        ]
        best = min(nearly, key=lambda candidate: (candidate.leg_s, self._numbers[candidate.view]))
        coverage_after = self._trials.coverage([*names, best.view])
        reason = f"lowers the expected uncertainty by {best.gain:.1%}"
        if (more := coverage_after - figures["coverage"]) >= 0.0005:
            reason += f", shows {more:.1%} more of the surface"
        reason += f"; {best.leg_s:.1f} s of motion"
        if len(nearly) > 1:
            reason += f", the nearest of {len(nearly)} that are nearly as good"
        other_figures = [candidate.figures() for candidate in ranked_views if candidate.view != best.view]
        figures = figures | {
            "coverage_after": _round_to_4(coverage_after),
            "chosen": best.figures(),
            "next_best": other_figures[:_ALTERNATIVES],
        }
        return ChosenView(view=best.view, reason=reason, figures=figures)


def _round_to_4(value: float) -> float:
    return float(f"{value:.4g}")
