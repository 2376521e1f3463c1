"""`coupole bench`: holds a cell's devices while no run uses the cell, and answers requests at a socket.

The process that draws a console never touches a device; it asks this process, as any other client of the same user
can. If a client dies or is stopped, the motion that it asked for ends, and a light ends with its picture.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from coupole.acquisition.cell_bench.bench_arm import BenchArm
from coupole.acquisition.cell_bench.bench_client import bench_socket
from coupole.acquisition.cell_bench.bench_devices import BenchDevices
from coupole.acquisition.cell_bench.bench_frames import BenchFrames
from coupole.acquisition.cell_bench.bench_requests import (
    VERSION,
    CloseAsked,
    DriveAsked,
    FrameAsked,
    JogAsked,
    LoupeAsked,
    MeterAsked,
    PathAsked,
    Request,
    SelfTestAsked,
    StateAsked,
    StopAsked,
    read_request,
)
from coupole.acquisition.cell_bench.bench_work import Work, Works
from coupole.acquisition.cell_marks import is_in_use
from coupole.acquisition.looking import metered, metering_job
from coupole.acquisition.observer import Control
from coupole.acquisition.opened_cell import ARM_STOPPED, OpenedCell, open_cell
from coupole.acquisition.operator import ask_to_begin, identity_printer
from coupole.acquisition.safeguard import unsure
from coupole.acquisition.signals import obeyed_by
from coupole.acquisition.user_socket import Caller, UserSocket
from coupole.bounded import NOW, on_disk, refuse_overdue
from coupole.errors import CoupoleError, DeviceError, InputError, StorageError, unsafe_end
from coupole.plan.cell import Cell
from coupole.preflight import exposure_advice
from coupole.preflight.job import Job
from coupole.storage.arm_faults import faults_of
from coupole.viewing.terminal import alarm

_LOOK_EVERY_S = 0.1
_STOPPED_WITHIN_S = 4.0
_BEGIN = (SelfTestAsked, DriveAsked, JogAsked, FrameAsked, MeterAsked)
"""Requests that may move the arm or light the object."""


class BenchService:
    """Answers requests, each in a thread of its own."""

    def __init__(self, cell: Cell, opened_cell: OpenedCell, job: Job | None, control: Control) -> None:
        """`control` is that of the bench's session."""
        self._cell, self._opened, self._job, self._control = cell, opened_cell, job, control
        self.works = Works()
        self.closing = threading.Event()
        self.trouble: list[str] = []
        """Sentences on devices that were not surely safe when the bench was closed."""
        self._devices = BenchDevices(cell, opened_cell)
        self._arm = BenchArm(cell, opened_cell, job, self.works, control)
        self._frames = BenchFrames(cell, opened_cell, job, self._devices, self.works)
        self._ending = False
        self._asked_s = time.monotonic()

    @property
    def is_spent(self) -> bool:
        """True after a failure has made the cell safe: nothing can be lit or moved any more."""
        return self._opened.made_safe and self.works.running is None

    @property
    def idle_s(self) -> float:
        """Return the seconds since the last request, or since the end of the last work."""
        if self.works.running is not None:
            self._asked_s = time.monotonic()
        return time.monotonic() - self._asked_s

    def answer(self, line: bytes, caller: Caller | None) -> dict[str, Any]:
        """Return the answer to a request. It has an `error` with its `kind` if the request was not obeyed. Nothing
        moves or shines for a caller that has disconnected. None is a caller in this process."""
        stops = self.works.stops
        try:
            request = read_request(line)
            self._asked_s = time.monotonic()
            begins = isinstance(request, _BEGIN)
            if begins:
                self._control.await_word()
            if self._ending or self.closing.is_set() or (begins and self._control.stop.is_set()):
                raise InputError("the bench is closing")
            if begins and caller is not None and caller.is_gone():
                raise InputError("the caller has disconnected: not begun")
            return {"version": VERSION, **self._obey(request, stops, caller.pid if caller else 0)}
        except CoupoleError as error:
            if isinstance(error, DeviceError):
                self._devices.note_error(error)
            return {
                "version": VERSION,
                "error": str(error),
                "kind": type(error).__name__,
                "exit_code": error.exit_code,
            }
        except Exception as error:  # noqa: BLE001  the one who asks is told; the bench goes on
            return {
                "version": VERSION,
                "error": f"{type(error).__name__}: {error}",
                "kind": "defect",
                "exit_code": 1,
            }

    def ask(self, command: str, **fields: Any) -> dict[str, Any]:
        """Answer a request of a caller in this process."""
        return self.answer(json.dumps({"version": VERSION, "command": command, **fields}).encode(), None)

    def _obey(self, request: Request, stops: int, asking_pid: int) -> dict[str, Any]:
        """Obey a request. `stops` is the number of stops before the request was read. `asking_pid` is the process
        that asks, 0 for this one."""
        match request:
            case StateAsked():
                return self._state()
            case SelfTestAsked():
                self._refuse_while_metering()
                return self._devices.self_test(request.device)
            case PathAsked():
                return self._arm.plan_path(request)
            case DriveAsked():
                return self._arm.drive(request.path, stops, asking_pid)
            case JogAsked():
                return self._arm.jog(request, stops, asking_pid)
            case FrameAsked():
                self._refuse_while_metering()
                return {**self._frames.frame(request, stops), "dose": self._frames.dose()}
            case LoupeAsked():
                return self._frames.loupe(request)
            case MeterAsked():
                return self._begin_metering(request, stops, asking_pid)
            case StopAsked():
                return {"trouble": self._stop(request.why), **self._state()}
            case CloseAsked():
                self._ending = True
                self.trouble = self._stop()
                self.closing.set()
                return {"trouble": self.trouble}

    def _refuse_while_metering(self) -> None:
        if (work := self.works.running) is not None and work.kind == "meter":
            raise InputError("box and camera are metering; stop the metering or let it end")

    def _begin_metering(self, asked: MeterAsked, stops: int, asking_pid: int) -> dict[str, Any]:
        small = metering_job(self._arm.job_of(Path(asked.plan)))
        self._arm.refuse_motion()
        request = exposure_advice.Request(asked.saturated, asked.snr, asked.share)

        def meter(control: Control) -> dict[str, Any]:
            with self._devices.in_use:
                self._frames.release()
                try:
                    advice = metered(small, self._opened, request, control)
                finally:
                    self._frames.begin_counting()
            return advice.figures()

        work = Work(self._control, "meter", {"plan": asked.plan}, meter)
        self.works.begin(work, stops, asking_pid)
        return work.figures()

    def _stop(self, why: str = "") -> list[str]:
        """Stop everything, for this reason; return sentences on devices that are not surely safe then. When this
        returns, the picture under way and its light have ended.
        """
        self.works.stop(why)
        trouble = unsure(self._opened.halt(), _STOPPED_WITHIN_S)
        if self.works.last is not None:
            self.works.last.join(_STOPPED_WITHIN_S)
        if self._devices.in_use.acquire(timeout=_STOPPED_WITHIN_S):
            self._devices.in_use.release()
        else:
            trouble.append("the cell may not be safe: box and camera are still at work")
        return trouble

    def _state(self) -> dict[str, Any]:
        arm: dict[str, Any] | None = None
        try:
            arm = self._arm.state()
        except DeviceError as error:
            self._devices.note_error(error)
        plan_object = self._job.plan.object if self._job else None
        return {
            "rig": str(self._cell.document.path.resolve()),
            "pid": os.getpid(),
            "simulated": self._opened.is_simulated,
            "object": plan_object.id if plan_object else None,
            "devices": self._devices.state(arm["heard_s_ago"] if arm else None),
            "arm": arm,
            "dose": self._frames.dose(),
            "work": self.works.last.figures() if self.works.last else None,
            "stops": self.works.stops,
        }

    def end(self) -> None:
        """Stop the present work, make the cell safe, enter the light that was given."""
        self._ending = True
        self.closing.set()
        self._stop()
        self._opened.make_safe()
        with contextlib.suppress(StorageError):  # what was planned then stands
            on_disk("the dose ledger", self._frames.end, stop=NOW)


