"""The job: a plan with all files that it names, and its schedule. Commands take jobs as their input.

::

    read       plan.reading      plan, rig, LED table: files to models
        resolve    object_shape, calibration.in_force: the files that these name
    schedule   plan.schedule     views, bursts, tables
    check      checking          Report, and the pace that heat and disk allow
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from coupole.errors import InputError, StorageError
from coupole.motion.cell_motion import CellMotion
from coupole.plan.bursts import FASTEST, Pace
from coupole.plan.cell import Cell
from coupole.plan.choices import Choice
from coupole.plan.plan import Plan
from coupole.plan.reading import read_plan
from coupole.plan.rig_devices import described_arm, device_times, runs_tables
from coupole.plan.schedule import Schedule, build_schedule
from coupole.plan.view_choices import ChosenView, has_enough_views, problem_of_views
from coupole.plan.yamlfile import Document
from coupole.preflight.machine import refuse_little_address_space
from coupole.preflight.object_shape import ObjectShape, read_object
from coupole.storage.run_inputs import Inputs

if TYPE_CHECKING:
    from coupole.calibration.in_force import InForce


@dataclass(frozen=True)
class Job:
    """A plan, its cell, its object and the schedule that follows from them."""

    plan: Plan
    document: Document
    cell: Cell
    shape: ObjectShape
    schedule: Schedule
    motion: CellMotion
    calibrations: tuple[InForce, ...] | None = None
    """The records that the plan names, or else its rig's; None if the plan says `none`."""
    hidden_leds: Mapping[str, Sequence[int]] = field(default_factory=dict)
    """LEDs left out of views, by name of view."""
    pace: Pace = FASTEST
    """Limits of the schedule's step periods in addition to camera and LEDs."""
    choices: Mapping[str, Sequence[Choice]] = field(default_factory=dict)
    """Choices that a run has made for its views so far, by name of view. Only a run that chooses its bursts has
    them."""
    chosen_views: Sequence[ChosenView] = ()
    """Views that a run has chosen so far, in their order. Only a run that chooses its views has them."""

    @property
    def inputs(self) -> Inputs:
        """Files that a run of this job depends on."""
        other_paths = [self.cell.leds_path] + ([self.shape.mesh_path] if self.shape.mesh_path else [])
        other_paths += [item.path for item in self.calibrations or ()]
        rig = self.cell.document.path
        return Inputs(
            self.document.path, rig, tuple(other_paths), described_arm(self.cell.rig), files=self.cell.files
        )


def read_job(plan_path: Path, rig_path: Path | None = None, *, text: str | None = None) -> Job:
    """Read a plan and all files that it names. With `text`, the text is read instead of the plan's file. Raises
    InputError with all problems of all files; ResourceShortage if this process may have too little memory."""
    refuse_little_address_space()
    files = read_plan(plan_path, rig_path, text=text)
    shape = read_object(files)
    calibrations = None
    if files.record_paths is not None:
        from coupole.calibration.in_force import read_in_force

        calibrations = read_in_force(files.record_paths, files.cell.files)
    schedule = schedule_of(files.plan, files.cell)
    motion = motion_of(files.plan, files.cell, shape, schedule)
    return Job(files.plan, files.document, files.cell, shape, schedule, motion, calibrations)


def motion_of(plan: Plan, cell: Cell, shape: ObjectShape, schedule: Schedule) -> CellMotion:
    """Return the arm's motion in this cell."""
    targets = [view.target_mm for view in schedule.views if view.target_mm is not None]
    return CellMotion(cell, shape.corners_mm, targets, plan.order, is_order_open=plan.chooses_views)


def schedule_of(plan: Plan, cell: Cell, pace: Pace = FASTEST) -> Schedule:
    """Return all bursts of all views of a plan, with the periods that camera, LEDs and pace allow."""
    return build_schedule(
        plan,
        cell.leds,
        cell.rig.support.base_from_support.matrix(),
        device_times(cell.rig),
        pace=pace,
        runs_tables=runs_tables(cell.rig),
    )


def at_pace(job: Job, pace: Pace) -> Job:
    """Return the same job at another pace."""
    if pace == job.pace:
        return job
    schedule = schedule_of(job.plan, job.cell, pace).without(job.hidden_leds)
    return with_choices(replace(job, schedule=schedule, pace=pace), job.choices, job.chosen_views)


def with_choices(
    job: Job, choices: Mapping[str, Sequence[Choice]], chosen_views: Sequence[ChosenView] = ()
) -> Job:
    """Return the same job for a run that has made these choices of bursts and views. If the run needs no more
    views, all other views are left out. Raises StorageError for a choice that the plan does not allow: such a
    choice shows that the journal was changed.
    """
    try:
        if job.schedule.is_open:
            job = replace(job, schedule=job.schedule.with_choices(choices), choices=choices)
        if problem := problem_of_views(job.schedule, chosen_views):
            raise KeyError(problem)
    except KeyError as error:
        raise StorageError(
            f"the run's journal has a choice that its plan does not allow: {error.args[0]}"
        ) from None
    names = [choice.view for choice in chosen_views]
    schedule = job.schedule.only_views(names) if has_enough_views(chosen_views) else job.schedule
    return replace(job, schedule=schedule, chosen_views=tuple(chosen_views))


def without_hidden(job: Job, known_leds: Mapping[str, Sequence[int]] | None = None) -> Job:
    """Return the same job without the LEDs that light nothing that a view sees, if the plan has `hidden_lights:
    skip` or chooses LEDs. If a run began without the `known_leds`, these are left out. Otherwise the LEDs are
    computed for the postures of the paths from home. Raises InputError if a view has no LED left to choose."""
    if not job.plan.skips_hidden_lights:
        return job
    hidden_leds = dict(known_leds) if known_leds is not None else _hidden_from_home(job)
    schedule = job.schedule.without(hidden_leds)
    for view, bursts in zip(schedule.views, schedule.choosable, strict=False):
        if not any(burst.is_light().any() for burst in bursts):
            raise InputError(f"view {view.name}: arm and object hide all LEDs of the choice")
    return replace(job, schedule=schedule, hidden_leds=hidden_leds)


def _hidden_from_home(job: Job) -> dict[str, list[int]]:
    itinerary = job.motion.planned_itinerary(job.schedule.views)
    hidden_leds: dict[str, list[int]] = {}
    for view, visit, bursts in zip(
        job.schedule.views, itinerary.visits, job.schedule.planned_bursts(), strict=True
    ):
        if visit is None:
            continue
        lit = {int(led) for burst in bursts for led in burst.table["led"]}
        occluded_leds = job.motion.occluded_leds(job.motion.occlusions.at(visit.joints_deg))
        if leds := [led for led in occluded_leds if led in lit]:
            hidden_leds[view.name] = leds
    return hidden_leds
