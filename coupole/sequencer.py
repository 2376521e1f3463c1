"""Runs a schedule: moves the arm, fires bursts, proves frames, shoots again what is missing.

The only module that commands devices. It keeps to one order at all times: arm at rest and measured, camera
armed, then lights; and backwards. On the way out, whatever the reason, `coupole.cell` makes the devices safe.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from coupole.cell import OpenedCell
from coupole.devices import (
    NO_LIGHT,
    STATUS_LED_OPEN,
    STATUS_OVER_TEMPERATURE,
    STEP_RECORD_DTYPE,
    ArmState,
    CameraStatistics,
    Deadline,
    Exposure,
    Frame,
    FrameFormat,
)
from coupole.errors import (
    CoupoleError,
    DeviceError,
    DeviceFault,
    DeviceLost,
    DeviceTimeout,
    Interrupted,
    PreflightRefused,
    UnprovenError,
)
from coupole.intake import Intake
from coupole.itinerary import Visit, arm_of
from coupole.job import Job
from coupole.kinematics import move_duration_s
from coupole.matching import UNLABELLED, FaultModel, Match, compile_now, match
from coupole.observer import Control, Observer, Outcome, Progress
from coupole.recorder import Recorder
from coupole.run import is_shot
from coupole.shots import Burst, ViewPose

POLL_S = 0.05
_LAST_FRAMES_S = 1.0
"""How long after a burst's end its last frames may take to reach the host, readout apart."""
_CLOCK_TOLERANCE, _STALL_S = 1.02, 5.0
"""A burst may take so much longer than its table says, as a factor and in seconds."""
_LAST_STRETCH_S = 0.3
"""Of a burst: time enough for a host that fell behind in a hurry to catch up before the end."""
_BOX_JITTER_US = 20.0
_BUFFERS = 64
_PAUSE_NAP_S, _MOTION_POLL_S = 0.1, 0.01
_ARM_NEWS_S = 1.0
_LIT_IN_VAIN = STATUS_LED_OPEN | STATUS_OVER_TEMPERATURE


@dataclass
class _Firing:
    """A burst under way: what box and camera have said of it so far."""

    burst: Burst
    intake: Intake
    log: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, STEP_RECORD_DTYPE))
    judged: Match | None = None
    proven: set[int] = field(default_factory=set)
    """Frames that the recorder has been told of."""


class _ArmMovedError(Exception):
    """The arm moved while lights flashed."""


@dataclass(frozen=True)
class _Station:
    """Where the arm stands for the present view, and what `Recorder.begin_view` was told."""

    view: str
    arm: ArmState
    frames: int
    frame_format: FrameFormat


@dataclass(frozen=True)
class _Verdict:
    """Of one burst, after its end."""

    match: Match
    dead: list[str]
    """Shots whose LED drew no current."""


_NONE = np.zeros(0, np.int64)
_NOTHING_TO_MATCH = Match(_NONE, _NONE > 0, _NONE > 0, _NONE > 0, ambiguous=False, reason="", clocks=None)


def _fields(record: np.void, t_trigger_ns: int) -> dict[str, int]:
    """What the frame table keeps of a step's record."""
    names = ("led", "step", "board_temperature_dc", "led_current_ma", "status")
    return {"t_trigger_ns": t_trigger_ns, **{name: int(record[name]) for name in names}}


