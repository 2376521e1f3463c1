"""One plan with everything that it names, read and checked together: what the commands work on."""

from __future__ import annotations

import math
import shutil
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, Problem, StorageError
from coupole.geometry import apply
from coupole.motion.bodies import missing_link_meshes
from coupole.motion.collisions import CellBodies
from coupole.motion.itinerary import Itinerary, bodies_of, plan_itinerary
from coupole.motion.occlusion import Occlusion, Occlusions, occlusions_of
from coupole.plan import yamlfile
from coupole.plan.led_table import LedTable, read_led_table
from coupole.plan.plan import MeasuredObject, Plan
from coupole.plan.rig import Rig, driver_problems, in_world, planning_arm, runs_tables
from coupole.plan.shots import FASTEST, Pace, Schedule, ViewPose, build_schedule, missing_lights
from coupole.plan.yamlfile import Document
from coupole.preflight import ledger
from coupole.preflight.preflight import DISK_SHARE, Report, StorageFacts, check
from coupole.storage.frame_file import measure_write_speed
from coupole.storage.run import Inputs

if TYPE_CHECKING:
    from coupole.calibration.in_force import InForce

_SAME_PLACE_DEG = 1e-3
_DISK_GRAIN_US = 100
_LED_DUTIES = tuple(0.9**k for k in range(1, 33))
"""Tried in turn where LEDs get too hot: down to a thirtieth of the time alight."""
MM_PER_UNIT = {"mm": 1.0, "m": 1000.0, "um": 1e-3}


@dataclass(frozen=True)
class Cell:
    """A rig file, read, with its dome."""

    rig: Rig
    document: Document
    leds: LedTable

    @property
    def leds_path(self) -> Path:
        return self.document.resolve(self.rig.dome.leds)

    @property
    def storage_folder(self) -> Path:
        return self.document.resolve(self.rig.storage.folder)


