"""Checks a job against its cell and its disk: preflight's report, and the pace that heat and disk allow."""

from __future__ import annotations

import math
import shutil
from bisect import bisect_left
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from coupole.errors import StorageError
from coupole.motion.itinerary import Itinerary
from coupole.plan.bursts import Pace
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import in_world, runs_tables, trusted_by_name
from coupole.plan.shot_id import ShotId
from coupole.preflight.choosers import refusals_of_choosers
from coupole.preflight.commissioned import commissioning_refusals
from coupole.preflight.discard_room import discard_room, refusals_of_discarding
from coupole.preflight.exposure_scale import ExposedWhite, exposed_white, exposure_scale
from coupole.preflight.framing import ObjectCheck, check_object
from coupole.preflight.job import Job, at_pace
from coupole.preflight.preflight import DISK_SHARE, Course, ObjectLight, Report, StorageFacts, Whole, check
from coupole.storage.given_back import why_not
from coupole.storage.ledger import ledger_of, similar_ids
from coupole.storage.ledger_lines import History
from coupole.storage.run import Occupied
from coupole.storage.write_speed import measure_write_speed

_DISK_GRAIN_US = 100
NOTHING = Occupied()
LED_DUTIES = tuple(0.9**k for k in range(1, 33))
"""Largest on-time shares, tried in turn if LEDs get too hot."""


def preflight_of(
    job: Job,
    folder: Path,
    *,
    paths: bool = True,
    occupied_space: Occupied = NOTHING,
    proven: Collection[ShotId] = (),
    measure: bool = True,
    say: Callable[[str], object] = lambda _: None,
) -> tuple[Job, Report]:
    """Return preflight's report on a job whose run would be in `folder`. Also return the job at the pace that the
    LEDs and the measured speed of the disk allow.

    Without `paths`, collisions are not checked. The views of a resumed run occupy `occupied_space` of the disk,
    and its `proven` frames are not taken again. The disk's speed is known only with `measure`. `say` is called
    with a description of each step.
    """
    if measure:
        say("measuring the disk's speed")
    storage = storage_of(folder, job.cell.rig, occupied_space, measure=measure)
    if job.plan.discard is not None and not storage.trouble:
        storage = replace(storage, no_holes=why_not(_existing(folder)))
    say("computing paths, heat, light and time")
    job, report = check_job(job, storage, paths=paths, proven=proven)
    if measure and not storage.write_bytes_s and not storage.trouble:
        report.warnings.append(
            f"storage {folder}: too little room to measure the disk's speed, so this speed is not considered"
        )
    report.warnings += trusted_by_name(job.cell.rig)
    report.refusals += commissioning_refusals(job.cell)
    return job, report


def storage_of(
    folder: Path, rig: Rig, occupied_space: Occupied = NOTHING, *, measure: bool = True
) -> StorageFacts:
    """Return the state of the disk for this folder, which may not exist yet."""
    existing = _existing(folder)
    write_bytes_s, trouble = 0.0, "" if existing.is_dir() else f"{existing} is a file"
    free_bytes = shutil.disk_usage(existing).free
    if measure and not trouble:
        try:
            write_bytes_s = measure_write_speed(
                existing, frame_bytes=rig.frame_bytes, room_bytes=free_bytes - rig.storage.reserve_bytes
            )
        except StorageError as error:
            trouble = str(error)
    return StorageFacts(free_bytes, write_bytes_s, folder, occupied_space, trouble)


def _existing(folder: Path) -> Path:
    """Return the folder, or the nearest parent that exists."""
    return next(place for place in (folder, *folder.absolute().parents) if place.exists())


