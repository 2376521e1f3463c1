"""Checks a job against its cell and its disk: preflight's report, and the pace that heat and disk allow."""

from __future__ import annotations

import math
import shutil
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from coupole.errors import StorageError
from coupole.plan.bursts import Pace
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import in_world, runs_tables
from coupole.preflight import ledger
from coupole.preflight.commissioned import commissioning_refusals
from coupole.preflight.job import Job, at_pace
from coupole.preflight.preflight import DISK_SHARE, Report, StorageFacts, check
from coupole.storage.write_speed import measure_write_speed

_DISK_GRAIN_US = 100
_LED_DUTIES = tuple(0.9**k for k in range(1, 33))
"""Largest on-time shares, tried in turn if LEDs get too hot."""


def preflight_of(
    job: Job, folder: Path, *, paths: bool = True, allocated_bytes: int = 0, share_left: float = 1.0
) -> tuple[Job, Report]:
    """Preflight's report on a job whose run would be in `folder`, and the job at the pace that LEDs and the
    measured speed of that disk allow.

    Without `paths` collisions are not checked. For a resumed run, `allocated_bytes` are already on the disk
    and `share_left` of its frames are still to be taken.
    """
    existing = folder
    while not existing.exists():
        existing = existing.parent
    try:
        write_bytes_s = measure_write_speed(existing, frame_bytes=job.cell.rig.frame_bytes)
    except StorageError:
        write_bytes_s = 0.0
    free_bytes = shutil.disk_usage(existing).free + allocated_bytes
    job, report = check_job(job, StorageFacts(free_bytes, write_bytes_s), paths=paths, share_left=share_left)
    report.refusals += commissioning_refusals(job.cell)
    return job, report


def check_job(
    job: Job, storage: StorageFacts, *, paths: bool = True, share_left: float = 1.0
) -> tuple[Job, Report]:
    """Preflight's report on a job, given the disk's state; and the job at the pace that LEDs and disk allow."""
    rig = job.cell.rig
    home_deg = rig.motion.home_joints_deg
    if paths:
        itinerary = job.motion.itinerary(job.schedule.views, home_deg)
    else:
        itinerary = job.motion.unchecked_itinerary(job.schedule.views, home_deg)
    before = ledger.total_lux_h(job.cell.storage_folder, job.plan.object.id) if job.plan.object else 0.0

    def checked(pace: Pace) -> tuple[Job, Report]:
        paced = at_pace(job, pace)
        report = check(
            job.plan,
            rig,
            paced.schedule,
            job.cell.leds,
            storage,
            itinerary,
            object_points_support_mm=job.shape.dose_points_mm,
            dose_before_lux_h=before,
            share_left=share_left,
        )
        return paced, report

    job, report = _cooled(*checked(Pace(disk_us=_disk_us(rig, storage))), checked)
    report.refusals += calibration_refusals(job)
    if job.plan.trigger == "hardware" and not runs_tables(rig):
        why = "cannot trigger the camera: it runs no tables. Set `trigger: software` in the plan"
        report.refusals.insert(0, f"led box {rig.ledbox.driver}: {why}")
    report.warnings += job.cell.remarks
    return job, report


def calibration_refusals(job: Job, *, camera: str | None = None, temperature_c: float | None = None) -> list[str]:
    """Reasons why the records that plan or rig names are not valid here. Camera and temperature are compared
    later, with the opened devices (`Situation`)."""
    if job.calibrations is None:
        return []
    from coupole.calibration.in_force import Situation, refusals

    rig = job.cell.rig
    here = Situation(
        now=datetime.now(UTC),
        simulated=in_world(rig, dry_run=False),
        size_px=(rig.sensor.width_px, rig.sensor.height_px),
        focal_length_mm=rig.lens.focal_length_mm,
        focus_distance_mm=rig.lens.focus_distance_mm,
        f_number=rig.lens.f_number,
        camera=camera,
        temperature_c=temperature_c,
    )
    return refusals(job.calibrations, here)


def _disk_us(rig: Rig, storage: StorageFacts) -> int:
    """Time in which the disk writes a frame, rounded up so that small fluctuations do not change the schedule; 0
    if unknown."""
    if not storage.write_bytes_s:
        return 0
    seconds = rig.frame_bytes / (DISK_SHARE * storage.write_bytes_s)
    return math.ceil(seconds * 1e6 / _DISK_GRAIN_US) * _DISK_GRAIN_US


def _cooled(job: Job, report: Report, checked: Callable[[Pace], tuple[Job, Report]]) -> tuple[Job, Report]:
    """The fastest pace at which LEDs do not get too hot; unchanged if none of the tried ones is sufficient."""
    if not report.too_hot:
        return job, report
    paces = [replace(job.pace, led_duty=duty) for duty in _LED_DUTIES]
    first = bisect_left(paces, True, key=lambda pace: not checked(pace)[1].too_hot)
    return checked(paces[first]) if first < len(paces) else (job, report)
