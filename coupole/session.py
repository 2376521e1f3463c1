"""One `coupole acquire` from reading the plan to the last journal line, for real or as a rehearsal."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from coupole import ledger, metering, report
from coupole.cell import OpenedCell, open_cell
from coupole.console import LiveFigures, RunObserver, ask, show_dry_run, show_preflight
from coupole.devices import Identity
from coupole.errors import (
    CoupoleError,
    DeviceError,
    DeviceFault,
    InputError,
    Interrupted,
    PreflightRefused,
    StorageError,
)
from coupole.geometry import apply
from coupole.job import Cell, Job, check_job, preflight_of, schedule_of
from coupole.live import CellSource, Choice, RunSource, Source, Studio, choice_from, run_source
from coupole.live_page import serve
from coupole.observer import Control, Outcome
from coupole.preflight import Report, StorageFacts
from coupole.recorder import DryRecorder, RunRecorder
from coupole.rig import Rig, in_world
from coupole.run import Run, is_shot
from coupole.sequencer import Sequencer
from coupole.shots import EXPOSURE_MARGIN_US, Schedule, leds_of_plan


def _refuse(found: Report) -> None:
    if found.refusals:
        raise PreflightRefused(found.refusals)


@contextmanager
def _operator(control: Control) -> Iterator[None]:
    """Ctrl-C and SIGTERM stop, SIGUSR1 pauses and goes on; as before when this ends."""

    def stop(*_: Any) -> None:
        control.stop.set()

    def pause(*_: Any) -> None:
        (control.pause.clear if control.pause.is_set() else control.pause.set)()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    wanted = {signal.SIGINT: stop, signal.SIGTERM: stop, signal.SIGUSR1: pause}
    before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


_FIGURES_EVERY_S = 0.2
UNLIMITED_BYTES = 2**62
"""A rehearsal keeps nothing: the disk does not matter."""


# -- the run ----------------------------------------------------------------------------------------------


def acquire_plan(
    job: Job,
    console: Console,
    *,
    parent: Path | None,
    resume: Path | None,
    confirm: bool,
    found: dict[str, Any],
) -> None:
    """Run a plan into a run folder; `found` is filled with the figures of `--json`, also when this raises."""
    with contextlib.ExitStack() as held:
        run = Run(resume) if resume else None
        if run is not None:
            held.callback(os.close, run.lock())
            run.refuse_changes(job.inputs)
        job = job.without_hidden(run.hidden_leds if run else None)
        _acquire_into(run, job, console, parent=parent, confirm=confirm, found=found, held=held)


def _acquire_into(
    run: Run | None,
    job: Job,
    console: Console,
    *,
    parent: Path | None,
    confirm: bool,
    found: dict[str, Any],
    held: contextlib.ExitStack,
) -> None:
    resumed = run is not None
    folder = (run.folder if run else parent or job.cell.storage_folder).resolve()
    job, preflight = preflight_of(
        job,
        folder,
        allocated_bytes=run.allocated_bytes() if run else 0,
        share_left=1.0 - len(run.proven()) / job.schedule.frames if run else 1.0,
    )
    show_preflight(console, preflight, name=job.plan.name, rig=job.cell.rig.name)
    _refuse(preflight)
    acknowledged = _ask_whether_clear(run.robot_fault()) if run else ""
    _ask_to_begin(job.cell, confirm=confirm)
    console.print("opening the devices ...")
    with open_cell(job.cell, job=job, on_opened=_teller(console)) as cell:
        if run is None:
            run = Run.create(folder, job.plan.name, job.inputs, about_run(job, cell))
            held.callback(os.close, run.lock())
        console.print(f"run {run.folder}")
        packed = job.cell.rig.storage.pixels == "packed12"
        recorder = RunRecorder(run, metadata_of_views(job, cell), packed=packed)
        try:
            how = {"simulated": cell.simulated, **({"acknowledged": acknowledged} if acknowledged else {})}
            recorder.event("resume" if resumed else "start", **how)
            _acquire(job, cell, run, recorder, console, found=found)
        except CoupoleError:
            with contextlib.suppress(StorageError):  # what ended the run matters more than its report
                report.write(run)
            raise
        else:
            report.write(run)
        finally:
            recorder.close()


def _ask_to_begin(cell: Cell, *, confirm: bool) -> None:
    """Nothing real moves or shines unasked."""
    real = not in_world(cell.rig, dry_run=False)
    if real and confirm and not ask("Move the arm and light the object?"):
        raise Interrupted("not started: answer the question, or say `--yes`")


def _longest_exposure_us(rig: Rig) -> int:
    """What the LEDs' longest on-time leaves for the exposure."""
    return rig.led_limits.on_us[1] - rig.led_limits.rise_us - EXPOSURE_MARGIN_US


