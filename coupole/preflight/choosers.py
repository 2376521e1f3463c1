"""Choosers of the bursts of a job's views in the run."""

from __future__ import annotations

from coupole.plan.choices import Chooser
from coupole.plan.plan import AutoExposure
from coupole.preflight.auto_exposure import AutoExposureChooser
from coupole.preflight.job import Job


def chooser_of(job: Job) -> Chooser | None:
    """The chooser that the job's plan asks for; None if the plan says all bursts itself."""
    exposure, rig = job.plan.exposure, job.cell.rig
    if not isinstance(exposure, AutoExposure):
        return None
    base_from_support = rig.support.base_from_support.matrix()
    return AutoExposureChooser(exposure, job.cell.leds, base_from_support, emission=rig.dome.emission)