@dataclass(frozen=True)
class Job:
    """A plan, its cell, its object and the schedule that follows from them."""

    plan: Plan
    document: Document
    cell: Cell
    mesh_path: Path | None
    object_corners_mm: NDArray[np.float64]
    """The object's mesh [triangles, 3, 3] in the support frame; none of them without a mesh."""
    object_points_support_mm: NDArray[np.float64]
    """[n, 3] corners and centre of the object's bounding box, or the views' targets: where dose is reckoned."""
    schedule: Schedule
    calibrations: tuple[InForce, ...] | None = None
    """The records that the plan names, or else its rig; None if they want none."""
    hidden_leds: Mapping[str, Sequence[int]] = field(default_factory=dict)
    """LEDs that were left out of views, by name of view."""
    pace: Pace = FASTEST
    """What holds the schedule's steps apart beside camera and LEDs."""
    _planned: list[tuple[tuple[str, ...], Sequence[float], Itinerary]] = field(default_factory=list, repr=False)

    def itinerary(self, views: Sequence[ViewPose], start_deg: Sequence[float]) -> Itinerary:
        """Ways to views from where the arm stands, clear of everything; remembered, so that what preflight planned
        from home need not be planned again where the arm does stand there."""
        names = tuple(view.name for view in views)
        for planned_names, planned_deg, itinerary in self._planned:
            if planned_names == names and np.allclose(planned_deg, start_deg, rtol=0, atol=_SAME_PLACE_DEG):
                return itinerary
        itinerary = plan_itinerary(views, self.cell.rig, self.bodies, start_deg, self.plan.order)
        self._planned.append((names, tuple(start_deg), itinerary))
        return itinerary

    def without_hidden(self, known: Mapping[str, Sequence[int]] | None = None) -> Job:
        """Where the plan wants hidden lights skipped: the same job without the LEDs that reach nothing of what a
        view sees; those that are `known`, if a run began without them, else as ways from home place the arm."""
        if self.plan.hidden_lights != "skip":
            return self
        hidden = dict(known) if known is not None else self._hidden_from_home()
        return replace(self, schedule=self.schedule.without(hidden), hidden_leds=hidden)

    def at(self, pace: Pace) -> Job:
        """The same job at another pace."""
        if pace == self.pace:
            return self
        schedule = schedule_of(self.plan, self.cell, pace).without(self.hidden_leds)
        return replace(self, schedule=schedule, pace=pace)

    def _hidden_from_home(self) -> dict[str, list[int]]:
        itinerary = self.itinerary(self.schedule.views, self.cell.rig.motion.home_joints_deg)
        hidden: dict[str, list[int]] = {}
        for view, visit, bursts in zip(self.schedule.views, itinerary.visits, self.schedule.bursts, strict=True):
            lit = {int(led) for burst in bursts for led in burst.table["led"]}
            occluded = self.occluded_leds(self.occlusions.at(visit.joints_deg)) if visit else []
            if leds := [led for led in occluded if led in lit]:
                hidden[view.name] = leds
        return hidden

    def occluded_leds(self, shadow: Occlusion) -> list[int]:
        """Ids of the LEDs that reach nothing of what a view sees."""
        return [int(led) for led in self.cell.leds.ids[shadow.occluded_leds()]]

    @cached_property
    def occlusions(self) -> Occlusions:
        """What the object, and in each posture arm and tool, hide of the LEDs."""
        targets = [view.target_mm for view in self.schedule.views if view.target_mm is not None]
        return occlusions_of(self.cell.rig, self.cell.leds, self.object_corners_mm, targets or [(0.0, 0.0, 0.0)])

    @cached_property
    def bodies(self) -> CellBodies:
        """Arm, tool and everything that they must not touch."""
        meshes = self.cell.rig.link_meshes
        folder = self.cell.document.resolve(meshes) if meshes else None
        return bodies_of(self.cell.rig, self.cell.leds, self.object_corners_mm, folder)

    @property
    def inputs(self) -> Inputs:
        others = [self.cell.leds_path] + ([self.mesh_path] if self.mesh_path else [])
        others += [item.path for item in self.calibrations or ()]
        return Inputs(self.document.path, self.cell.document.path, tuple(others))


def read_cell(path: Path) -> Cell:
    """Read a rig and its dome. Raises InputError with all problems."""
    document = yamlfile.read(path)
    rig, problems = document.problems(Rig)
    if rig is None:
        raise InputError(problems)
    problems = driver_problems(document, rig)
    leds: LedTable | None = None
    leds_path = document.resolve(rig.dome.leds)
    if not leds_path.is_file():
        problems.append(document.problem(("dome", "leds"), f"expected the dome's CSV; there is no {leds_path}"))
    else:
        try:
            leds = read_led_table(leds_path)
        except InputError as error:
            problems += error.problems
    if rig.storage.pixels == "packed12" and (rig.sensor.bit_depth > 12 or rig.sensor.width_px % 2):
        why = f"expected an even width and 12 bits at most, found {rig.sensor.width_px} and {rig.sensor.bit_depth}"
        problems.append(document.problem(("storage", "pixels"), f"frames cannot be packed: {why}"))
    if rig.link_meshes is not None and (missing := missing_link_meshes(document.resolve(rig.link_meshes))):
        problems.append(
            document.problem(("link_meshes",), f"expected the links' meshes; there is no {missing[0]}")
        )
    if problems or leds is None:
        raise InputError(problems)
    return Cell(rig, document, leds)