def _enter_dose(job: Job, cell: OpenedCell, dose_lux_h: float, what_for: str) -> None:
    """Light that a real cell gave an object goes into the object's ledger."""
    if job.plan.object and not cell.simulated:
        ledger.add(job.cell.storage_folder, job.plan.object.id, run=what_for, dose_lux_h=dose_lux_h)


def _ask_whether_clear(fault: str) -> str:
    """After a fault of the arm a person must say that it may move again; `--yes` does not say it.

    Returns the fault that was acknowledged, empty if there was none. Raises DeviceFault without that word.
    """
    if not fault:
        return ""
    if not ask(
        f"The arm stopped in a fault: {fault}\nIs the cause found, the cell clear, and may the arm move again?"
    ):
        raise DeviceFault(
            "robot",
            expected="the word of a person who has been to the cell",
            happened="nobody said that the arm may move again",
            remedy="See to the cell, then resume from a terminal and answer the question (`--yes` does not).",
        )
    return fault


def _teller(console: Console) -> Any:
    def tell(kind: str, identity: Identity) -> None:
        how = " (simulated)" if identity.simulated else ""
        console.print(f"  {kind}: {identity.vendor} {identity.model} {identity.serial}{how}")

    return tell


def about_run(job: Job, cell: OpenedCell) -> dict[str, Any]:
    """What stands in run.json beside the inputs."""
    return {
        "simulated": cell.simulated,
        "object": job.plan.object.id if job.plan.object else None,
        "calibrations": {item.record.kind: item.record.sha256 for item in job.calibrations} or "none",
        "devices": {kind: vars(identity) for kind, identity in cell.identities.items()},
        "scaling": cell.world_endpoints["camera"]["scaling"] if cell.world_endpoints else None,
        "views": [view.name for view in job.schedule.views],
        "labels": _labels(job.schedule),
        "hidden_leds": job.hidden_leds,
        "expected": {"shots": job.schedule.shots, "frames": job.schedule.frames},
    }


def _labels(schedule: Schedule) -> list[str] | dict[str, list[str]]:
    """One list where all views have the same frames; else one for each view, by its name."""
    if len(set(schedule.labels)) == 1:
        return list(schedule.labels[0])
    return {view.name: list(labels) for view, labels in zip(schedule.views, schedule.labels, strict=True)}


def metadata_of_views(job: Job, cell: OpenedCell) -> dict[str, Any]:
    """Attributes of every view's file."""
    rig = job.cell.rig
    return {
        "program_name": "coupole",
        "sample": job.plan.object.id if job.plan.object else "none",
        "simulated": cell.simulated,
        "pixel_pitch_um": cell.sensor.pixel_pitch_um,
        "focal_length_mm": rig.lens.focal_length_mm,
        "f_number": rig.lens.f_number,
        "focus_distance_mm": rig.lens.focus_distance_mm,
        "base_from_support": rig.support.base_from_support.matrix(),
        "camera": " ".join((cell.identities["camera"].model, cell.identities["camera"].serial)),
        "gain_db": job.plan.gain_db,
    }


