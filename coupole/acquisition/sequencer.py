"""Runs a schedule: moves the arm, fires bursts, takes unproven shots again.

Only this module, the arm supervisor and the burst runner command devices. The order is always the same: arm at
rest and measured, camera armed, lights. At the end it is reversed. On every exit the devices are made safe
(`coupole.acquisition.opened_cell`) before anything is written.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np

from coupole.acquisition.arm_supervisor import ArmMovedError, ArmSupervisor, SettledPose
from coupole.acquisition.burst_runner import BurstRunner, CameraSettings
from coupole.acquisition.bursts_of_views import BurstsOfViews
from coupole.acquisition.collector import collected_when_asked
from coupole.acquisition.dose import DoseMeter
from coupole.acquisition.frame_matching import compile_now
from coupole.acquisition.host_burst import Overseer
from coupole.acquisition.observer import Control, Held, Observer, Unwatched
from coupole.acquisition.opened_cell import OpenedCell
from coupole.acquisition.recorder import Recorder, ViewStart
from coupole.acquisition.verdict import NOTHING_TO_MATCH, Verdict
from coupole.acquisition.visits_in_order import NextVisit, chosen_visits, planned_visits
from coupole.acquisition.watching.watched_run import WatchedRecorder
from coupole.devices import FrameFormat
from coupole.errors import DeviceError, UnprovenError
from coupole.motion.itinerary import Visit
from coupole.plan.bursts import Burst
from coupole.plan.schedule import ViewPose
from coupole.plan.shot_id import ShotId
from coupole.preflight.job import Job
from coupole.preflight.preflight import BURST_OVERHEAD_S, SETTLE_CHECK_S
from coupole.storage.journal_events import (
    ArmSettled,
    Continued,
    FaultNoted,
    GapFound,
    MoveBegun,
    Paused,
    ReshootBegun,
    ViewBegun,
    ViewSealed,
)
from coupole.viewing.progress import Outcome, Progress

_PAUSE_NAP_S = 0.1
_ROOM_NAP_S = 0.5


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
        can_stand: bool = True,
    ) -> None:
        """`can_stand`: a person can let the session go on after a hold. Otherwise a hold ends it."""
        self._job, self._cell = job, cell
        self._observer, self._control = observer or Unwatched(), control or Control()
        self._recorder = recorder = WatchedRecorder(recorder, job, self._observer, self._control)
        self._dose = DoseMeter(job, cell, recorder)
        self._bursts = BurstsOfViews(job, recorder)
        self._ahead_s = 0.0
        """Expected duration of all work after the present burst."""
        self._view_number = 0
        self._view_name = ""
        self.outcome = Outcome(shots=job.schedule.shots, dose_lux_h=self._dose.lux_h_in_all)
        self._control.can_stand = can_stand
        self._arm = ArmSupervisor(
            job.cell.rig,
            job.motion,
            cell,
            self._control,
            stand=self._wait_while_paused,
            tell_lapse=lambda message: self._note_fault("ArmUnattended", message),
        )
        self._burst_runner = BurstRunner(
            cell,
            recorder,
            self._arm,
            self._dose,
            self.outcome,
            CameraSettings(job.plan.gain_db, job.cell.rig.sensor.max_frames_per_s),
            Overseer(self._tell, self._wait_while_paused),
        )
        compile_now()

    @property
    def burst_times_s(self) -> list[float]:
        """Durations of the bursts, from the start to the last proof of each, on the rig's clock."""
        return self._burst_runner.times_s

    # -- the run ------------------------------------------------------------------------------------------

    def acquire(self) -> Outcome:
        """Take all frames that are not proven yet. Raises UnprovenError if some remain missing, or a
        CoupoleError."""
        visits: Iterable[NextVisit]
        if self._job.plan.chooses_views:
            visits = chosen_visits(self._job, self._arm, self._bursts, self._recorder)
        else:
            visits = planned_visits(self._job, self._arm, self._bursts)
        start_ns = self._cell.clock.now_ns()
        try:
            with collected_when_asked() as collect:
                for next_visit in visits:
                    collect()  # the arm is at rest, nothing shines
                    view = self._job.schedule.views[next_visit.number]
                    self._view_number, self._view_name = next_visit.place, view.name
                    self._ahead_s = self._expected_from(next_visit)
                    self._acquire_view(view, next_visit.visit, next_visit.number, next_visit.bursts)
        except BaseException:
            self._cell.make_safe()
            raise
        finally:
            self._burst_runner.end()
            self._bursts.end()
            self.outcome.duration_s = (self._cell.clock.now_ns() - start_ns) / 1e9
            self.conclude(self._recorder.proven())
        self._dose.refuse_lost_ledger()
        if self.outcome.missing or self.outcome.missing_darks:
            raise UnprovenError(self._say_missing())
        return self.outcome

    def conclude(self, proven_shots: set[ShotId]) -> None:
        """Set the outcome's figures, with these shots as the proven ones."""
        self.outcome.dose_lux_h = self._dose.lux_h_in_all
        self.outcome.proven = sum(shot.is_shot for shot in proven_shots)
        bursts = (burst for n in range(len(self._job.schedule.views)) for burst in self._bursts.bursts(n))
        expected_shots = [shot for burst in bursts for shot in burst.shots if shot]
        self.outcome.shots = sum(shot.is_shot for shot in expected_shots)
        self.outcome.missing = [shot for shot in expected_shots if shot.is_shot and shot not in proven_shots]
        self.outcome.missing_darks = [
            shot for shot in expected_shots if not shot.is_shot and shot not in proven_shots
        ]

    def give_up(self, proven_shots: set[ShotId]) -> None:
        """Set the figures of a session whose thread was left behind. `proven_shots` are the shots whose lines are
        on the disk. For a burst under way the planned light counts."""
        self._dose.give_up()
        self.conclude(proven_shots)

    def _acquire_view(self, view: ViewPose, visit: Visit, number: int, next_bursts: list[Burst]) -> None:
        occlusion = self._job.motion.occlusions.at(visit.joints_deg)
        hidden_leds = self._job.motion.occluded_leds(occlusion)
        self._recorder.note(ViewBegun(view=view.name, hidden_leds=tuple(hidden_leds)))
        patches = self._job.motion.occlusions.patches
        collections = {"shadow": {**occlusion.arrays(patches), "leds": self._job.cell.leds.ids}}
        dwell_s = self._job.cell.rig.motion.settle_dwell_s
        self.outcome.ideal_s += visit.leg.duration_s + dwell_s
        self._wait_for_room(view.name)
        next_bursts = next_bursts or self._bursts.more(number)
        if not next_bursts:  # the view has enough without a frame
            return
        allowed_s = self._expected_s(number)
        waypoints_deg = tuple(tuple(np.round(place, 6).tolist()) for place in visit.leg.waypoints)
        self._recorder.note(MoveBegun(view=view.name, joints_deg=waypoints_deg))
        self._recorder.commit(now=True)  # what the arm is about to do is on the disk before it moves
        self._burst_runner.prepare(next_bursts[0])
        settled_pose = self._arm.go(visit, meanwhile=self._burst_runner.look_at_upload)
        self._ahead_s -= self._motion_s(visit)
        frame_format = self._cell.camera.configure(self._burst_runner.exposure(next_bursts[0]))
        self._check_format(frame_format)
        frames = self._bursts.slots(number)

        def begin(settled_pose: SettledPose) -> None:
            self._recorder.note(
                ArmSettled(
                    view=view.name,
                    joints_deg=tuple(round(angle, 6) for angle in settled_pose.arm.joints_deg),
                    base_from_camera=tuple(map(tuple, np.round(settled_pose.base_from_camera, 6).tolist())),
                )
            )
            arm, base_from_camera = settled_pose.arm, settled_pose.base_from_camera
            self._recorder.begin_view(
                ViewStart(view.name, frames, frame_format, arm, base_from_camera, collections)
            )

        begin(settled_pose)
        try:
            while next_bursts:
                for index, burst in enumerate(next_bursts):
                    self.outcome.ideal_s += burst.duration_s
                    self._acquire_burst(burst, self._following(number, next_bursts[index + 1 :]), begin)
                    self._ahead_s -= _expected_s(burst)
                    allowed_s -= _expected_s(burst)
                next_bursts = self._bursts.more(number)
                if next_bursts:
                    self._burst_runner.prepare(next_bursts[0])
            self._ahead_s -= allowed_s  # what was not chosen
            self._recorder.note(ViewSealed(view=view.name))
        except BaseException:
            self._cell.make_safe()  # before the disk, which may take its time
            raise
        finally:
            self._recorder.end_view()

    def _check_format(self, frame_format: FrameFormat) -> None:
        sensor = self._cell.sensor
        if (frame_format.height_px, frame_format.width_px) != (sensor.height_px, sensor.width_px):
            raise DeviceError(
                "camera",
                expected=f"frames of {sensor.width_px} x {sensor.height_px}, as the rig's `sensor:` says",
                happened=f"the camera makes {frame_format.width_px} x {frame_format.height_px}",
                remedy="Correct the rig, or the camera's region of interest.",
            )

    def _following(self, number: int, known_bursts: list[Burst]) -> Callable[[], Burst | None]:
        """Return a function that gives the next burst of a view, once it is known: the first of these, or of the
        choice that begins now."""
        if known_bursts:
            return lambda: known_bursts[0]
        self._bursts.think_ahead(number)
        return partial(self._bursts.following, number)

    def _acquire_burst(
        self, burst: Burst, following: Callable[[], Burst | None], begin: Callable[[SettledPose], None]
    ) -> None:
        """Fire a burst and then its unproven shots again, up to the plan's limit. `following` is the burst after
        it, once it is known.

        If somebody pushed the arm and it springs back, `begin` is called again for the next frames. The arm is
        never driven back, because a person may have pushed it.
        """
        todo = burst
        attempt = 0
        while attempt <= self._job.plan.reshoot_limit:
            self._wait_while_paused()
            if attempt:
                shots = tuple(shot for shot in todo.shots if shot and shot.is_shot)
                self.outcome.reshot += len(shots)
                self._recorder.note(ReshootBegun(view=burst.view, attempt=attempt, shots=shots))
            try:
                verdict = self._burst_runner.fire(todo, following if todo is burst else None)
                attempt += 1
            except ArmMovedError as moved:
                self._cell.ledbox.lights_off()
                self._note_fault("ArmMoved", f"{burst.view}: {moved}")
                begin(self._arm.await_return(moved))
                verdict = Verdict(NOTHING_TO_MATCH, [])
                attempt += 1
            except (Held, DeviceError) as error:
                if not self._arm.was_held(error) or self._control.stop.is_set():
                    raise
                verdict = Verdict(NOTHING_TO_MATCH, [])  # what was cut short is no attempt
            spoilt = self._recorder.judge(todo, may_retake=attempt <= self._job.plan.reshoot_limit)
            proven_shots = self._recorder.proven()
            missing_shots = [shot for shot in todo.shots if shot and shot not in proven_shots]
            if not missing_shots:
                return
            self._note_gap(burst, verdict.because(spoilt), missing_shots)
            self.outcome.bad |= set(verdict.dead)
            todo = burst.only({shot.label for shot in missing_shots})

    def _note_fault(self, kind: str, message: str) -> None:
        self._observer.note(message)
        self._recorder.note(FaultNoted(kind=kind, message=message))

    # -- small things -------------------------------------------------------------------------------------

    def _expected_s(self, number: int) -> float:
        """Longest duration of the bursts that a view may still get."""
        is_open = self._bursts.may_want_more(number)
        bursts = self._bursts.bound(number) if is_open else self._bursts.bursts_left(number)
        return sum(map(_expected_s, bursts))

    def _expected_from(self, next_visit: NextVisit) -> float:
        """Longest duration of the rest of the run, with this view. Views that are not chosen yet count as this
        one."""
        here_s = self._motion_s(next_visit.visit) + self._expected_s(next_visit.number)
        if self._job.plan.chooses_views:
            return here_s * max(1, self._job.schedule.view_count - next_visit.place)
        return here_s + sum(
            self._motion_s(visit) + self._expected_s(number) for number, visit in next_visit.following
        )

    def _motion_s(self, visit: Visit | None) -> float:
        """Expected duration of the motion to a view, until the arm has settled."""
        leg_s = visit.leg.duration_s if visit else 0.0
        return leg_s + self._job.cell.rig.motion.settle_dwell_s + SETTLE_CHECK_S

    def _note_gap(self, burst: Burst, verdict: Verdict, shots_left: Sequence[ShotId]) -> None:
        frame_match = verdict.match
        missing_frames = int(frame_match.missing.sum())
        lost_frames = int(frame_match.lost_in_transfer.sum())
        self._recorder.note(
            GapFound(
                view=burst.view,
                shots=tuple(shots_left),
                missing=missing_frames,
                lost_in_transfer=lost_frames,
                surplus=int(frame_match.surplus.sum()),
                dead_leds=tuple(verdict.dead),
                reason=frame_match.reason,
            )
        )
        why = [f"{lost_frames} lost in transfer"] if lost_frames else []
        why += [f"{missing_frames - lost_frames} never exposed"] if missing_frames > lost_frames else []
        why += [f"{len(verdict.dead)} with an LED that draws no current"] if verdict.dead else []
        why += [frame_match.reason] if frame_match.reason else []
        self._observer.note(f"{burst.view}: {len(shots_left)} frames not proven ({'; '.join(why) or 'aborted'})")

    def _say_missing(self) -> str:
        missing, bad = self.outcome.missing + self.outcome.missing_darks, self.outcome.bad
        text = f"{len(missing)} frames are not proven after {self._job.plan.reshoot_limit} re-shoots: "
        text += ", ".join(map(str, missing[:5])) + (", ..." if len(missing) > 5 else "")
        if bad:
            text += f". In {len(bad)} of them the LED drew no current: repair it or leave it out of `lights:`"
        return text + ". Resume the run to try again."

    def _tell(self, burst: Burst, step: int) -> None:
        label = burst.labels[min(step, len(burst.labels) - 1)]
        left_s = self._ahead_s - float(burst.table["period_us"][:step].sum()) / 1e6
        self._tell_figures(str(label.light) if label else "dark", self._dose.lux_h_after(step), left_s)

    def _tell_figures(self, light: str, dose_lux_h: float, left_s: float) -> None:
        schedule, proven = self._job.schedule, len(self._recorder.proven())
        place = (self._view_name, self._view_number, schedule.view_count)
        frames = sum(self._bursts.expected_frames(number) for number in range(len(schedule.views)))
        self._observer.progress(Progress(*place, proven, frames, light, dose_lux_h, left_s))

    def _wait_for_room(self, view: str) -> None:
        """Wait, lights off and the arm at rest, while the disk has no room for a view but may have it soon."""
        if self._recorder.has_room(view):
            return
        self._observer.note(
            f"the run waits for space on the disk before {view}: frames of earlier views will be discarded"
        )
        while not self._recorder.has_room(view):
            self._wait_while_paused()
            with contextlib.suppress(Held):  # the pause that follows says why
                self._arm.attend()
            self._cell.clock.sleep(_ROOM_NAP_S)

    def _wait_while_paused(self) -> None:
        control = self._control
        if not control.pause.is_set():
            return
        was_held = control.stands
        while control.halting.is_set():
            self._cell.clock.sleep(_PAUSE_NAP_S, _PAUSE_NAP_S)
        if was_held:
            self._note_fault("Held", control.held_because)
            control.hold_pending.clear()
        self._recorder.note(Paused())
        self._recorder.commit(now=True)
        self._tell_figures("dark", self._dose.lux_h_in_all, self._ahead_s)
        self._observer.note("paused: lights are off, the arm is at rest; the key p or `coupole go-on` continues")
        control.standing.set()
        try:
            while control.pause.is_set() or control.halting.is_set():
                if control.unsure:
                    raise DeviceError(
                        "cell",
                        expected="lights off and the arm at rest while the session is paused",
                        happened="; ".join(control.unsure),
                        remedy="Look at the cell, then resume the run.",
                    )
                if control.hold_pending.is_set():  # again, while it stands
                    self._note_fault("Held", control.held_because)
                    control.hold_pending.clear()
                    was_held = True
                with contextlib.suppress(Held):  # it is held already
                    self._arm.attend()
                self._cell.clock.sleep(_PAUSE_NAP_S)
        finally:
            control.standing.clear()
        if was_held:  # the box may have switched off by its watchdog, which it keeps as a fault
            self._burst_runner.forget_upload()
            self._cell.ledbox.acknowledge()
        self._recorder.note(Continued())
        self._observer.note("continued")


def _expected_s(burst: Burst) -> float:
    return burst.duration_s + BURST_OVERHEAD_S
