"""Reasons why a result cannot be made beside an acquisition. These reasons are found in plan, rig and records
before anything moves.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from coupole.calibration.calibrated_arm import has_axis_zeros
from coupole.calibration.earlier import read_earlier, refuse_read_otherwise
from coupole.calibration.light.frames import channels_of
from coupole.calibration.light.led_power_tile import calibrated_positions
from coupole.calibration.posed_camera import read_posed_camera
from coupole.calibration.record import Kind
from coupole.calibration.sources import About
from coupole.errors import CoupoleError, InputError, reason
from coupole.plan.light_selection import leds_of_plan
from coupole.plan.reading import PlanFiles, read_plan
from coupole.plan.rig_devices import described_arm, in_world
from coupole.reflectance.begun_beside import is_of_run
from coupole.reflectance.extraction.measured_run import (
    NEEDED,
    read_powers,
    records_by_kind,
    refuse_other_gain,
)
from coupole.scan.mesh_files import read_mesh
from coupole.storage.discarding import discarded_views, place_of_result
from coupole.storage.processing import default_result
from coupole.storage.run import Run

_CHECKED: tuple[Kind, ...] = ("dark", "response", "flat-field", "glare")


def reasons_against(plan: Path, rig: Path | None, result: Path | None, run: Path | None) -> list[str]:
    """List the reasons why `coupole reflectance RUN` could not make a result of this plan's run. Each reason has
    the place in the plan and the remedy. `result` is the folder, if one is named; `run` is the run's folder, if
    the run is resumed.
    """
    try:
        files = read_plan(plan, rig)
        return [*_of_folder(result, run), *_of_mesh(files), *_of_records(files)]
    except CoupoleError as error:
        return [f"--reflectance: {error}"]


def _of_folder(result: Path | None, run: Path | None) -> Iterator[str]:
    if run is not None and (other := _other_result(Run(run), result)):
        yield (
            f"--result: frames of this run were discarded for the samples in {other}; no other result can be made"
        )
    if result is None:
        return
    if not result.exists():
        existing = next(parent for parent in result.parents if parent.exists())
        if not existing.is_dir():
            yield f"--result {result}: expected a folder that can be made; {existing} is a file"
        elif why := _why_not_made(result, existing):
            yield f"--result {result}: expected a folder that can be made; {existing}: {why}"
        return
    is_own = run is not None and is_of_run(result, run.name)
    if not result.is_dir() or (not is_own and any(result.iterdir())):
        yield f"--result {result}: expected a new folder, or the folder of this run's result; found other content"


def _other_result(run: Run, result: Path | None) -> Path | None:
    """Return the folder of a different result that stands for discarded frames of the run, if there is one."""
    named = (result or default_result(run.folder)).resolve()
    places = (place_of_result(run, event) for event in discarded_views(run).values())
    return next((place for place in places if place.resolve() != named), None)


def _why_not_made(folder: Path, existing: Path) -> str:
    """Make the folder and remove it again. Return the reason if this failed, else nothing; `existing` is the
    nearest parent that exists."""
    why = ""
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        why = reason(error)
    for made in (folder, *folder.parents):
        if made == existing:
            break
        with contextlib.suppress(OSError):
            made.rmdir()
    return why


def _of_mesh(files: PlanFiles) -> Iterator[str]:
    if files.mesh_path is None:
        key = ("object",) if files.plan.object else ()
        message = "expected the object's mesh (`object: {id: ..., mesh: FILE}`), which --reflectance needs"
        yield str(files.document.problem(key, message))
        return
    read_mesh(files.mesh_path)


def _of_records(files: PlanFiles) -> Iterator[str]:
    by_kind = records_by_kind(files.record_paths or ())
    if missing := [kind for kind in NEEDED if kind not in by_kind]:
        message = (
            f"expected calibration records of the kinds {', '.join(NEEDED)}, which --reflectance needs; no "
            f"{', no '.join(missing)} is named. `coupole calibrate all --rig RIG` makes them"
        )
        in_plan = files.plan.calibrations is not None
        document, key = (files.document, ("calibrations",)) if in_plan else (files.cell.document, ())
        yield str(document.problem(key, message))
        return
    for check in (_check_camera, _check_leds):
        try:
            check(files, by_kind)
        except InputError as error:
            yield f"--reflectance: {error}"


def _check_camera(files: PlanFiles, by_kind: dict[str, Path]) -> None:
    """Raise InputError for records that do not match the settings of the rig's camera."""
    rig = files.cell.rig
    about, size_px = _about(files), (rig.sensor.width_px, rig.sensor.height_px)
    read_posed_camera(by_kind["hand-eye"], by_kind.get("camera"), about, size_px)
    if has_axis_zeros(by_kind["hand-eye"]) and described_arm(rig) is None:
        raise InputError(f"{by_kind['hand-eye']}: has zeros of axes, but the rig describes no arm")
    for kind in _CHECKED:
        if kind in by_kind:
            read_earlier(by_kind[kind], kind, about, size_px)
    powers = read_earlier(by_kind["led-power"], "led-power", about, size_px)
    refuse_other_gain(by_kind["led-power"], powers, files.plan.gain_db)
    refuse_read_otherwise(by_kind["led-power"], powers, by_kind)
    read_powers(by_kind["led-power"], channels_of(rig.sensor.bayer_pattern))


def _about(files: PlanFiles) -> About:
    """Describe the camera by the rig; the camera's identity is known only when it is open."""
    rig, lens = files.cell.rig, files.cell.rig.lens
    return About(
        is_simulated=in_world(rig, dry_run=False),
        focal_length_mm=lens.focal_length_mm,
        focus_distance_mm=lens.focus_distance_mm,
        f_number=lens.f_number,
        begun=datetime.now(UTC),
    )


def _check_leds(files: PlanFiles, by_kind: dict[str, Path]) -> None:
    """Raise InputError if the plan lights no single LEDs, or LEDs that the record does not have."""
    base_from_support = files.cell.rig.support.base_from_support.matrix()
    rows = leds_of_plan(files.plan, files.cell.leds, base_from_support)
    planned_leds = set(map(int, files.cell.leds.ids[rows]))
    if not planned_leds:
        message = "expected single LEDs, which --reflectance needs; the plan lights none"
        raise InputError([files.document.problem(("lights",), message)])
    known_leds = set(map(int, calibrated_positions(by_kind["leds"]).ids))
    if unknown := sorted(planned_leds - known_leds):
        raise InputError(
            f"{by_kind['leds']}: does not have LED {unknown[0]}, which the plan lights; calibrate anew"
        )