class Sequencer:
    """One session of a run. `acquire()` either returns or raises; the caller makes the cell safe."""

    def __init__(
        self,
        job: Job,
        cell: OpenedCell,
        recorder: Recorder,
        *,
        observer: Observer | None = None,
        control: Control | None = None,
    ) -> None:
        self._job, self._cell, self._recorder = job, cell, recorder
        self._observer, self._control = observer or Observer(), control or Control()
        rig = job.cell.rig
        points = job.object_points_support_mm
        base_from_support = rig.support.base_from_support.matrix()
        points_base = points @ base_from_support[:3, :3].T + base_from_support[:3, 3]
        self._lux = job.cell.leds.illuminance_lux(points_base, emission=rig.dome.emission)
        self._row_of_led = {int(led): row for row, led in enumerate(job.cell.leds.ids)}
        self._dose_lux_h = np.zeros(len(points))
        self._arm = arm_of(rig)
        self._view_number = 0
        self._view_name = ""
        self._frames_wanted = job.schedule.frames
        self.burst_times_s: list[float] = []
        """From start to last proof of each burst, on the rig's clock."""
        self.outcome = Outcome(shots=job.schedule.shots)
        compile_now()

    # -- the run ------------------------------------------------------------------------------------------

    def acquire(self) -> Outcome:
        """Do all that is not proven yet. Raises UnprovenError if shots stay missing, or a CoupoleError."""
        schedule = self._job.schedule
        left = {n: found for n, bursts in enumerate(schedule.bursts) if (found := self._left_of(bursts))}
        visits = self._itinerary([schedule.views[n] for n in left])
        start_ns = self._cell.clock.now_ns()
        try:
            for (number, bursts), visit in zip(left.items(), visits, strict=True):
                self._view_number, self._view_name = number, schedule.views[number].name
                self._acquire_view(schedule.views[number], visit, bursts, schedule.bursts[number])
        finally:
            self.outcome.duration_s = (self._cell.clock.now_ns() - start_ns) / 1e9
            self.outcome.dose_lux_h = float(self._dose_lux_h.max())
            done = self._recorder.proven()
            self.outcome.proven = sum(map(is_shot, done))
            expected = [s for bursts in schedule.bursts for b in bursts for s in b.shot_ids]
            self.outcome.missing = [s for s in expected if is_shot(s) and s not in done]
        if self.outcome.missing:
            raise UnprovenError(self._say_missing())
        return self.outcome

    def _itinerary(self, views: Sequence[ViewPose]) -> list[Visit]:
        """Ways to the views that are left, from where the arm really stands."""
        start_deg = self._cell.robot.measured().joints_deg
        found = self._job.itinerary(views, start_deg)
        if found.refusals:
            raise PreflightRefused(found.refusals)
        return [visit for visit in found.visits if visit is not None]

    def _left_of(self, bursts: Sequence[Burst]) -> list[Burst]:
        """Bursts of which something is not proven yet, cut down to that."""
        done = self._recorder.proven()
        left = []
        for burst in bursts:
            wanted = {label for label in burst.labels if f"{burst.view}/{label}" not in done}
            if wanted:
                left.append(burst if len(wanted) == len(burst.labels) else burst.only(wanted))
        return left

    def _acquire_view(self, view: ViewPose, visit: Visit, left: list[Burst], all_bursts: Sequence[Burst]) -> None:
        self._recorder.event("view", view=view.name)
        self.outcome.ideal_s += sum(burst.duration_s for burst in left)
        arm = self._move(view, visit, left[0])
        base_from_camera = arm.base_from_flange @ self._job.cell.rig.flange_from_camera.matrix()
        self._recorder.event(
            "settled",
            view=view.name,
            joints_deg=[round(j, 6) for j in arm.joints_deg],
            base_from_camera=np.round(base_from_camera, 6).tolist(),
        )
        frame_format = self._cell.camera.configure(self._exposure(left[0]))
        self._check_format(frame_format.height_px, frame_format.width_px)
        frames = sum(len(burst.labels) for burst in all_bursts)
        self._recorder.begin_view(view.name, frames, frame_format, arm, base_from_camera)
        self._station = _Station(view.name, arm, frames, frame_format)
        try:
            for index, burst in enumerate(left):
                following = left[index + 1] if index + 1 < len(left) else None
                self._acquire_burst(burst, following)
            self._recorder.event("seal", view=view.name)
        finally:
            self._recorder.end_view()

    def _move(self, view: ViewPose, visit: Visit, first: Burst) -> ArmState:
        """Follow a leg, loading the view's first table meanwhile; the measured state once the arm stands still."""
        robot, motion = self._cell.robot, self._job.cell.rig.motion
        whole_s = visit.leg.duration_s + motion.settle_dwell_s
        self.outcome.ideal_s += whole_s
        waypoints = [np.round(place, 6).tolist() for place in visit.leg.waypoints]
        self._recorder.event("move", view=view.name, joints_deg=waypoints)
        here_deg = np.array(robot.measured().joints_deg)
        for number, waypoint in enumerate(visit.leg.waypoints):
            robot.move_to(waypoint)
            if number == 0:
                self._cell.ledbox.load(first.table)
            self._hurry(move_duration_s(self._arm, here_deg, waypoint) + motion.settle_dwell_s)
            while robot.measured().moving:
                self._raise_if_stopped()
                self._cell.clock.sleep(_MOTION_POLL_S)
            here_deg = waypoint
        return robot.wait_settled()

    def _check_format(self, height_px: int, width_px: int) -> None:
        sensor = self._cell.sensor
        if (height_px, width_px) != (sensor.height_px, sensor.width_px):
            raise DeviceError(
                "camera",
                expected=f"frames of {sensor.width_px} x {sensor.height_px}, as the rig's `sensor:` says",
                happened=f"the camera makes {width_px} x {height_px}",
                remedy="Correct the rig, or the camera's region of interest.",
            )

    def _exposure(self, burst: Burst) -> Exposure:
        return Exposure(burst.timing.exposure_us, self._job.plan.gain_db, burst.hardware)

    def _acquire_burst(self, burst: Burst, following: Burst | None) -> None:
        """Fire a burst, and what it left unproven again, up to the plan's limit."""
        todo = burst
        for attempt in range(self._job.plan.reshoot_limit + 1):
            self._wait_while_paused()
            if attempt:
                shots = [s for s in todo.shot_ids if s and is_shot(s)]
                self.outcome.reshot += len(shots)
                self._recorder.event("reshoot", view=burst.view, attempt=attempt, shots=shots)
            try:
                verdict = self._fire(todo, following if attempt == 0 else None)
            except _ArmMovedError as moved:
                self._observer.note(f"{burst.view}: {moved}; back to the view")
                self._stand_again(str(moved))
                verdict = _Verdict(_NOTHING_TO_MATCH, [])
            done = self._recorder.proven()
            left = {label for label in todo.labels if label and f"{burst.view}/{label}" not in done}
            if not left:
                return
            self._note_gap(burst, verdict, left)
            self.outcome.bad = sorted(set(self.outcome.bad) | set(verdict.dead))
            todo = burst.only(left)

    def _stand_again(self, why: str) -> None:
        """Bring the arm back to its view after it was moved, and measure anew where it stands."""
        self._cell.ledbox.lights_off()
        station = self._station
        self._recorder.event("fault", kind="ArmMoved", message=f"{station.view}: {why}")
        self._cell.robot.move_to(np.array(station.arm.joints_deg))
        arm = self._cell.robot.wait_settled()
        base_from_camera = arm.base_from_flange @ self._job.cell.rig.flange_from_camera.matrix()
        self._recorder.begin_view(station.view, station.frames, station.frame_format, arm, base_from_camera)
        self._station = replace(station, arm=arm)

    def _note_gap(self, burst: Burst, verdict: _Verdict, left: set[str]) -> None:
        judged = verdict.match
        missing = int(judged.missing.sum())
        lost = int(judged.lost_in_transfer.sum())
        self._recorder.event(
            "gap",
            view=burst.view,
            shots=[f"{burst.view}/{label}" for label in sorted(left)],
            missing=missing,
            lost_in_transfer=lost,
            surplus=int(judged.surplus.sum()),
            dead_leds=verdict.dead,
            reason=judged.reason,
        )
        why = [f"{lost} lost in transfer"] if lost else []
        why += [f"{missing - lost} never exposed"] if missing > lost else []
        why += [f"{len(verdict.dead)} with an LED that draws no current"] if verdict.dead else []
        why += [judged.reason] if judged.reason else []
        self._observer.note(f"{burst.view}: {len(left)} frames not proven ({'; '.join(why) or 'aborted'})")

    def _say_missing(self) -> str:
        missing, bad = self.outcome.missing, self.outcome.bad
        text = f"{len(missing)} shots are not proven after {self._job.plan.reshoot_limit} re-shoots: "
        text += ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
        if bad:
            text += f". In {len(bad)} of them the LED drew no current: repair it or leave it out of `lights:`"
        return text + ". Resume the run to try again."

    # -- one burst ----------------------------------------------------------------------------------------

    def _fire(self, burst: Burst, following: Burst | None) -> _Verdict:
        """Run one table and prove its frames; whatever happens, note what light was given and what was seen."""
        box, camera = self._cell.ledbox, self._cell.camera
        exposure = self._exposure(burst)
        camera.configure(exposure)
        box.load(burst.table)
        if not burst.hardware:
            return self._fire_by_software(burst)
        intake = Intake(camera, lambda frame: self._recorder.put(frame, exposure.exposure_us))
        firing = _Firing(burst, intake)
        camera.arm(min(len(burst.labels), _BUFFERS))
        try:
            intake.start()
            if burst.panel:
                box.panel(burst.panel, True)
            started_ns = self._cell.clock.now_ns()
            box.start(burst.table)
            if following is not None:
                box.load(following.table)
            self._hurry(burst.duration_s - _LAST_STRETCH_S)
            self._follow(firing)
            self.burst_times_s.append((self._cell.clock.now_ns() - started_ns) / 1e9)
            if burst.panel:
                box.panel(burst.panel, False)
        except BaseException:
            with contextlib.suppress(DeviceError):
                camera.disarm()
            with contextlib.suppress(CoupoleError):
                self._end_burst(firing, camera=None)
            raise
        statistics = camera.statistics()
        camera.disarm()
        self._end_burst(firing, camera=statistics)
        dark = (firing.log["led"] != NO_LIGHT) & ((firing.log["status"] & STATUS_LED_OPEN) != 0)
        assert firing.judged is not None
        return _Verdict(firing.judged, [burst.shot_ids[i] for i in np.flatnonzero(dark)])

    def _follow(self, firing: _Firing) -> None:
        """Read log and frames until the burst is over, proving as it goes."""
        box, clock, burst, intake = self._cell.ledbox, self._cell.clock, firing.burst, firing.intake
        readout_s = 1.0 / self._job.cell.rig.sensor.max_frames_per_s + burst.timing.exposure_us * 1e-6
        whole = Deadline(clock, burst.duration_s * _CLOCK_TOLERANCE + _STALL_S)
        last_frames: Deadline | None = None
        edges = 0
        judged_at = (-1, -1)
        taken, confirmed, heard_ns = 0, 0, 0
        while True:
            self._raise_if_stopped()
            if (news_ns := self._heard_of_arm_at_rest()) > heard_ns:
                heard_ns, confirmed = news_ns, taken  # what had come by the last round was taken at rest
            taken = len(intake)  # before the log is read: the proof needs frames that are older than the log
            firing.log = np.concatenate([firing.log, box.poll_log()])
            if len(firing.log) == len(burst.table) and last_frames is None:
                last_frames = Deadline(clock, readout_s + _LAST_FRAMES_S)
                edges = box.edges()
            complete = last_frames is not None and (taken >= edges or last_frames.expired)
            if complete:
                clock.sleep(readout_s)  # a surplus frame may be on its way still
                taken = confirmed = len(intake)
                self._wait_for_news_of_arm_at_rest()
            if complete or (confirmed, len(firing.log)) != judged_at:
                judged_at = (confirmed, len(firing.log))
                firing.judged = self._match(firing, taken, complete=complete)
                self._prove(firing, confirmed, complete=complete)
                self._tell(burst, len(firing.log))
            if complete:
                return
            self._recorder.commit(now=False)
            if whole.expired:
                raise DeviceTimeout(
                    "led box",
                    expected=f"the burst's {len(burst.table)} steps within {whole.seconds:.1f} s",
                    happened=f"only {len(firing.log)} are in its log",
                    remedy="Check the box, then resume the run.",
                )
            clock.sleep(POLL_S)

    def _match(self, firing: _Firing, taken: int, *, complete: bool) -> Match:
        frame_ids, timestamps_ns = firing.intake.frames(taken)
        return match(
            firing.log,
            frame_ids,
            timestamps_ns,
            id_modulus=self._cell.camera.id_modulus,
            complete=complete,
            model=FaultModel(jitter_us=self._cell.camera.timestamp_jitter_us + _BOX_JITTER_US),
        )

    def _prove(self, firing: _Firing, confirmed: int, *, complete: bool) -> None:
        """Hand newly proven frames to the recorder, of the first `confirmed`, once their bytes are written."""
        assert firing.judged is not None
        labels, log, intake = firing.burst.labels, firing.log, firing.intake
        for frame in np.flatnonzero(firing.judged.step_of_frame != UNLABELLED).tolist():
            if frame in firing.proven or frame >= confirmed or not (complete or intake.kept(frame)):
                continue
            record = log[firing.judged.step_of_frame[frame]]
            label = labels[int(record["step"])]
            in_vain = record["led"] != NO_LIGHT and record["status"] & _LIT_IN_VAIN
            if label and not in_vain:
                self._recorder.prove(
                    intake.slot(frame),
                    f"{firing.burst.view}/{label}",
                    _fields(record, int(record["t_trigger_ns"])),
                )
                firing.proven.add(frame)

    def _end_burst(self, firing: _Firing, camera: CameraStatistics | None) -> None:
        """Note light and figures, give back what is not wanted, make the rest last."""
        burst, log, intake = firing.burst, firing.log, firing.intake
        intake.stop()
        for frame in range(intake.count):
            if frame not in firing.proven:
                self._recorder.free(intake.slot(frame))
        if camera is not None:
            self.outcome.over_triggers += max(0, camera.over_triggers)
            self.outcome.lost_transfers += max(0, camera.lost_transfers)
        clocks = firing.judged.clocks if firing.judged is not None else None
        self._recorder.event(
            "burst",
            view=burst.view,
            frames=intake.count,
            steps=len(log),
            on_s=self._note_dose(burst, log),
            table_s=burst.duration_s,
            clocks=None if clocks is None else vars(clocks),
            camera=None if camera is None else vars(camera),
            hottest_board_c=float(log["board_temperature_dc"].max()) / 10 if len(log) else None,
        )
        self._recorder.commit(now=True)

    def _fire_by_software(self, burst: Burst) -> _Verdict:
        """One light at a time, fired by the host: a frame is proven by being the only one, taken while the box
        says that this very step is running, from before the trigger until after the frame has come."""
        logs = []
        dead: list[str] = []
        for index, shot in enumerate(burst.shot_ids):
            self._raise_if_stopped()
            self._wait_while_paused()
            frame, record, lit_throughout = self._fire_one(burst, burst.table[index : index + 1])
            logs.append(record)
            step = record[0]
            if step["led"] != NO_LIGHT and step["status"] & _LIT_IN_VAIN:
                dead.append(shot)
                lit_throughout = False
            if frame is not None:
                slot = self._recorder.put(frame, burst.timing.exposure_us)
                frame.release()
                if lit_throughout:
                    t_trigger_ns = int(step["t_on_ns"]) + burst.timing.trigger_delay_us * 1000
                    self._recorder.prove(slot, shot, _fields(step, t_trigger_ns))
                else:
                    self._recorder.free(slot)
            self._tell(burst, index)
            self._recorder.commit(now=False)
        log = np.concatenate(logs)
        self._recorder.event(
            "burst", view=burst.view, frames=len(log), steps=len(log), on_s=self._note_dose(burst, log)
        )
        self._recorder.commit(now=True)
        return _Verdict(_NOTHING_TO_MATCH, dead)

    def _fire_one(self, burst: Burst, single: NDArray[np.void]) -> tuple[Frame | None, NDArray[np.void], bool]:
        """Light one step, trigger the camera; the frame, the step's record, and whether the one frame that was
        exposed came while the step was running."""
        box, camera, clock = self._cell.ledbox, self._cell.camera, self._cell.clock
        camera.arm(_BUFFERS)
        try:
            if burst.panel:
                box.panel(burst.panel, True)
            box.load(single)
            box.start(single)
            clock.sleep(burst.timing.trigger_delay_us * 1e-6)
            camera.trigger()
            frame = camera.next_frame(burst.timing.on_us * 1e-6 + _LAST_FRAMES_S)
            lit_throughout = box.running() and camera.statistics().exposed == 1
            end = Deadline(clock, burst.timing.period_us * 1e-6 + _STALL_S)
            while box.running():
                if end.expired:
                    raise DeviceTimeout(
                        "led box",
                        expected=f"a step of {burst.timing.period_us} us to end within {end.seconds:.1f} s",
                        happened="the box says that it is running still",
                        remedy="Check the box, then resume the run.",
                    )
                clock.sleep(burst.timing.on_us * 1e-7)
            record = box.poll_log()
        finally:
            box.lights_off()
            camera.disarm()
        if len(record) != 1:
            raise DeviceError(
                "led box",
                expected="one record in the log of a table with one step",
                happened=f"{len(record)} came",
                remedy="Check the box, then resume the run.",
            )
        return frame, record, lit_throughout

    def _hurry(self, seconds: float) -> None:
        """For so long there is nothing to do but to watch: a rehearsal's clock may run fast."""
        clock = self._cell.clock
        clock.hurry(clock.now_ns() + int(max(0.0, seconds) * 1e9))

    # -- small things -------------------------------------------------------------------------------------

    def _note_dose(self, burst: Burst, log: NDArray[np.void]) -> float:
        """Add what this burst gave the object; returns seconds of light."""
        lit = log["led"] != NO_LIGHT
        rows = [self._row_of_led[int(led)] for led in log["led"][lit]]
        on_h = burst.timing.on_us / 3.6e9
        self._dose_lux_h += self._lux[:, rows].sum(axis=1) * on_h
        if burst.panel:
            self._dose_lux_h += self._job.cell.rig.dome.panel_lux * burst.duration_s / 3600.0
        return round(len(rows) * burst.timing.on_us * 1e-6, 6)

    def _tell(self, burst: Burst, step: int) -> None:
        label = burst.labels[min(step, len(burst.labels) - 1)]
        self._observer.progress(
            Progress(
                self._view_name,
                self._view_number,
                len(self._job.schedule.views),
                len(self._recorder.proven()),
                self._frames_wanted,
                label.split("/")[0],
                float(self._dose_lux_h.max()),
            )
        )

    def _raise_if_stopped(self) -> None:
        if self._control.stop.is_set():
            raise Interrupted("stopped by the operator; everything proven so far is kept")
        arm = self._cell.robot.measured()
        self._refuse_faulty(arm)

    def _heard_of_arm_at_rest(self) -> int:
        """When the arm was last heard of; raises _ArmMovedError if it does not stand where it did."""
        arm = self._cell.robot.measured()
        off_deg = float(np.abs(np.subtract(arm.joints_deg, self._station.arm.joints_deg)).max())
        if off_deg > self._job.cell.rig.motion.still_deg:
            raise _ArmMovedError(f"the arm moved by {off_deg:.3f} deg during a burst")
        return arm.t_ns

    def _wait_for_news_of_arm_at_rest(self) -> None:
        """Hear once more of the arm, lest it fell silent, or worse, while the last frames were taken."""
        since_ns, clock = self._cell.robot.measured().t_ns, self._cell.clock
        deadline = Deadline(clock, _ARM_NEWS_S)
        while self._heard_of_arm_at_rest() <= since_ns:
            self._raise_if_stopped()
            if deadline.expired:
                raise DeviceLost(
                    "robot",
                    expected=f"news of the arm within {_ARM_NEWS_S:g} s of the burst's end",
                    happened="its controller is silent",
                    remedy="Check the controller and its network, then resume the run.",
                )
            clock.sleep(_MOTION_POLL_S)
        self._raise_if_stopped()

    @staticmethod
    def _refuse_faulty(arm: ArmState) -> None:
        if arm.fault:
            raise DeviceFault(
                "robot",
                expected="an arm at rest without fault while lights flash",
                happened=arm.fault,
                remedy="Find the cause and acknowledge it at the robot, then resume the run.",
            )

    def _wait_while_paused(self) -> None:
        if not self._control.pause.is_set():
            return
        self._recorder.event("pause")
        self._recorder.commit(now=True)
        self._observer.note("paused; lights are off")
        while self._control.pause.is_set():
            self._raise_if_stopped()
            self._cell.clock.sleep(_PAUSE_NAP_S)
        self._recorder.event("resume", after="pause")