def check_job(
    job: Job, storage: StorageFacts, *, paths: bool = True, proven: Collection[ShotId] = ()
) -> tuple[Job, Report]:
    """Return preflight's report on a job, without the `proven` frames of its run, for this state of the disk. Also
    return the job at the pace that LEDs and disk allow."""
    rig = job.cell.rig
    views = job.schedule.without_proven(proven).views if proven else job.schedule.views
    itinerary = job.motion.planned_itinerary(views, paths=paths)
    all_views = job.motion.planned_itinerary(job.schedule.views, paths=False) if proven else None
    history = ledger_of(job.cell, job.plan.object.id).read_history() if job.plan.object else History()
    object_light = ObjectLight(job.shape.dose_points_mm, history.total_lux_h, history.budget_lux_h)

    def check_at(pace: Pace) -> tuple[Job, Report]:
        paced_job = at_pace(job, pace)
        checking = partial(check, job.plan, rig, job.cell.leds, storage=storage, object_light=object_light)
        if all_views is None:
            return paced_job, checking(Course(paced_job.schedule, itinerary))
        of_all = checking(Course(paced_job.schedule, all_views))
        whole = Whole(
            of_all.view_count, of_all.shots, of_all.frames, of_all.bytes, of_all.duration_s, of_all.dose_lux_h
        )
        remaining_schedule = paced_job.schedule.without_proven(proven)
        return paced_job, checking(Course(remaining_schedule, itinerary), whole=whole)

    job, report = _at_cool_pace(*check_at(Pace(disk_us=_disk_us(rig, storage))), check_at)
    report.object_check = _object_check(job, itinerary, proven)
    if report.object_check is not None:
        report.refusals += report.object_check.refusals
        report.warnings += report.object_check.warnings
    _check_discarding(job, report, storage, proven)
    report.warnings += job.shape.remarks
    if (scale := exposure_scale(job)) is not None:
        report.exposure_scale, report.white = scale.source, tuple(exposed_white(job, scale))
        report.warnings += _badly_exposed(report.white)
    report.refusals += calibration_refusals(job) + refusals_of_choosers(job)
    if job.plan.trigger == "hardware" and not runs_tables(rig):
        why = "cannot trigger the camera: it runs no tables. Set `trigger: software` in the plan"
        report.refusals.insert(0, f"led box {rig.ledbox.driver}: {why}")
    report.warnings += job.cell.remarks
    report.warnings += ledger_warnings(job, history, report.dose_lux_h)
    return job, report


def _check_discarding(job: Job, report: Report, storage: StorageFacts, proven: Collection[ShotId]) -> None:
    """Check the disk space of a run whose frames are discarded, and whether they can be. Does nothing if all
    frames are kept."""
    if job.plan.discard is None:
        return
    report.refusals += refusals_of_discarding(job)
    report.warnings.append("frames are discarded when their samples are safe: the run needs `--reflectance`")
    room, folder = discard_room(job), storage.folder or job.cell.storage_folder
    remaining = job.schedule.without_proven(proven) if proven else job.schedule
    report.peak_bytes = room.peak_bytes(storage.occupied_space, {view.name for view in remaining.views})
    report.staying_bytes = room.staying_bytes
    if storage.no_holes:
        problem = job.document.problem(
            ("discard",), f"expected a disk that can give back a part of a file; {folder}: {storage.no_holes}"
        )
        report.refusals.append(str(problem))
    if report.peak_bytes + room.reserve_bytes > storage.free_bytes:
        needed, reserve, free = (n / 1e9 for n in (report.peak_bytes, room.reserve_bytes, storage.free_bytes))
        report.refusals.append(
            f"storage {folder}: though frames are discarded, the run needs up to {needed:.2f} GB at a time "
            f"(frames of one view, kept frames of all views, samples and fits), and "
            f"{reserve:.2f} GB must stay free; "
            f"{free:.2f} GB are free"
        )


def allowed_lux_h(job: Job, history: History) -> float | None:
    """Return the light that the job's object may receive in its life; None without a budget. It is the budget of
    its ledger's `history`, or the plan's budget if that is smaller."""
    return history.allowed_lux_h(job.plan.object.dose_budget_lux_h) if job.plan.object else None


