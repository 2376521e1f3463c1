"""The views of a session in their order: as planned before it, or chosen one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from coupole.acquisition.arm_supervisor import ArmSupervisor
from coupole.acquisition.bursts_of_views import BurstsOfViews
from coupole.acquisition.recorder import Recorder
from coupole.motion.itinerary import Visit
from coupole.plan.bursts import Burst
from coupole.plan.plan import AdaptiveViews
from coupole.plan.view_choices import has_enough_views
from coupole.preflight.job import Job
from coupole.storage.journal_events import ViewChosen

if TYPE_CHECKING:
    from coupole.reflectance.next_views.next_views import NextViews


@dataclass(frozen=True)
class NextVisit:
    """A view that the arm goes to next."""

    number: int
    """Number of the view in the job's schedule."""
    place: int
    """Number of the views before it in the run."""
    visit: Visit
    bursts: list[Burst]
    """Bursts of the view that are known and not complete. A view that has not begun may have no known bursts yet.
    """
    following: tuple[tuple[int, Visit], ...]
    """Numbers and visits of the views after it, as far as they are known."""


def planned_visits(job: Job, arm: ArmSupervisor, bursts: BurstsOfViews) -> list[NextVisit]:
    """Return all views with frames to take, on the planned way from where the arm is. Raises PreflightRefused if
    there is none."""
    views = job.schedule.views
    remaining_bursts = {n: _remaining(bursts, n) for n in range(len(views))}
    numbers = [n for n, of_view in remaining_bursts.items() if of_view or bursts.may_want_more(n)]
    itinerary = arm.itinerary([views[n] for n in numbers])
    visits: list[tuple[int, Visit]] = []
    for index in itinerary.order:
        visit = itinerary.visits[index]
        assert visit is not None
        visits.append((numbers[index], visit))
    before = len(views) - len(numbers)
    return [
        NextVisit(number, before + place, visit, remaining_bursts[number], tuple(visits[place + 1 :]))
        for place, (number, visit) in enumerate(visits)
    ]


def chosen_visits(job: Job, arm: ArmSupervisor, bursts: BurstsOfViews, recorder: Recorder) -> Iterator[NextVisit]:
    """Return the views that the run has chosen and not completed, then further ones, each chosen when the one
    before is complete. A choice is on the disk when its view is returned. Raises PreflightRefused if the arm has
    no way from where it is."""
    from coupole.reflectance.next_views.next_views import NextViews

    assert isinstance(job.plan.views, AdaptiveViews)
    next_views = None if has_enough_views(job.chosen_views) else NextViews(job, job.plan.views.until)
    return _chosen_visits(job, arm, bursts, recorder, next_views)


def _chosen_visits(
    job: Job, arm: ArmSupervisor, bursts: BurstsOfViews, recorder: Recorder, next_views: NextViews | None
) -> Iterator[NextVisit]:
    numbers = {view.name: number for number, view in enumerate(job.schedule.views)}
    chosen_views = list(job.chosen_views)
    arm.begin_here()
    for place, name in enumerate([choice.view for choice in chosen_views if choice.view]):
        number = numbers[name]
        remaining_bursts = _remaining(bursts, number)
        if remaining_bursts or bursts.may_want_more(number):
            yield NextVisit(number, place, arm.way_to(job.schedule.views[number]), remaining_bursts, ())
    while next_views is not None:
        choice = next_views.choose(chosen_views, bursts.schedule_so_far())
        recorder.note(ViewChosen(view=choice.view, reason=choice.reason, figures=choice.figures))
        recorder.commit(now=True)
        chosen_views.append(choice)
        if not choice.view:
            return
        number, place = numbers[choice.view], len(chosen_views) - 1
        bursts.take(choice.view)
        yield NextVisit(number, place, arm.way_to(job.schedule.views[number]), bursts.bursts_left(number), ())


def _remaining(bursts: BurstsOfViews, number: int) -> list[Burst]:
    """Return the bursts that are left of a view. If an earlier session has fired all its bursts, more bursts are
    chosen now. For a view that has not begun, bursts are chosen when the arm is about to go there."""
    return bursts.bursts_left(number) or (bursts.more(number) if bursts.bursts(number) else [])
