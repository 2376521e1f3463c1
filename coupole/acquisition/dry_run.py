"""A whole plan on the rig's twin, faster than real time."""

from __future__ import annotations

import time
from typing import Any

from rich.console import Console

from coupole.acquisition.memory_recorder import DryRecorder
from coupole.acquisition.observer import Control
from coupole.acquisition.opened_cell import open_cell
from coupole.acquisition.operator import UNLIMITED_BYTES, identity_printer, refuse
from coupole.acquisition.sequencer import Sequencer
from coupole.acquisition.signals import obeyed_by
from coupole.bounded import run_bounded
from coupole.errors import DeviceError
from coupole.preflight.checking import check_job
from coupole.preflight.job import Job, without_hidden
from coupole.preflight.preflight import StorageFacts
from coupole.viewing.preflight_table import show_preflight
from coupole.viewing.terminal import RunObserver, show_dry_run


def rehearse(job: Job, console: Console, *, speed: float, figures: dict[str, Any]) -> None:
    """Run a whole plan on the rig's twin, faster than real time. Report the figures that preflight cannot
    compute."""
    job = without_hidden(job)
    job, preflight = check_job(job, StorageFacts(UNLIMITED_BYTES))
    show_preflight(console, preflight, name=job.plan.name, rig=f"the twin of {job.cell.rig.name}")
    refuse(preflight)
    recorder, control = DryRecorder(), Control()
    with open_cell(job.cell, job=job, dry_run=True, speed=speed, on_opened=identity_printer(console)) as cell:
        observer = RunObserver(console, cell.sensor.width_px * cell.sensor.height_px * 2, 0, speed=speed)
        sequencer = Sequencer(job, cell, recorder, observer=observer, control=control)
        outcome = sequencer.outcome
        started_s = time.monotonic()
        try:
            with (
                obeyed_by(control, cell.halt),
                observer.showing(job.schedule.frames, job.schedule.view_count),
                control.explains(DeviceError),
            ):
                run_bounded(sequencer.acquire, stop=control.stop, rescue=cell.make_safe)
        finally:
            machine_s = time.monotonic() - started_s
            figures.update(
                {
                    "dry_run": True,
                    "shots": outcome.shots,
                    "proven": outcome.proven,
                    "missing": len(outcome.missing),
                    "missing_darks": len(outcome.missing_darks),
                    "reshot": outcome.reshot,
                    "duration_s": round(outcome.duration_s, 3),
                    "preflight_s": round(preflight.duration_s, 3),
                    "ideal_s": round(outcome.ideal_s, 3),
                    "machine_s": round(machine_s, 3),
                    "speed": round(outcome.duration_s / machine_s, 2),
                    "speed_asked": speed,
                    "over_triggers": outcome.over_triggers,
                    "exposure_scale": preflight.exposure_scale,
                    "exposure": {
                        view: {
                            "pictures": exposure.pictures,
                            "brightest": round(exposure.brightest, 4) if preflight.exposure_scale else None,
                            "saturated": round(exposure.saturated_share, 6) if preflight.exposure_scale else None,
                            "verdict": exposure.verdict() if preflight.exposure_scale else "not known",
                        }
                        for view, exposure in recorder.exposures.items()
                    },
                }
            )
            show_dry_run(console, recorder.exposures, outcome, figures)
