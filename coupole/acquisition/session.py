"""One `coupole acquire` from reading the plan to the last journal line."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.console import Console

from coupole.acquisition.changed_inputs import tell_changes
from coupole.acquisition.compiled_ahead import compile_ahead
from coupole.acquisition.conclusion import close_complete, conclude, note_unread, open_for_session
from coupole.acquisition.observer import Control
from coupole.acquisition.opened_cell import OpenedCell, open_cell
from coupole.acquisition.operator import (
    ask_to_begin,
    identity_printer,
    refuse,
    refuse_uncommissioned,
)
from coupole.acquisition.recorder import RunRecorder
from coupole.acquisition.run_control import RunControl, RunPaths
from coupole.acquisition.run_description import about_run, camera_name, described_cell, metadata_of_views
from coupole.acquisition.sequencer import Sequencer
from coupole.acquisition.session_failure import (
    note_failure,
    note_faults_of_the_arm,
    note_what_hangs,
    statistics,
)
from coupole.acquisition.signals import SignalReceived, obeyed_by
from coupole.bounded import left_behind, on_disk, run_bounded
from coupole.errors import (
    Interrupted,
    PreflightRefused,
    StorageError,
    unsafe_end,
)
from coupole.plan.rig_devices import trusted_by_name
from coupole.plan.shot_id import ShotId
from coupole.preflight.checking import calibration_refusals, preflight_of
from coupole.preflight.discard_room import discard_room
from coupole.preflight.job import Job, with_choices, without_hidden
from coupole.storage.arm_faults import ArmFaults, faults_of
from coupole.storage.discarding import finish as finish_discarding
from coupole.storage.journal_events import (
    FaultNoted,
    ProcessingAsked,
    SessionResumed,
    SessionStarted,
    SessionStopped,
)
from coupole.storage.run import Occupied, Run
from coupole.storage.run_inputs import copied_s
from coupole.storage.view_reader import refuse_lost
from coupole.viewing.keys import key_actions
from coupole.viewing.preflight_table import show_preflight
from coupole.viewing.progress import Outcome
from coupole.viewing.terminal import RunObserver, alarm

if TYPE_CHECKING:
    from coupole.acquisition.processing_beside import ProcessingBeside

_ASKED_BOARDS = 12
"""Number of boards, spread over the dome, at which the temperature is read."""


# -- the run ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SessionRequest:
    """A request for a session, in addition to the session's plan."""

    parent: Path | None
    """Folder for the run's folder; None: the rig's."""
    resume: Path | None
    """A run to be resumed; None begins one."""
    confirm: bool
    """True if a person is asked before the arm of a real cell moves."""
    with_mesh: bool = False
    """True to copy a mesh of more than 100 MB into the folder too."""
    beside: ProcessingBeside | None = None
    """Processes the run's views while it is acquired."""
    when_served: Callable[[Path], bool] = lambda _: False
    """Called when the run has a socket of its own."""


@dataclass(frozen=True)
class _Session:
    """A session whose devices and journal are open."""

    cell: OpenedCell
    run: Run
    recorder: RunRecorder
    faults: ArmFaults
    begun_s: float
    """Time of its first line in the journal, by `_unset_clock_s`."""
    when_served: Callable[[Path], bool]


def acquire_plan(job: Job, console: Console, request: SessionRequest, figures: dict[str, Any]) -> None:
    """Run a plan into a run folder. `figures` is filled with the figures of `--json`, even if this raises."""
    with _failure_first() as ending:
        run = Run(request.resume) if request.resume else None
        if run is not None:
            ending.stack.callback(os.close, run.lock())
            run.refuse_old_journal()
            run.refuse_changes(job.inputs)
            refuse_lost(run.folder, run.proven().values())
        job = without_hidden(job, run.hidden_leds if run else None)
        job = with_choices(job, run.choices() if run else {}, run.chosen_views() if run else ())
        _acquire_into(run, job, console, request, figures, ending)


