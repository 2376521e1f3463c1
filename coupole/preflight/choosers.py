"""Choosers, which choose the bursts of a job's views during the run."""

from __future__ import annotations

from coupole.plan.choices import Chooser
from coupole.plan.exposures import AutoExposure
from coupole.plan.schedule import expand_view
from coupole.preflight.adaptive_lights import AdaptiveLightsChooser
from coupole.preflight.auto_exposure import AutoExposureChooser
from coupole.preflight.job import Job


def refusals_of_choosers(job: Job) -> list[str]:
    """Return refusals of views for which the chooser would light nothing at all."""
    chooser = chooser_of(job)
    if chooser is None:
        return []
    first_choices = {
        view.name: chooser.choose(job.schedule.open_view(number), (), {})
        for number, view in enumerate(job.schedule.views)
        if job.schedule.choosable[number]
    }
    return [f"view {name}: {choice.reason}" for name, choice in first_choices.items() if not choice.bursts]


def chooser_of(job: Job) -> Chooser | None:
    """Return the chooser that the job's plan asks for; None if the plan itself gives all bursts."""
    plan, rig, leds = job.plan, job.cell.rig, job.cell.leds
    base_from_support = rig.support.base_from_support.matrix()
    if isinstance(plan.exposure, AutoExposure):
        return AutoExposureChooser(plan.exposure, leds, base_from_support, emission=rig.dome.emission)
    if plan.chooses_lights:
        lights = {
            pose.name: view.lights or plan.lights for view in plan.view_entries for pose in expand_view(view)
        }
        return AdaptiveLightsChooser(lights, leds, base_from_support, emission=rig.dome.emission)
    return None
