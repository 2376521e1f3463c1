"""Uses of the camera that store no frames: exposure advice and the live view."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from coupole.acquisition.live_cell import CellSource
from coupole.acquisition.observer import Control
from coupole.acquisition.opened_cell import open_cell
from coupole.acquisition.operator import (
    UNLIMITED_BYTES,
    ask_to_begin,
    enter_dose,
    identity_printer,
    longest_exposure_us,
    refuse,
    refuse_uncommissioned,
)
from coupole.acquisition.sequencer import Sequencer
from coupole.acquisition.signals import obeyed_by
from coupole.errors import InputError
from coupole.geometry import apply
from coupole.plan.cell import Cell
from coupole.plan.light_selection import leds_of_plan
from coupole.preflight import exposure_advice
from coupole.preflight.checking import check_job
from coupole.preflight.job import Job, schedule_of
from coupole.preflight.preflight import StorageFacts
from coupole.storage.arm_faults import ArmFaults
from coupole.viewing.live import Choice, RunSource, Source, Studio, choice_from, run_source
from coupole.viewing.live_page import serve
from coupole.viewing.terminal import LiveFigures, RunObserver

_FIGURES_EVERY_S = 0.2


def meter(
    job: Job, console: Console, request: exposure_advice.Request, *, confirm: bool
) -> exposure_advice.Advice:
    """Take a few pictures of each view under lights spread over the dome, keep none, and advise on exposure.

    The light on the object is entered in its dose ledger. Raises PreflightRefused, DeviceError, Interrupted, and
    UnprovenError if pictures remain missing.
    """
    cell_leds, base_from_support = job.cell.leds, job.cell.rig.support.base_from_support.matrix()
    few = exposure_advice.metering_plan(job.plan, cell_leds, leds_of_plan(job.plan, cell_leds, base_from_support))
    small = replace(job, plan=few, schedule=schedule_of(few, job.cell))
    small, preflight = check_job(small, StorageFacts(UNLIMITED_BYTES))
    refuse(preflight)
    refuse_uncommissioned(job.cell)
    ArmFaults(job.cell.state_folder).refuse(job.cell.document.path)
    ask_to_begin(job.cell, confirm=confirm)
    recorder, control = exposure_advice.MeterRecorder(), Control()
    with open_cell(job.cell, job=small, on_opened=identity_printer(console)) as cell:
        refuse_uncommissioned(job.cell, cell.identities)
        observer = RunObserver(console, job.cell.rig.frame_bytes, 0)
        sequencer = Sequencer(small, cell, recorder, observer=observer, control=control)
        try:
            with obeyed_by(control, cell.halt), observer.showing(small.schedule.frames, len(small.schedule.views)):
                sequencer.acquire()
        finally:
            cell.make_safe()
            enter_dose(job, cell, sequencer.outcome.dose_lux_h, "meter")
    return exposure_advice.advise(recorder.views, request, longest_us=longest_exposure_us(job.cell.rig))


def watch_cell(
    job_or_cell: Job | Cell, console: Console, choice: Choice, *, frames_per_s: float, port: int, confirm: bool
) -> None:
    """Show a cell's camera until the operator stops it; the arm does not move."""
    job = job_or_cell if isinstance(job_or_cell, Job) else None
    rig_cell = job_or_cell.cell if isinstance(job_or_cell, Job) else job_or_cell
    rig, leds = rig_cell.rig, rig_cell.leds
    centre = rig.support.base_from_support.matrix()[:3, 3]
    points = apply(rig.support.base_from_support.matrix(), job.shape.dose_points_mm) if job else centre[None]
    lux_of_row = leds.illuminance_lux(points, emission=rig.dome.emission).max(axis=0)
    lux = dict(zip(leds.ids.tolist(), lux_of_row.tolist(), strict=True))
    ids = tuple(leds.ids.tolist())
    studio = Studio(choice_from(vars(choice), choice, ids, longest_exposure_us(rig)))
    ArmFaults(rig_cell.state_folder).refuse(rig_cell.document.path)
    ask_to_begin(rig_cell, confirm=confirm)
    with open_cell(rig_cell, job=job, on_opened=identity_printer(console)) as cell:
        source = CellSource(cell, rig, leds, lux.__getitem__, frames_per_s=frames_per_s)
        try:
            _show_live(source, studio, console, port, longest_us=longest_exposure_us(rig), halt=cell.halt)
        finally:
            cell.make_safe()
            given = studio.shown.dose_lux_h if studio.shown else 0.0
            if job is not None and given:
                enter_dose(job, cell, given, "live")


def watch_run(folder: Path, console: Console, *, port: int) -> None:
    """Show the newest proven frame of a run until the operator stops it."""
    _show_live(RunSource(folder), Studio(Choice(None, 0)), console, port, longest_us=0, halt=lambda: None)


def _show_live(
    source: Source,
    studio: Studio,
    console: Console,
    port: int,
    *,
    longest_us: int,
    halt: Callable[[], object],
) -> None:
    """Until the operator stops it; `halt` is called as soon as he does."""
    try:
        server = serve(studio, source.leds, longest_us, port)
    except OSError as error:
        raise InputError(f"--port {port}: cannot serve the page there: {error.strerror}") from error
    failures: list[Exception] = []
    control = Control()
    page = threading.Thread(target=server.serve_forever, name="page", daemon=True)
    page.start()
    console.print(f"live at http://127.0.0.1:{server.server_port}/  (Ctrl-C ends it)")
    with obeyed_by(control, halt):
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