@dataclass
class _Ending:
    """Work that a session leaves for its end, and the failure that ended it."""

    stack: contextlib.ExitStack
    failure: BaseException | None = None

    @contextlib.contextmanager
    def noting_failure(self) -> Iterator[None]:
        """Note what ends the session itself."""
        try:
            yield
        except BaseException as error:
            self.failure = error
            raise


@contextlib.contextmanager
def _failure_first() -> Iterator[_Ending]:
    """Do at the end what a session leaves to be done. A signal that comes then does not take the place of the
    failure that ended the session: the failure is raised."""
    ending = _Ending(contextlib.ExitStack())
    try:
        with ending.stack:
            yield ending
    except SignalReceived:
        if ending.failure is not None:
            raise ending.failure from None
        raise


def _acquire_into(
    run: Run | None,
    job: Job,
    console: Console,
    request: SessionRequest,
    figures: dict[str, Any],
    ending: _Ending,
) -> None:
    is_resumed, beside = run is not None, request.beside
    folder = (run.folder if run else request.parent or job.cell.storage_folder).resolve()
    job, preflight = preflight_of(
        job,
        folder,
        occupied_space=run.occupied_space() if run else Occupied(),
        proven=run.proven() if run else (),
    )
    preflight.refusals += beside.refusals() if beside is not None else _refuse_without_result(job)
    show_preflight(console, preflight, name=job.plan.name, rig=job.cell.rig.name)
    refuse(preflight)
    if run is not None and not preflight.frames and not run.open_views() and not run.wants_views:
        _close_complete(run, job, console, beside, figures)
        return
    faults_of(job.cell).refuse(job.cell.document.path)
    ask_to_begin(job.cell, confirm=request.confirm)
    compile_ahead()
    console.print("opening the devices ...")
    with open_cell(job.cell, job=job, on_opened=identity_printer(console)) as cell:
        faults = faults_of(job.cell, cell.identities["robot"])  # by its serial number too
        on_disk(faults.where, partial(faults.refuse, job.cell.document.path))
        on_disk("the cell's commissioning record", partial(refuse_uncommissioned, job.cell, cell.identities))
        room_c = run_bounded(lambda: _refuse_other_calibrations(job, cell))
        if run is None:
            inputs = replace(job.inputs, copy_large=request.with_mesh)
            create = partial(Run.create, folder, job.plan.name, inputs, about_run(job, cell))
            run = on_disk(str(folder), create, copied_s(inputs))
            ending.stack.callback(os.close, run.lock())
        on_disk(str(run.folder), partial(open_for_session, run))
        ending.stack.callback(conclude, run, console)  # when the devices are closed
        console.print(f"run {run.folder}")
        is_packed = job.cell.rig.storage.pixels == "packed12"
        about = metadata_of_views(job, cell), described_cell(job)
        recorder = on_disk(str(run.folder), partial(RunRecorder, run, *about, is_packed=is_packed))
        try:
            event_class = SessionResumed if is_resumed else SessionStarted
            acknowledgement = on_disk(faults.where, partial(faults.begin_session, run.folder.name))
            event = event_class(simulated=cell.is_simulated, room_c=room_c, acknowledged=acknowledgement)
            fields = {"dose_budget_lux_h": preflight.dose_budget_lux_h, "trusted": trusted_by_name(job.cell.rig)}
            begun_s = _unset_clock_s()
            recorder.note(event.model_copy(update=fields))
            if beside is not None:
                _begin_processing(job, run, recorder, beside)
            tell_changes(job.cell.files, recorder, console)
            after_lux_h = preflight.dose_before_lux_h + preflight.dose_lux_h
            light = {job.plan.object.id: after_lux_h} if job.plan.object else {}
            session = _Session(cell, run, recorder, faults, begun_s, request.when_served)
            with ending.noting_failure():
                _acquire(job, session, console, light, figures)
        finally:
            _end_recording(recorder, beside)


