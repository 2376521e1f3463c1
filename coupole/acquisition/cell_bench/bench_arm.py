"""The arm of a bench: its state, paths that are shown before they are driven, and motions by hand."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from coupole.acquisition.arm_supervisor import ArmSupervisor
from coupole.acquisition.cell_bench.arm_paths import ArmPaths, ShownPath, links_mm
from coupole.acquisition.cell_bench.bench_requests import JogAsked, PathAsked
from coupole.acquisition.cell_bench.bench_work import Work, Works
from coupole.acquisition.cell_bench.enabling_switch import EnablingSwitch, ReleasedError
from coupole.acquisition.cell_bench.jog_steps import jog_step
from coupole.acquisition.observer import Control
from coupole.acquisition.opened_cell import OpenedCell
from coupole.acquisition.operator import refuse_uncommissioned
from coupole.clock import Clock
from coupole.errors import DeviceError, DeviceRefused, InputError, Interrupted, PreflightRefused
from coupole.plan.cell import Cell
from coupole.preflight.job import Job
from coupole.storage.arm_faults import faults_of

HOLD_S = 0.3
"""Time from the last renewal of a motion by hand until it ends, on the machine's clock and on the rig's. They are
the same, except in a simulated cell: in a slow one the arm moves slowly too."""
_KEPT_PATHS = 16
_SAME_PLACE_DEG = 0.05


class HoldLostError(Exception):
    """Raised when a button was released, or when its renewals have ended."""


class BenchArm:
    """The arm does one thing at a time: it follows a path, or moves by hand."""

    def __init__(
        self, cell: Cell, opened_cell: OpenedCell, job: Job | None, works: Works, control: Control
    ) -> None:
        """`control` is that of the bench's session."""
        self._cell, self._opened, self._works, self._control = cell, opened_cell, works, control
        self._faults = faults_of(cell, opened_cell.identities["robot"])
        self._paths = ArmPaths(cell, job)
        self._switch = EnablingSwitch(opened_cell.ledbox, must_exist=cell.rig.console.enabling_switch)
        self._shown: dict[str, ShownPath] = {}
        self._numbers = itertools.count(1)
        self._planning = threading.Lock()
        self._hold: _Hold | None = None
        home_deg = np.array(cell.rig.motion.home_joints_deg)
        self._paths.motion.bodies.is_clear(home_deg, home_deg + 0.1)  # compiled before anybody waits for it

    def state(self) -> dict[str, Any]:
        """Posture, motion and the controller's report of its safety."""
        arm = self._opened.robot.measured()
        joints_deg = np.array(arm.joints_deg)
        return {
            "joints_deg": np.round(joints_deg, 4).tolist(),
            "links_mm": links_mm(self._paths.arm, joints_deg),
            "base_from_camera": self._paths.base_from_camera(joints_deg).tolist(),
            "limits_deg": [list(pair) for pair in self._paths.arm.limits_deg],
            "moving": arm.moving,
            "fault": arm.fault,
            "faults_to_confirm": [fault.message for fault in self._faults.standing()],
            "mode": arm.condition.mode,
            "emergency_stop": arm.condition.emergency_stop,
            "protective_stop": arm.condition.protective_stop,
            "brakes_released": arm.condition.brakes_released,
            "enabling_switch": self._switch.exists,
            "heard_s_ago": round((self._opened.clock.now_ns() - arm.t_ns) / 1e9, 3),
        }

    def plan_path(self, request: PathAsked) -> dict[str, Any]:
        """Plan a path from where the arm is. Raises InputError if the arm moves, if other work is under way (a
        motion by hand rests between its steps), or if there is no path."""
        self._works.refuse_beside()
        state = self._opened.robot.measured()
        if state.moving:
            raise InputError("the arm is moving; a path is planned only from an arm at rest")
        with self._planning:
            path = self._paths.plan(str(next(self._numbers)), request.to, np.array(state.joints_deg))
            self._shown[path.id] = path
            for old in list(self._shown)[:-_KEPT_PATHS]:
                del self._shown[old]
        return self._paths.figures(path)

    def drive(self, number: str, stops: int, asking_pid: int) -> dict[str, Any]:
        """Begin to follow a path that was shown. `stops` is the number of stops when this was requested. The
        motion ends when the process `asking_pid` no longer runs. Raises InputError if the arm is not at the
        beginning of the path."""
        path = self._shown.get(number)
        if path is None:
            raise InputError(f"path: expected one that `plan_path` has shown, found {number!r}")
        self.refuse_motion()
        self._switch.refuse_released()
        here_deg = np.array(self._opened.robot.measured().joints_deg)
        off_deg = float(np.abs(here_deg - path.start_deg).max())
        if off_deg > _SAME_PLACE_DEG:
            raise InputError(
                f"path {number} begins {off_deg:.2f} deg from where the arm stands: plan it again and look at it"
            )
        about = {"path": path.id, "to": path.to}
        work = Work(self._control, "drive", about, lambda control: self._follow(path, control))
        self._works.begin(work, stops, asking_pid)
        return work.figures()

    def jog(self, request: JogAsked, stops: int, asking_pid: int) -> dict[str, Any]:
        """Begin a motion by hand, or renew it. `stops` is the number of stops when this was requested. The motion
        ends when the process `asking_pid` no longer runs, and only this process renews it. Raises InputError if
        the motion is not allowed."""
        consoles = self._cell.rig.console.at_the_cell
        if request.at not in consoles:
            raise InputError(
                f"from: the arm is moved by hand only from a console at the cell; {request.at!r} is not in "
                f"`console: at_the_cell:` of {self._cell.document.path}"
            )
        if request.hold is not None:
            return self._renew(request, asking_pid)
        self.refuse_motion()
        self._switch.refuse_released()
        hold = _Hold(next(self._numbers), request, asking_pid, self._opened.clock)
        about = {"hold": hold.number, "axis": request.axis, "direction": request.direction}
        work = Work(self._control, "jog", about, lambda control: self._go_on(hold, control))
        self._works.begin(work, stops, asking_pid)
        self._hold, hold.work = hold, work
        return work.figures()

    def job_of(self, plan: Path) -> Job:
        """Return the plan's job in this cell. Raises InputError if its object is not the bench's object."""
        return self._paths.job_of(plan)

    def _renew(self, request: JogAsked, asking_pid: int) -> dict[str, Any]:
        hold = self._hold
        if hold is None or hold.number != request.hold:
            raise InputError(f"hold: {request.hold} has ended; release the button and press it again")
        if asking_pid != hold.asking_pid:
            hold.let_go("another process renewed it")
            raise InputError(
                f"hold: {request.hold} is held by another process, and only this process may renew it; the hold "
                "was ended"
            )
        if (request.axis, request.direction) == (hold.asked.axis, hold.asked.direction):
            hold.renew()
        else:
            hold.let_go("the button was released")
        assert hold.work is not None
        return hold.work.figures()

    def refuse_motion(self) -> None:
        """Raise DeviceFault or InputError if the arm may not move at all."""
        self._faults.refuse(self._cell.document.path)
        try:
            refuse_uncommissioned(self._cell, self._opened.identities)
        except PreflightRefused as refused:
            raise InputError(str(refused)) from refused

    def _follow(self, path: ShownPath, control: Control) -> dict[str, Any]:
        supervisor = ArmSupervisor(self._cell.rig, path.motion, self._opened, control)
        try:
            with self._switch.release_check() as check, self._stopped_at_the_end():
                supervisor.begin_here()
                supervisor.go(path.visit, meanwhile=check)
        except ReleasedError as end:
            raise Interrupted(str(end)) from end
        return {}

    def _go_on(self, hold: _Hold, control: Control) -> dict[str, Any]:
        """Move step after step while the button is held."""
        rig, bodies = self._cell.rig, self._paths.motion.bodies
        supervisor = ArmSupervisor(rig, self._paths.motion, self._opened, control)

        camera, jog = rig.flange_from_camera.matrix(), hold.asked
        try:
            with self._switch.release_check() as check, self._stopped_at_the_end():

                def go_on() -> None:
                    hold.check()
                    check()

                while True:
                    here_deg = supervisor.begin_here()
                    step = jog_step(self._paths.arm, bodies, camera, here_deg, jog.axis, jog.direction, jog.share)
                    hold.check()
                    self._switch.refuse_released()
                    supervisor.go(step.visit, meanwhile=go_on, speed=step.speed)
        except (HoldLostError, ReleasedError, InputError) as end:
            return {"ended": str(end)}

    @contextmanager
    def _stopped_at_the_end(self) -> Iterator[None]:
        """Stop the arm however the context ends. Faults of the arm are kept with the cell."""
        try:
            try:
                yield
            finally:
                self._opened.robot.stop()
        except DeviceError as error:
            if error.device == "robot" and not isinstance(error, DeviceRefused):
                self._faults.note(str(error), "bench")
            raise


