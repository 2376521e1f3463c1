"""Uses of the camera that store no frames: exposure advice and the live view."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from coupole.acquisition.dose import FlashMeter
from coupole.acquisition.live_cell import CellSource
from coupole.acquisition.memory_recorder import MeterRecorder
from coupole.acquisition.observer import Control, Observer
from coupole.acquisition.opened_cell import OpenedCell, open_cell
from coupole.acquisition.operator import (
    UNLIMITED_BYTES,
    ask_to_begin,
    identity_printer,
    longest_exposure_us,
    refuse,
    refuse_uncommissioned,
)
from coupole.acquisition.sequencer import Sequencer
from coupole.acquisition.signals import Act, obeyed_by
from coupole.acquisition.single_shots import SingleShots
from coupole.bounded import NOW, refuse_overdue, run_bounded
from coupole.errors import CoupoleError, DeviceError, InputError, PreflightRefused
from coupole.geometry import apply
from coupole.plan.cell import Cell
from coupole.plan.light_selection import leds_of_plan
from coupole.preflight import exposure_advice
from coupole.preflight.checking import check_job, ledger_warnings, light_refusals
from coupole.preflight.job import Job, schedule_of
from coupole.preflight.preflight import StorageFacts
from coupole.storage.arm_faults import faults_of
from coupole.storage.ledger import ledger_of
from coupole.viewing.live import Choice, RunSource, Source, Studio, Wanted, choice_from, run_source
from coupole.viewing.live_page import serve
from coupole.viewing.terminal import LiveFigures, RunObserver, alarm

_FIGURES_EVERY_S = 0.2
LOOKS_ON = "this process only observes the run: the run continues"
"""Message when the stop of everything reaches a live view of a run, which has nothing to make safe."""


def meter(
    job: Job, console: Console, request: exposure_advice.Request, *, confirm: bool
) -> exposure_advice.Advice:
    """Take a few pictures of each view under lights spread over the dome, keep none, and advise on exposure.

    The light on the object is entered in its dose ledger. Raises PreflightRefused, DeviceError, Interrupted, and
    UnprovenError if pictures remain missing.
    """
    small = metering_job(job)
    refuse_uncommissioned(job.cell)
    faults_of(job.cell).refuse(job.cell.document.path)
    ask_to_begin(job.cell, confirm=confirm)
    control = Control()
    with open_cell(job.cell, job=small, on_opened=identity_printer(console)) as cell:
        refuse_uncommissioned(job.cell, cell.identities)
        faults_of(job.cell, cell.identities["robot"]).refuse(job.cell.document.path)
        observer = RunObserver(console, job.cell.rig.frame_bytes, 0)
        try:
            with obeyed_by(control, cell.halt), observer.showing(small.schedule.frames, len(small.schedule.views)):
                return metered(small, cell, request, control, observer)
        finally:
            cell.make_safe()


def metering_job(job: Job) -> Job:
    """The same job with a few pictures of each view. Raises PreflightRefused."""
    leds, base_from_support = job.cell.leds, job.cell.rig.support.base_from_support.matrix()
    few = exposure_advice.metering_plan(job.plan, leds, leds_of_plan(job.plan, leds, base_from_support))
    small = replace(job, plan=few, schedule=schedule_of(few, job.cell))
    small, preflight = check_job(small, StorageFacts(UNLIMITED_BYTES))
    refuse(preflight)
    return small


def metered(
    small: Job,
    cell: OpenedCell,
    request: exposure_advice.Request,
    control: Control,
    observer: Observer | None = None,
) -> exposure_advice.Advice:
    """Advice by the pictures of a metering job. When this raises the cell is safe and cannot be used any more."""
    recorder = MeterRecorder()
    sequencer = run_bounded(
        partial(Sequencer, small, cell, recorder, observer=observer, control=control, can_stand=False)
    )
    with control.explains(DeviceError):
        run_bounded(sequencer.acquire, stop=control.stop, rescue=cell.make_safe)
    return exposure_advice.advise(recorder.views, request, longest_us=longest_exposure_us(small.cell.rig))


def watch_cell(
    job_or_cell: Job | Cell, console: Console, choice: Choice, *, frames_per_s: float, port: int, confirm: bool
) -> None:
    """Show a cell's camera until the operator stops it, or the object's budget is reached; the arm does not move.

    The light on a plan's object is entered in its dose ledger. Raises PreflightRefused,
    DoseBudgetReached, DeviceError.
    """
    job = job_or_cell if isinstance(job_or_cell, Job) else None
    rig_cell = job_or_cell.cell if isinstance(job_or_cell, Job) else job_or_cell
    rig, leds = rig_cell.rig, rig_cell.leds
    longest_us = longest_exposure_us(rig)
    request = Wanted(led=choice.led, exposure_us=choice.exposure_us)
    studio = Studio(choice_from(request, choice, tuple(leds.ids.tolist()), longest_us))
    if job is None or job.plan.object is None:
        console.print(
            "without a plan no object is known, so the light is entered in no ledger; to enter it, give a plan"
        )
    else:
        _ask_the_ledger(job, console)
    faults_of(rig_cell).refuse(rig_cell.document.path)
    ask_to_begin(rig_cell, confirm=confirm)
    with open_cell(rig_cell, job=job, on_opened=identity_printer(console)) as cell:
        faults_of(rig_cell, cell.identities["robot"]).refuse(rig_cell.document.path)
        meter = FlashMeter(job, cell, "live", frames_per_s) if job else None
        shots = SingleShots(rig_cell, cell, lux_of_leds(rig_cell, job), meter, 1.0 / frames_per_s)
        source = CellSource(cell, shots, tuple(leds.ids.tolist()), meter)
        _show_live(source, studio, console, port, longest_us=longest_us, halt=cell.halt)


def lux_of_leds(cell: Cell, job: Job | None) -> NDArray[np.float64]:
    """Return [points, LEDs of the table] at the object's dose points, or at the support's centre if there is no
    job."""
    base_from_support = cell.rig.support.base_from_support.matrix()
    points = apply(base_from_support, job.shape.dose_points_mm) if job else base_from_support[None, :3, 3]
    return cell.leds.illuminance_lux(points, emission=cell.rig.dome.emission)


def _ask_the_ledger(job: Job, console: Console) -> None:
    """Raise PreflightRefused if the object may receive no more light. Print the warnings of its ledger."""
    assert job.plan.object is not None
    history = ledger_of(job.cell, job.plan.object.id).read_history()
    if refusals := light_refusals(job, history):
        raise PreflightRefused(refusals)
    for warning in ledger_warnings(job, history, 0.0):
        console.print(f"[yellow]note:[/] {warning}")


def watch_run(folder: Path, console: Console, *, port: int) -> None:
    """Show the newest proven frame of a run until the operator stops it."""
    _show_live(RunSource(folder), Studio(Choice(None, 0)), console, port, longest_us=0, halt=lambda: [LOOKS_ON])


def _show_live(
    source: Source,
    studio: Studio,
    console: Console,
    port: int,
    *,
    longest_us: int,
    halt: Act,
) -> None:
    """Show the live view until the operator stops it. `halt` is called as soon as this happens."""
    try:
        server = serve(studio, source.leds, longest_us, port)
    except OSError as error:
        raise InputError(f"--port {port}: cannot serve the page there: {error.strerror}") from error
    failures: list[Exception] = []
    control = Control()
    page = threading.Thread(target=server.serve_forever, name="page", daemon=True)
    page.start()
    console.print(f"live at {server.url}  (Ctrl-C ends it)", soft_wrap=True)
    last_remark = ""
    with obeyed_by(control, halt):
        began_s = time.monotonic()
        filling = run_source(source, studio, failures.append)
        try:
            with LiveFigures(console) as figures:
                while not studio.closing.is_set() and not control.stop.is_set():
                    refuse_overdue(began_s)
                    figures.show(studio.shown_frame)
                    if studio.remark != last_remark:
                        last_remark = studio.remark
                        console.print(last_remark or "a page is open", markup=False)
                    studio.closing.wait(_FIGURES_EVERY_S)
        finally:
            studio.closing.set()
            try:
                run_bounded(filling.join, stop=NOW, since_s=began_s)
            except CoupoleError as error:
                failures.append(error)
                alarm(str(error))
            server.shutdown()
            server.server_close()
    if control.stop.is_set():  # what failed then was ended by `halt`
        if not control.stopped_by_hand:
            raise control.interruption()
    elif failures:
        raise failures[0]