def _end_recording(recorder: RunRecorder, beside: ProcessingBeside | None) -> None:
    """End the processing's session, then close the recorder: nothing may be discarded when the journal is
    closed."""
    if beside is not None:
        beside.end_session()
    recorder.close()


def _refuse_without_result(job: Job) -> list[str]:
    """Refuse a plan that discards frames but cannot have the result that replaces them."""
    why = job.plan.why_with_result
    return [str(job.document.problem(("discard",), why))] if why else []


def _close_complete(
    run: Run, job: Job, console: Console, beside: ProcessingBeside | None, figures: dict[str, Any]
) -> None:
    """Run the session of a run whose frames are all there. Its result may still be missing."""
    dose_lux_h = close_complete(run, console, beside.result_of(run.folder) if beside else None)
    if beside is not None:
        beside.follow(run.folder)
    outcome = Outcome(job.schedule.shots, job.schedule.shots, dose_lux_h=dose_lux_h)
    figures.update({**_figures(run, job, outcome, run.proven()), "unsafe": []})
    _say_outcome(console, run, outcome, "done")


def _begin_processing(job: Job, run: Run, recorder: RunRecorder, beside: ProcessingBeside) -> None:
    """Process the run's views from now on. The journal notes it, so that a resumed run knows of it."""
    recorder.note(ProcessingAsked(result=str(beside.result_of(run.folder))))
    recorder.commit(now=True)
    if job.plan.discard is not None:
        on_disk(str(run.folder), partial(finish_discarding, run))
        recorder.has_room_for = beside.discard(run, recorder.note_at_once, discard_room(job))
    beside.follow(run.folder)


def _refuse_other_calibrations(job: Job, cell: OpenedCell) -> float | None:
    """Check the records in force against the devices: the camera's identity and the cell's temperature.

    Returns the temperature of the coolest LED board, which is nearest to the room's; None if the box reports none.
    """
    boards = np.unique(job.cell.leds.boards)
    some = boards[np.unique(np.linspace(0, len(boards) - 1, _ASKED_BOARDS).astype(int))]
    temperatures_c = [c for board in some if (c := cell.ledbox.board_temperature_c(int(board))) is not None]
    room_c = min(temperatures_c, default=None)
    if reasons := calibration_refusals(job, camera=camera_name(cell), temperature_c=room_c):
        raise PreflightRefused(reasons)
    return room_c


def _acquire(
    job: Job, session: _Session, console: Console, light: Mapping[str, float], figures: dict[str, Any]
) -> None:
    """Run the session itself. At its end the objects will have received `light`, lux hours by id. A stop that
    comes after the last frame leaves the run complete, but it is raised too, because nothing may follow."""
    control = Control()
    _acquire_under(control, job, session, console, light, figures)
    if control.stop.is_set():
        raise control.interruption()