def light_refusals(job: Job, history: History) -> list[str]:
    """Return reasons why the object may receive no more light at all."""
    plan_object, budget = job.plan.object, allowed_lux_h(job, history)
    if plan_object is None or budget is None or history.total_lux_h < budget:
        return []
    return [
        f"object {plan_object.id}: it has received {history.total_lux_h:.2f} lux.h; its budget is {budget:g} lux.h"
    ]


def ledger_warnings(job: Job, history: History, more_lux_h: float) -> list[str]:
    """Return warnings about the object's ledger, for the case that the object receives this much more light."""
    if job.plan.object is None:
        return []
    name, warnings = job.plan.object.id, []
    limit_lux_h = history.warn_above_lux_h
    if limit_lux_h is not None and history.total_lux_h + more_lux_h > limit_lux_h:
        warnings.append(
            f"object {name}: {more_lux_h:.3f} lux.h after {history.total_lux_h:.3f} lux.h before; its ledger "
            f"warns above {limit_lux_h:g} lux.h"
        )
    if allowed_lux_h(job, history) is None and not in_world(job.cell.rig, dry_run=False):
        warnings.append(
            f"object {name}: nobody has set how much light it may receive: set it by `coupole dose {name} "
            f"--budget LUX_H --name NAME`"
        )
    if ids := similar_ids(job.cell.ledger_folder, name):
        warnings.append(
            f"object {name}: there is also a ledger of `{ids[0]}`, whose light is not counted. Is it the same "
            "object?"
        )
    if history.unreadable:
        warnings.append(f"object {name}: {history.unreadable_words}")
    return warnings


def _object_check(job: Job, itinerary: Itinerary, proven: Collection[ShotId]) -> ObjectCheck | None:
    """Check the object in the views that are not taken yet; None without a mesh."""
    if job.plan.object is None:
        return None
    schedule = job.schedule.without_proven(proven) if proven else job.schedule
    return check_object(job.plan.object.id, job.shape.corners_mm, job.cell.rig, schedule, itinerary)


def _badly_exposed(white: Sequence[ExposedWhite]) -> list[str]:
    """Return warnings if even the shortest exposure saturates white, or if even the longest exposure leaves it
    dark."""
    ends = [(white[0], "over-exposed"), (white[-1], "under-exposed")] if white else []
    return [
        f"{end.exposure_us} us: {verdict}: white reaches {end.brightest:.0%} of full scale under the brightest "
        f"LED, {end.median:.0%} under the median one"
        for end, verdict in ends
        if end.verdict() == verdict
    ]


def calibration_refusals(job: Job, *, camera: str | None = None, temperature_c: float | None = None) -> list[str]:
    """Return reasons why the records that plan or rig names are not valid here. Camera and temperature are
    compared later, with the opened devices (`Situation`)."""
    if job.calibrations is None:
        return []
    from coupole.calibration.in_force import refusals
    from coupole.preflight.situation import situation_of

    here = situation_of(job.cell.rig, camera=camera, temperature_c=temperature_c)
    return refusals(job.calibrations, here)


def _disk_us(rig: Rig, storage: StorageFacts) -> int:
    """Time in which the disk writes a frame, rounded up so that small fluctuations do not change the schedule; 0
    if unknown."""
    if not storage.write_bytes_s:
        return 0
    seconds = rig.frame_bytes / (DISK_SHARE * storage.write_bytes_s)
    return math.ceil(seconds * 1e6 / _DISK_GRAIN_US) * _DISK_GRAIN_US


def _at_cool_pace(job: Job, report: Report, check_at: Callable[[Pace], tuple[Job, Report]]) -> tuple[Job, Report]:
    """Return the job at the fastest pace at which LEDs do not get too hot. The job is unchanged if none of the
    tried paces is slow enough."""
    if not report.too_hot:
        return job, report
    paces = [replace(job.pace, led_duty=duty) for duty in LED_DUTIES]
    first = bisect_left(paces, True, key=lambda pace: not check_at(pace)[1].too_hot)
    return check_at(paces[first]) if first < len(paces) else (job, report)