def _acquire(
    job: Job,
    cell: OpenedCell,
    run: Run,
    recorder: RunRecorder,
    console: Console,
    *,
    found: dict[str, Any],
) -> None:
    control = Control()
    observer = RunObserver(console, job.cell.rig.frame_bytes, len(recorder.proven()))
    sequencer = Sequencer(job, cell, recorder, observer=observer, control=control)
    outcome = sequencer.outcome
    ended = "done"
    try:
        with _operator(control), observer.showing(job.schedule.frames, len(job.schedule.views)):
            sequencer.acquire()
    except CoupoleError as error:
        ended = "interrupted" if isinstance(error, Interrupted) else "failed"
        whose = {"device": error.device} if isinstance(error, DeviceError) else {}
        recorder.event("fault", kind=type(error).__name__, message=str(error), **whose)
        raise
    finally:
        cell.make_safe()
        for trouble in cell.trouble:
            recorder.event("fault", kind="unsafe", message=trouble)
            console.print(f"[red]{trouble}[/]")
        recorder.event("stop", outcome=ended, robot=dict(cell.robot.statistics()))
        recorder.close_quietly()
        _enter_dose(job, cell, outcome.dose_lux_h, run.folder.name)
        found.update(_figures(run, job, outcome))
        _say_outcome(console, run, outcome, ended)


def _figures(run: Run, job: Job, outcome: Outcome) -> dict[str, Any]:
    """The figures of `--json`."""
    frames = len(run.proven())
    return {
        "run": str(run.folder),
        "shots": outcome.shots,
        "proven": sum(map(is_shot, run.proven())),
        "missing": len(outcome.missing),
        "reshot": outcome.reshot,
        "bad": len(outcome.bad),
        "frames": frames,
        "bytes": frames * job.cell.rig.frame_bytes,
        "duration_s": round(outcome.duration_s, 3),
        "ideal_s": round(outcome.ideal_s, 3),
        "efficiency": round(outcome.ideal_s / outcome.duration_s, 4) if outcome.duration_s else 1.0,
        "dose_lux_h": outcome.dose_lux_h,
    }


def _say_outcome(console: Console, run: Run, outcome: Outcome, ended: str) -> None:
    console.print(
        f"{ended}: {outcome.proven} of {outcome.shots} shots proven, {outcome.reshot} re-shot, "
        f"{outcome.duration_s:.1f} s (at best {outcome.ideal_s:.1f} s), {outcome.dose_lux_h:.3f} lux.h"
    )
    console.print(f"  frames  {run.folder / 'views'}\n  report  {run.folder / 'report.html'}")
    if ended != "done":
        console.print(f"  go on with --resume {run.folder}")


# -- exposure advice --------------------------------------------------------------------------------------


def meter(job: Job, console: Console, wish: metering.Wish, *, confirm: bool) -> metering.Advice:
    """Take a few pictures of each view under lights spread over the dome, keep none, and advise on exposure.

    The light that this gives the object is entered in its ledger. Raises PreflightRefused, DeviceError,
    Interrupted, and UnprovenError where pictures stay missing.
    """
    cell_leds, base_from_support = job.cell.leds, job.cell.rig.support.base_from_support.matrix()
    few = metering.metering_plan(job.plan, cell_leds, leds_of_plan(job.plan, cell_leds, base_from_support))
    small = replace(job, plan=few, schedule=schedule_of(few, job.cell))
    small, preflight = check_job(small, StorageFacts(UNLIMITED_BYTES))
    _refuse(preflight)
    _ask_to_begin(job.cell, confirm=confirm)
    recorder, control = metering.MeterRecorder(), Control()
    with open_cell(job.cell, job=small, on_opened=_teller(console)) as cell:
        observer = RunObserver(console, job.cell.rig.frame_bytes, 0)
        sequencer = Sequencer(small, cell, recorder, observer=observer, control=control)
        try:
            with _operator(control), observer.showing(small.schedule.frames, len(small.schedule.views)):
                sequencer.acquire()
        finally:
            cell.make_safe()
            _enter_dose(job, cell, sequencer.outcome.dose_lux_h, "meter")
    return metering.advise(recorder.views, wish, longest_us=_longest_exposure_us(job.cell.rig))


# -- live view --------------------------------------------------------------------------------------------