@contextmanager
def bench_of(
    job_or_cell: Job | Cell, console: Console, control: Control, *, confirm: bool
) -> Iterator[BenchService]:
    """Give a bench that holds the cell's devices while the context lasts, and then makes all safe. It obeys
    signals.

    With a job, its object lies on the support. Raises InputError if the cell is in use already, and DeviceError.
    """
    job = job_or_cell if isinstance(job_or_cell, Job) else None
    cell = job_or_cell.cell if isinstance(job_or_cell, Job) else job_or_cell
    if is_in_use(cell):
        raise InputError(
            f"{cell.document.path}: another process has this cell's devices open (acquire, live, meter, bench, "
            "calibrate, commission); end it first"
        )
    ask_to_begin(cell, confirm=confirm)
    with open_cell(cell, job=job, on_opened=identity_printer(console)) as opened_cell:
        service = BenchService(cell, opened_cell, job, control)
        with obeyed_by(control, opened_cell.halt):
            try:
                yield service
            finally:
                service.end()
                for trouble in opened_cell.trouble:
                    alarm(trouble)
                if not opened_cell.arm_confirmed or any(ARM_STOPPED in trouble for trouble in service.trouble):
                    reasons = "; ".join([*service.trouble, *opened_cell.trouble])
                    faults_of(cell, opened_cell.identities["robot"]).note(reasons, "bench")


def serve_bench(
    job_or_cell: Job | Cell, console: Console, *, confirm: bool, leave_after_s: float, as_json: bool
) -> None:
    """Hold the cell's devices until `close` is requested, a signal comes, or no request has come for a while.

    Raises InputError, DeviceError, Interrupted (SIGTERM, SIGHUP, or the process did not run for a while).
    """
    control = Control()
    path = bench_socket(job_or_cell.cell if isinstance(job_or_cell, Job) else job_or_cell)
    with bench_of(job_or_cell, console, control, confirm=confirm) as service, contextlib.ExitStack() as stack:
        try:
            stack.enter_context(UserSocket(path, service.answer))
        except OSError as error:
            raise InputError(f"{path}: cannot serve the bench there: {error}") from error
        console.print(f"bench at {path}  (Ctrl-C ends it)", soft_wrap=True)
        if as_json:
            print(json.dumps({"version": VERSION, "socket": str(path), "pid": os.getpid()}), flush=True)
        began_s = time.monotonic()
        while not (control.stop.wait(_LOOK_EVERY_S) or service.closing.is_set()):
            refuse_overdue(began_s)
            if service.is_spent:
                raise DeviceError(
                    "cell",
                    expected="a metering that ends normally",
                    happened=service.works.last.figures()["why"] if service.works.last else "it failed",
                    remedy="The cell was made safe; begin the bench again.",
                )
            if service.idle_s > leave_after_s:
                console.print(f"no request for {leave_after_s:g} s: the bench has closed")
                break
        service.closing.set()
    if service.trouble:
        raise unsafe_end("; ".join(service.trouble))
    if control.stop.is_set() and not control.stopped_by_hand:
        raise control.interruption()