def read_job(plan_path: Path, rig_path: Path | None = None) -> Job:
    """Read a plan and everything that it names. Raises InputError with all problems of all files."""
    document = yamlfile.read(plan_path)
    plan, problems = document.problems(Plan)
    cell: Cell | None = None
    rig_path = rig_path or _named_rig(document)
    if rig_path is not None and not rig_path.is_file():
        problems.append(document.problem(("rig",), f"expected a rig file; there is no {rig_path}"))
    elif rig_path is not None:
        try:
            cell = read_cell(rig_path)
        except InputError as error:
            problems += error.problems
    if plan is None or cell is None:
        raise InputError(problems)

    problems += [document.problem(key, message) for key, message in missing_lights(plan, cell.leds)]
    mesh_path = document.resolve(plan.object.mesh) if plan.object and plan.object.mesh else None
    corners, mesh_problem = _object_corners(plan, mesh_path)
    if mesh_problem:
        problems.append(document.problem(("object", "mesh"), mesh_problem))
    records, missing = _named_records(document, plan, cell)
    problems += missing
    problems += _bad_exposures(document, plan, cell.rig)
    if problems:
        raise InputError(problems)
    return Job(
        plan,
        document,
        cell,
        mesh_path,
        corners,
        _dose_points(plan, corners),
        schedule_of(plan, cell),
        calibrations=_in_force(records),
    )


def _named_records(document: Document, plan: Plan, cell: Cell) -> tuple[list[Path] | None, list[Problem]]:
    """Files of the records that the plan names, or else its rig, None if it wants none; and which are missing."""
    named = plan.calibrations
    if named is None:
        document, named = cell.document, cell.rig.calibrations
    if named == "none":
        return None, []
    paths = [document.resolve(path) for path in named]
    return paths, [
        document.problem(("calibrations", i), f"expected a calibration record; there is no {path}")
        for i, path in enumerate(paths)
        if not path.is_file()
    ]


def _in_force(paths: list[Path] | None) -> tuple[InForce, ...] | None:
    """Raises InputError with the problems of all records."""
    if paths is None:
        return None
    from coupole.calibration.in_force import read_in_force

    return read_in_force(paths)


def schedule_of(plan: Plan, cell: Cell, pace: Pace = FASTEST) -> Schedule:
    """All bursts of all views of a plan, at the times that the cell's camera and LEDs and the pace allow."""
    return build_schedule(
        plan,
        cell.leds,
        cell.rig.support.base_from_support.matrix(),
        rise_us=cell.rig.led_limits.rise_us,
        readout_us=1e6 / cell.rig.sensor.max_frames_per_s,
        exposure_gap_us=cell.rig.sensor.exposure_gap_us,
        pace=pace,
        runs_tables=runs_tables(cell.rig),
    )


def _named_rig(document: Document) -> Path | None:
    named = document.data.get("rig")
    return document.resolve(Path(named)) if isinstance(named, str) else None


def _bad_exposures(document: Document, plan: Plan, rig: Rig) -> list[Problem]:
    """Names that would collide are found by preflight; here, what no order of shots could make right."""
    if plan.trigger == "software" and rig.led_limits.on_us[1] < max(plan.exposure.exposures_us):
        return [document.problem(("exposure",), "longer than the rig's LEDs may be on")]
    return []


def _object_corners(plan: Plan, mesh_path: Path | None) -> tuple[NDArray[np.float64], str]:
    """The object's triangles in the support frame and, if the mesh cannot be read, why."""
    nothing = np.zeros((0, 3, 3))
    if mesh_path is None:
        return nothing, ""
    assert plan.object is not None
    if not mesh_path.is_file():
        return nothing, f"expected a mesh file (PLY, STL, OBJ); there is no {mesh_path}"
    try:
        return load_corners(mesh_path, plan.object), ""
    except Exception as error:  # noqa: BLE001  whatever trimesh raises, the file is not a mesh to us
        return nothing, f"cannot read the mesh {mesh_path}: {error}"


def load_corners(mesh_path: Path, measured: MeasuredObject) -> NDArray[np.float64]:
    """Triangles [n, 3, 3] of a mesh file in the support frame, mm. Raises whatever trimesh raises."""
    import trimesh

    loaded: Any = trimesh.load(mesh_path, process=False, force="mesh")
    if len(loaded.faces) == 0:
        raise ValueError("it has no triangles")
    corners = np.asarray(loaded.vertices)[np.asarray(loaded.faces)] * MM_PER_UNIT[measured.mesh_unit]
    if not np.isfinite(corners).all():
        raise ValueError("it has vertices that are no finite numbers")
    return apply(measured.support_from_object.matrix(), corners)


