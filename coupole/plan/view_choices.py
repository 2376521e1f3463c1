"""Views that are chosen during a run, from the plan's candidates.

A choice is written into the journal, with its reason and the views that would have been next, and synced before
the arm moves. A resumed run repeats the choices of its journal and goes on from there. So a choice must follow
from the plan and the earlier choices alone, never from the time or from the arm's actual posture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pydantic import Field

from coupole.plan.base_model import Model

if TYPE_CHECKING:
    from coupole.plan.schedule import Schedule


class ChosenView(Model):
    """The next view of a run. Without a name, the run has enough views."""

    view: str
    """Name of the view; empty if no more views are taken."""
    reason: str
    """The reason, in words for the journal and the report."""
    figures: dict[str, Any] = Field(default_factory=dict)
    """Numbers behind the reason, and the alternatives that were weighed, with values of JSON only."""


def has_enough_views(chosen_views: Sequence[ChosenView]) -> bool:
    """True if the last choice says that no more views are taken."""
    return bool(chosen_views) and not chosen_views[-1].view


def problem_of_views(schedule: Schedule, chosen_views: Sequence[ChosenView]) -> str:
    """Return why a plan does not allow these choices; empty if it does. The schedule has all of its candidates."""
    names = [choice.view for choice in chosen_views if choice.view]
    if not chosen_views:
        return ""
    if schedule.most_views is None:
        return f"a choice of {names[0] if names else 'no more views'}, but the plan chooses no views"
    if unknown := set(names) - {view.name for view in schedule.views}:
        return f"{min(unknown)} is not among the plan's candidates"
    if len(names) > len(set(names)):
        return f"{next(name for name in names if names.count(name) > 1)} is chosen twice"
    if len(names) > schedule.view_count:
        return f"{len(names)} views are chosen, where the plan allows {schedule.view_count}"
    if not all(choice.view for choice in chosen_views[:-1]) or not names:
        return "the choice was ended before a view was chosen, or views were chosen after its end"
    return ""