def watch_cell(
    job_or_cell: Job | Cell, console: Console, choice: Choice, *, frames_per_s: float, port: int, confirm: bool
) -> None:
    """Show a cell's camera until the operator says stop; the arm is held where it stands."""
    job = job_or_cell if isinstance(job_or_cell, Job) else None
    rig_cell = job_or_cell.cell if isinstance(job_or_cell, Job) else job_or_cell
    rig, leds = rig_cell.rig, rig_cell.leds
    centre = rig.support.base_from_support.matrix()[:3, 3]
    points = apply(rig.support.base_from_support.matrix(), job.object_points_support_mm) if job else centre[None]
    lux_of_row = leds.illuminance_lux(points, emission=rig.dome.emission).max(axis=0)
    lux = dict(zip(leds.ids.tolist(), lux_of_row.tolist(), strict=True))
    ids = tuple(leds.ids.tolist())
    studio = Studio(choice_from(vars(choice), choice, ids, _longest_exposure_us(rig)))
    _ask_to_begin(rig_cell, confirm=confirm)
    with open_cell(rig_cell, job=job, on_opened=_teller(console)) as cell:
        source = CellSource(cell, rig, leds, lux.__getitem__, frames_per_s=frames_per_s)
        try:
            _show_live(source, studio, console, port, longest_us=_longest_exposure_us(rig))
        finally:
            given = studio.shown.dose_lux_h if studio.shown else 0.0
            if job is not None and given:
                _enter_dose(job, cell, given, "live")


def watch_run(folder: Path, console: Console, *, port: int) -> None:
    """Show the newest proven frame of a run until the operator says stop."""
    _show_live(RunSource(folder), Studio(Choice(None, 0)), console, port, longest_us=0)


def _show_live(source: Source, studio: Studio, console: Console, port: int, *, longest_us: int) -> None:
    try:
        server = serve(studio, source.leds, longest_us, port)
    except OSError as error:
        raise InputError(f"--port {port}: cannot serve the page there: {error.strerror}") from error
    failures: list[Exception] = []
    control = Control()
    page = threading.Thread(target=server.serve_forever, name="page", daemon=True)
    page.start()
    console.print(f"live at http://127.0.0.1:{server.server_port}/  (Ctrl-C ends it)")
    with _operator(control):
        filling = run_source(source, studio, failures.append)
        try:
            with LiveFigures(console) as figures:
                while not studio.closing.is_set() and not control.stop.is_set():
                    figures.show(studio.shown)
                    studio.closing.wait(_FIGURES_EVERY_S)
        finally:
            studio.closing.set()
            filling.join()
            server.shutdown()
            server.server_close()
    if failures:
        raise failures[0]


# -- the rehearsal ----------------------------------------------------------------------------------------


def rehearse(job: Job, console: Console, *, speed: float, found: dict[str, Any]) -> None:
    """Run a whole plan on the rig's twin, faster than life, and say what preflight could not know."""
    job = job.without_hidden()
    job, preflight = check_job(job, StorageFacts(UNLIMITED_BYTES))
    show_preflight(console, preflight, name=job.plan.name, rig=f"the twin of {job.cell.rig.name}")
    _refuse(preflight)
    recorder, control = DryRecorder(), Control()
    with open_cell(job.cell, job=job, dry_run=True, speed=speed, on_opened=_teller(console)) as cell:
        observer = RunObserver(console, cell.sensor.width_px * cell.sensor.height_px * 2, 0)
        sequencer = Sequencer(job, cell, recorder, observer=observer, control=control)
        outcome = sequencer.outcome
        started_s = time.monotonic()
        try:
            with _operator(control), observer.showing(job.schedule.frames, len(job.schedule.views)):
                sequencer.acquire()
        finally:
            machine_s = time.monotonic() - started_s
            found.update(
                {
                    "dry_run": True,
                    "shots": outcome.shots,
                    "proven": outcome.proven,
                    "missing": len(outcome.missing),
                    "reshot": outcome.reshot,
                    "duration_s": round(outcome.duration_s, 3),
                    "preflight_s": round(preflight.duration_s, 3),
                    "ideal_s": round(outcome.ideal_s, 3),
                    "machine_s": round(machine_s, 3),
                    "speed": round(outcome.duration_s / machine_s, 2),
                    "speed_asked": speed,
                    "over_triggers": outcome.over_triggers,
                    "exposure": {
                        view: {
                            "pictures": seen.pictures,
                            "brightest": round(seen.brightest, 4),
                            "saturated": round(seen.saturated, 6),
                            "verdict": seen.verdict(),
                        }
                        for view, seen in recorder.exposures.items()
                    },
                }
            )
            show_dry_run(console, recorder, outcome, found)