def _dose_points(plan: Plan, corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners and centre [9, 3] of the object's bounding box; the views' targets where there is no mesh."""
    if len(corners) == 0:
        targets = [view.target_mm for view in plan.views if hasattr(view, "target_mm")]
        return np.array(targets or [(0.0, 0.0, 0.0)])
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    box = [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    return np.concatenate([box, [(low + high) / 2]])


def preflight_of(
    job: Job, folder: Path, *, paths: bool = True, allocated_bytes: int = 0, share_left: float = 1.0
) -> tuple[Job, Report]:
    """Preflight's report on a job whose run would lie in `folder`, and the job at the pace that LEDs and the disk
    there, which is measured, allow.

    Without `paths` nothing is checked for collisions. Of a run to be resumed, `allocated_bytes` lie there already
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
    return check_job(job, StorageFacts(free_bytes, write_bytes_s), paths=paths, share_left=share_left)


def check_job(
    job: Job, storage: StorageFacts, *, paths: bool = True, share_left: float = 1.0
) -> tuple[Job, Report]:
    """Preflight's report on a job, given what is known of the disk; and the job at the pace that both allow."""
    rig = job.cell.rig
    home_deg = rig.motion.home_joints_deg
    if paths:
        itinerary = job.itinerary(job.schedule.views, home_deg)
    else:
        itinerary = plan_itinerary(job.schedule.views, rig, None, home_deg, job.plan.order)
    before = ledger.total_lux_h(job.cell.storage_folder, job.plan.object.id) if job.plan.object else 0.0

    def checked(pace: Pace) -> tuple[Job, Report]:
        paced = job.at(pace)
        report = check(
            job.plan,
            rig,
            paced.schedule,
            job.cell.leds,
            storage,
            itinerary,
            object_points_support_mm=job.object_points_support_mm,
            dose_before_lux_h=before,
            share_left=share_left,
        )
        return paced, report

    job, report = _cooled(*checked(Pace(disk_us=_disk_us(rig, storage))), checked)
    report.refusals += calibration_refusals(job)
    if job.plan.trigger == "hardware" and not runs_tables(rig):
        why = "cannot trigger the camera: it runs no tables. Set `trigger: software` in the plan"
        report.refusals.insert(0, f"led box {rig.ledbox.driver}: {why}")
    if planning_arm(rig) is None:
        why = "no model of this arm's links: whether it touches anything cannot be told"
        report.refusals.insert(0, f"robot {rig.robot.driver}: {why}")
    return job, report


def calibration_refusals(job: Job, *, camera: str | None = None, temperature_c: float | None = None) -> list[str]:
    """Why the records that plan or rig names do not hold here. Which camera there is and how warm the cell is,
    only its devices know (`Situation`)."""
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
    """Time in which the disk takes a frame, rounded up so that its moods do not show; 0 if unknown."""
    if not storage.write_bytes_s:
        return 0
    seconds = rig.frame_bytes / (DISK_SHARE * storage.write_bytes_s)
    return math.ceil(seconds * 1e6 / _DISK_GRAIN_US) * _DISK_GRAIN_US


def _cooled(job: Job, report: Report, checked: Callable[[Pace], tuple[Job, Report]]) -> tuple[Job, Report]:
    """Where LEDs get too hot: the fastest pace at which they do not; as it was if none of those tried will do."""
    if not report.too_hot:
        return job, report
    paces = [replace(job.pace, led_duty=duty) for duty in _LED_DUTIES]
    first = bisect_left(paces, True, key=lambda pace: not checked(pace)[1].too_hot)
    return checked(paces[first]) if first < len(paces) else (job, report)