def _acquire_under(
    control: Control,
    job: Job,
    session: _Session,
    console: Console,
    light: Mapping[str, float],
    figures: dict[str, Any],
) -> None:
    """Run the session. However it ends, the cell is made safe first; then the end is written to the disk."""
    cell, run, recorder, faults = session.cell, session.run, session.recorder, session.faults
    observer = RunObserver(console, job.cell.rig.frame_bytes, len(recorder.proven()))
    sequencer = run_bounded(partial(Sequencer, job, cell, recorder, observer=observer, control=control))
    outcome: Literal["done", "interrupted", "failed"] = "failed"
    failure: BaseException | None = None
    paths = RunPaths(run.folder, job.document.path, job.cell.document.path)
    remote = RunControl(paths, control, cell.halt, lambda: observer.newest, light, session.when_served)

    def stop() -> None:
        control.stop_by(signal.SIGINT, "the key q")
        cell.halt()

    keys = {"p": control.toggle_pause, "q": stop}
    with obeyed_by(control, cell.halt), remote:  # to the journal's last line: a signal must not cut that off
        if remote.trouble:
            console.print(remote.trouble, markup=False)
        try:
            with key_actions(keys) as keys_read, observer.showing(job.schedule.frames, job.schedule.view_count):
                if keys_read:
                    console.print("keys: p pauses after the burst, and continues; q stops")
                try:
                    run_bounded(sequencer.acquire, stop=control.stop, rescue=cell.make_safe)
                finally:
                    cell.make_safe()
                _refuse_unsafe_end(cell)
                on_disk(str(run.folder), recorder.refuse_lost)
                outcome = "done"
        except BaseException as error:
            failure = control.interruption() if control.stop.is_set() else error
            outcome = "interrupted" if isinstance(failure, Interrupted) else "failed"
            if isinstance(failure, Interrupted):
                note_what_hangs(error, cell, run, recorder)
                raise failure from error
            note_failure(error, cell, run, recorder)
            raise
        finally:
            note_faults_of_the_arm(failure, cell, run, faults)
            for trouble in cell.trouble:
                recorder.note(FaultNoted(kind="unsafe", message=trouble))
                alarm(trouble)
            tell_changes(job.cell.files, recorder, console)
            note_unread(recorder)
            end = SessionStopped(outcome=outcome, reason=str(failure or ""), robot=statistics(cell))
            recorder.note(end.model_copy(update={"took_s": round(_unset_clock_s() - session.begun_s, 3)}))
            recorder.close_quietly()
            (sequencer.give_up if left_behind() else sequencer.conclude)(recorder.committed)
            figures.update({**_figures(run, job, sequencer.outcome, recorder.committed), "unsafe": cell.trouble})
            _say_outcome(console, run, sequencer.outcome, outcome)
            _say_what_comes_first(job, faults)


def _unset_clock_s() -> float:
    """Return the time of a clock that nobody sets, s. It goes on while the machine sleeps, where Linux has such a
    clock."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


def _say_what_comes_first(job: Job, faults: ArmFaults) -> None:
    """Say that a person must confirm an arm in a fault before the run can be resumed."""
    with contextlib.suppress(StorageError):
        if run_bounded(faults.standing):
            alarm(
                f"  first   coupole confirm {job.cell.document.path} --name NAME   "
                "(the arm has a fault: find the cause, check that the cell is clear)"
            )


def _refuse_unsafe_end(cell: OpenedCell) -> None:
    """Raise DeviceError if it is not sure that the lights are off and the arm is at rest, even if every frame is
    there."""
    if cell.trouble:
        raise unsafe_end("; ".join(cell.trouble), "Look at the cell; all frames are stored.")


def _figures(run: Run, job: Job, outcome: Outcome, proven: Collection[ShotId]) -> dict[str, Any]:
    """Return the figures of `--json`; `proven` are shots whose lines are on the disk."""
    frames = len(proven)
    return {
        "run": str(run.folder),
        "shots": outcome.shots,
        "proven": sum(shot.is_shot for shot in proven),
        "missing": len(outcome.missing),
        "missing_darks": len(outcome.missing_darks),
        "reshot": outcome.reshot,
        "bad": len(outcome.bad),
        "frames": frames,
        "bytes": frames * job.cell.rig.frame_bytes,
        "duration_s": round(outcome.duration_s, 3),
        "ideal_s": round(outcome.ideal_s, 3),
        "efficiency": round(outcome.ideal_s / outcome.duration_s, 4) if outcome.duration_s else 1.0,
        "dose_lux_h": outcome.dose_lux_h,
    }


def _say_outcome(console: Console, run: Run, outcome: Outcome, ending: str) -> None:
    console.print(
        f"{ending}: {outcome.proven} of {outcome.shots} shots proven, {outcome.reshot} re-shot, "
        f"{outcome.duration_s:.1f} s (at best {outcome.ideal_s:.1f} s), {outcome.dose_lux_h:.3f} lux.h"
    )
    if run.is_lost:
        console.print(f"  frames lost with {run.folder}, unless this folder is found")
        return
    console.print(f"  frames  {run.folder / 'views'}")
    if ending != "done":
        console.print(f"  go on   {run.go_on_command}")