class _Hold:
    """A button that is held."""

    def __init__(self, number: int, request: JogAsked, asking_pid: int, clock: Clock) -> None:
        """`clock`: the rig's."""
        self.number, self.asked, self.asking_pid = number, request, asking_pid
        self.work: Work | None = None
        self._ended = ""
        self._clock = clock
        self._renewed_s = self._now_s()

    def renew(self) -> None:
        """Renew the hold, unless it has lapsed: a request that reaches the bench late, after a freeze, must not
        begin a motion again.
        """
        self._note_lapse()
        self._renewed_s = self._now_s()

    def let_go(self, why: str) -> None:
        """End the hold for this reason, unless it has already ended for another reason."""
        self._ended = self._ended or why

    def check(self) -> None:
        """Raise HoldLostError unless the button is still held."""
        self._note_lapse()
        if self._ended:
            raise HoldLostError(self._ended)

    def _note_lapse(self) -> None:
        lasts_s = min(now_s - then_s for now_s, then_s in zip(self._now_s(), self._renewed_s, strict=True))
        if not self._ended and lasts_s > HOLD_S:
            self._ended = f"it was not renewed for {1e3 * HOLD_S:g} ms"

    def _now_s(self) -> tuple[float, float]:
        return time.monotonic(), self._clock.now_ns() / 1e9
