"""Runs one burst in the box, takes its frames and proves them (`host_burst`: bursts that the host fires)."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from concurrent import futures
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.arm_supervisor import ArmMovedError, ArmSupervisor
from coupole.acquisition.dose import DoseMeter, led_time_s
from coupole.acquisition.frame_grabber import FrameGrabber, buffers_for, memory_for_buffers
from coupole.acquisition.frame_matching import UNLABELLED, FaultModel, Match, match
from coupole.acquisition.host_burst import HostBurst, Overseer
from coupole.acquisition.opened_cell import OpenedCell
from coupole.acquisition.recorder import Recorder
from coupole.acquisition.verdict import Verdict
from coupole.bounded import Workers
from coupole.clock import Deadline
from coupole.devices import NO_LED, STEP_RECORD_DTYPE, ArmState, CameraStatistics, Exposure, StepRecord, table_box
from coupole.errors import DeviceError, DeviceTimeout, StorageError
from coupole.plan.bursts import Burst
from coupole.plan.shot_id import ShotId
from coupole.storage.journal_events import BurstEnded, Joints
from coupole.storage.step_fields import step_fields
from coupole.viewing.progress import Outcome

_POLL_S = 0.05
_LAST_POLL_S = 0.002
"""Pause between readings of the log after the table should have ended: short, because the next burst waits for the
end."""
_STALL_S = 5.0
"""Additional time beyond the duration of a step. A box that logs no step for longer than both together has
stopped."""
_LAST_STRETCH_S = 0.3
"""The last part of a burst runs in real time, so that a host that fell behind in a dry run catches up."""
_BOX_JITTER_US = 20.0


@dataclass
class _RunningBurst:
    """A running burst: data from box and camera so far."""

    burst: Burst
    grabber: FrameGrabber
    arm_before: ArmState
    following: Callable[[], Burst | None] | None
    """Gives the burst after this one, once it is known; None if nobody knows it, or if its upload has begun."""
    arm_after: ArmState | None = None
    """Measured after the last frame; None while the burst runs, and if the arm was not still."""
    log: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, STEP_RECORD_DTYPE))
    match: Match | None = None
    proven: set[int] = field(default_factory=set)
    """Frames already passed to the recorder."""
    started_ns: int | None = None
    """Time when the box was told to run the table, on the rig's clock; None until then."""
    runs_since_ns: int | None = None
    """Time when the box had answered that it runs the table."""
    panel_since_ns: int | None = None
    """Time when the panel was switched on; None without one."""


@dataclass(frozen=True)
class CameraSettings:
    """Settings of the camera that all bursts share."""

    gain_db: float
    max_frames_per_s: float


class BurstRunner:
    """Fires bursts while the arm is at rest."""

    def __init__(
        self,
        cell: OpenedCell,
        recorder: Recorder,
        arm: ArmSupervisor,
        dose: DoseMeter,
        outcome: Outcome,
        camera: CameraSettings,
        overseer: Overseer,
    ) -> None:
        self._cell, self._recorder, self._arm, self._dose = cell, recorder, arm, dose
        self._outcome, self._camera, self._overseer = outcome, camera, overseer
        self._by_host = HostBurst(cell, recorder, arm, overseer, dose, self._note)
        self._uploader = Workers(1, "upload")
        self._upload: futures.Future[None] | None = None
        self._buffer_memory_bytes = memory_for_buffers()
        self._buffers = 0
        """Buffers of the previous burst; never reduced, because a new size means newly allocated memory."""
        self.times_s: list[float] = []
        """Durations of the bursts, from the start to the last proof of each, on the rig's clock."""

    def end(self) -> None:
        """Let the thread that uploads tables end when it has finished, because no more bursts come. Does not wait
        for it."""
        self._uploader.end_soon()

    def exposure(self, burst: Burst) -> Exposure:
        """Return the settings that the camera must have for a burst."""
        return Exposure(burst.timing.exposure_us, self._camera.gain_db, burst.hardware)

    def prepare(self, burst: Burst) -> None:
        """Begin to upload the burst's table in another thread, so that the arm is watched meanwhile."""
        if burst.hardware:
            box = table_box(self._cell.ledbox)
            self._upload = self._uploader.submit(box.load, burst.table)

    def look_at_upload(self) -> None:
        """Raise the error of the upload, if it has failed so far."""
        if self._upload is not None and self._upload.done() and self._upload.exception() is not None:
            upload, self._upload = self._upload, None
            upload.result()

    def forget_upload(self) -> None:
        """Forget the upload: the lights were switched off, which ends an upload. `fire` uploads the table
        again."""
        upload, self._upload = self._upload, None
        if upload is not None:
            futures.wait([upload], timeout=_STALL_S)

    def _await_upload(self) -> None:
        """Wait until the table is in the box, and watch the arm meanwhile. Raises the error of the upload."""
        while self._upload is not None:
            self._arm.attend()
            if futures.wait([self._upload], timeout=_POLL_S).done:
                upload, self._upload = self._upload, None
                upload.result()

    def fire(self, burst: Burst, following: Callable[[], Burst | None] | None = None) -> Verdict:
        """Run one burst and prove its frames; dose and figures are recorded even if this raises.

        `following` gives the burst after this one, as soon as it is known. The table of the next burst is
        uploaded meanwhile. Raises ArmMovedError.
        """
        frame_format = self._cell.camera.configure(self.exposure(burst))
        if not burst.hardware:
            return self._by_host.fire(burst, frame_format)
        self._await_upload()
        self.prepare(burst)  # nothing to upload, unless the burst was reduced
        self._await_upload()
        needed_us = self._cell.camera.min_period_us(self.exposure(burst))
        if burst.timing.period_us < needed_us:
            raise DeviceError(
                "camera",
                expected=f"to be triggered at intervals of at least {needed_us} us",
                happened=f"with the rig's `sensor:` the intervals would be {burst.timing.period_us} us",
                remedy="Lower `max_frames_per_s`, or raise `exposure_gap_us`, in the rig.",
            )
        period_s = burst.timing.period_us * 1e-6
        buffers = buffers_for(len(burst.labels), frame_format.frame_bytes, period_s, self._buffer_memory_bytes)
        self._buffers = max(self._buffers, buffers)
        return self._by_cable(burst, following, self._buffers)

    def _by_cable(self, burst: Burst, following: Callable[[], Burst | None] | None, buffers: int) -> Verdict:
        box, camera, clock = table_box(self._cell.ledbox), self._cell.camera, self._cell.clock
        grabber = FrameGrabber(camera, lambda frame: self._recorder.store(frame, burst.timing.exposure_us))
        running = _RunningBurst(burst, grabber, self._cell.robot.measured(), following)
        camera.arm(buffers)
        try:
            grabber.start()
            self._dose.begin(burst)
            self._arm.attend()
            if burst.panel:
                running.panel_since_ns = clock.now_ns()
                box.panel(burst.panel, True)
            running.started_ns = started_ns = clock.now_ns()
            box.start(burst.table)
            running.runs_since_ns = clock.now_ns()
            self._arm.hurry(burst.duration_s - _LAST_STRETCH_S)
            self._follow(running)
            self.times_s.append((clock.now_ns() - started_ns) / 1e9)
            if burst.panel:
                box.panel(burst.panel, False)
        except BaseException as error:
            if isinstance(error, ArmMovedError) or self._arm.was_held(error):
                self._cell.switch_off()
                self._upload = None  # that has ended it: `fire` uploads anew
                camera.disarm()
                self._end(running, camera=None)
                raise
            self._cell.make_safe()
            with contextlib.suppress(Exception):  # the disk; it must not hide the error that ended the burst
                self._end(running, camera=None)
            raise
        statistics = camera.statistics()
        camera.disarm()
        self._end(running, camera=statistics)
        grabber.raise_error()  # after its last frame: all are stored, but the camera is not to be trusted
        log = running.log
        dark = (log["led"] != NO_LED) & log["led_open"]
        assert running.match is not None
        return Verdict(running.match, [shot for i in np.flatnonzero(dark) if (shot := burst.shots[i])])

    def _follow(self, running: _RunningBurst) -> None:
        """Read log and frames until the burst is over, and prove frames meanwhile."""
        box, clock, burst, grabber = table_box(self._cell.ledbox), self._cell.clock, running.burst, running.grabber
        readout_s = 1.0 / self._camera.max_frames_per_s + burst.timing.exposure_us * 1e-6
        step_s = burst.timing.period_us * 1e-6
        next_step = Deadline(clock, step_s + _STALL_S)
        last_frames: Deadline | None = None
        ends_ns = (running.started_ns or clock.now_ns()) + round(1e9 * burst.duration_s)
        edges = 0
        judged_at = (-1, -1)
        taken_frames, confirmed_frames, heard_ns = 0, 0, 0
        while True:
            if running.following is not None and (following := running.following()) is not None:
                self.prepare(following)
                running.following = None
            if (news_ns := self._arm.heard_at_rest()) > heard_ns:
                # frames that had arrived in the last round were taken at rest
                heard_ns, confirmed_frames = news_ns, taken_frames
            # before the log is read: the proof needs frames that are older than the log
            taken_frames = len(grabber)
            steps = box.poll_log()
            if len(steps):
                running.log = np.concatenate([running.log, steps])
                next_step = Deadline(clock, step_s + _STALL_S)
            if len(running.log) == len(burst.table) and last_frames is None:
                last_frames = Deadline(clock, readout_s + self._cell.camera.delivery_s)
                edges = box.edges()
                grabber.expect_end()
            complete = last_frames is not None and (taken_frames >= edges or last_frames.has_expired)
            if complete:
                in_transfer = Deadline(clock, readout_s)  # a surplus frame, exposed before now like all others
                running.arm_after = self._arm.await_news()
                clock.sleep(in_transfer.remaining_s)
                taken_frames = confirmed_frames = len(grabber)
                grabber.end_soon()
            if complete or (confirmed_frames, len(running.log)) != judged_at:
                judged_at = (confirmed_frames, len(running.log))
                running.match = self._match(running, taken_frames, complete=complete)
                self._prove(running, confirmed_frames, complete=complete)
                self._overseer.tell(burst, len(running.log))
            if complete:
                return
            self._recorder.commit(now=False)
            if last_frames is None and next_step.has_expired:
                raise DeviceTimeout(
                    "led box",
                    expected=f"a step of the burst every {1e3 * step_s:.0f} ms",
                    happened=(
                        f"none came for {next_step.seconds:.1f} s; {len(running.log)} of {len(burst.table)} "
                        "steps are in its log"
                    ),
                    remedy="Check the box, then resume the run.",
                )
            clock.sleep(_pause_s((ends_ns - clock.now_ns()) / 1e9))

    def _match(self, running: _RunningBurst, frame_count: int, *, complete: bool) -> Match:
        frame_ids, timestamps_ns = running.grabber.frames(frame_count)
        return match(
            running.log,
            frame_ids,
            timestamps_ns,
            id_modulus=self._cell.camera.id_modulus,
            complete=complete,
            model=FaultModel(jitter_us=self._cell.camera.timestamp_jitter_us + _BOX_JITTER_US),
        )

    def _prove(self, running: _RunningBurst, confirmed_count: int, *, complete: bool) -> None:
        """Pass newly proven frames among the first `confirmed_count` to the recorder, once their bytes are
        written."""
        frame_match, grabber, log = running.match, running.grabber, running.log
        assert frame_match is not None
        for frame in np.flatnonzero(frame_match.step_of_frame != UNLABELLED).tolist():
            if frame in running.proven or frame >= confirmed_count or not (complete or grabber.is_written(frame)):
                continue
            record = StepRecord(*log[frame_match.step_of_frame[frame]].tolist())
            label = running.burst.labels[record.step]
            if label and not record.invalid_exposure:
                shot = ShotId(running.burst.view, label)
                self._recorder.prove(grabber.slot(frame), shot, step_fields(record, record.t_trigger_ns))
                running.proven.add(frame)

    def _see_marks(self, running: _RunningBurst) -> None:
        """Show the recorder the frames of marks that have no label. These frames are not kept."""
        steps = running.match.step_of_frame if running.match is not None else ()
        for frame, row in enumerate(steps):
            step = int(running.log[row]["step"]) if row != UNLABELLED else UNLABELLED
            if step != UNLABELLED and running.burst.labels[step] is None:
                self._recorder.see_mark(running.grabber.slot(frame), running.burst, step)

    def _end(self, running: _RunningBurst, camera: CameraStatistics | None) -> None:
        """Record dose and figures, release unproven frames, commit the proven ones."""
        log, grabber, dark_ns = running.log, running.grabber, self._dark_ns(running)
        grabber.stop()
        self._see_marks(running)
        for frame in range(grabber.count):
            if frame not in running.proven:
                self._recorder.free(grabber.slot(frame))
        if camera is not None:
            self._outcome.over_triggers += max(0, camera.over_triggers)
            self._outcome.lost_transfers += max(0, camera.lost_transfers)
        clocks = running.match.clocks if running.match is not None else None
        self._note(
            running.burst,
            log,
            running.arm_before,
            running.arm_after,
            table_ran_s=_since_s(running.started_ns, dark_ns),
            panel_s=_since_s(running.panel_since_ns, dark_ns),
            frames=grabber.count,
            table_s=running.burst.duration_s,
            clocks=None if clocks is None else vars(clocks),
            camera=None if camera is None else vars(camera),
            hottest_board_c=_hottest_c(log),
        )

    def _dark_ns(self, running: _RunningBurst) -> int:
        """Return the time until which the burst may have given light. This time is now. It is earlier if the box
        has already switched all lights off, for example because somebody suspended the program. A call that was
        made before the table ran does not count."""
        since_ns, now_ns = running.runs_since_ns, self._cell.clock.now_ns()
        offs = self._cell.switched_off_ns if since_ns is not None else ()
        return next((dark_ns for told_ns, dark_ns in offs if told_ns >= (since_ns or 0)), now_ns)

    def _note(
        self,
        burst: Burst,
        log: NDArray[np.void],
        arm_before: ArmState,
        arm_after: ArmState | None,
        *,
        table_ran_s: float = 0.0,
        panel_s: float,
        **figures: Any,
    ) -> None:
        """Count the burst's light. Write the light to the journal first, then to the ledger."""
        given_lux_h = self._dose.count(burst, log, table_ran_s=table_ran_s, panel_s=panel_s)
        self._recorder.note(
            BurstEnded(
                view=burst.view,
                steps=len(log),
                on_s=round(led_time_s(burst, log, table_ran_s), 6),
                given_lux_h=given_lux_h,
                joints_before_deg=_rounded_joints_deg(arm_before),
                joints_after_deg=_rounded_joints_deg(arm_after) if arm_after else None,
                **figures,
            )
        )
        try:
            self._recorder.commit(now=True)
        except StorageError:
            if not any(given_lux_h):  # the disk refused already its plan: nothing was lit
                self._dose.end(given_lux_h)
            raise
        self._dose.end(given_lux_h)


def _pause_s(left_s: float) -> float:
    """Return the pause before the next look at the log, `left_s` before the table's end. The last records, which
    come over a slow line, are asked for as soon as they exist."""
    if abs(left_s) > _POLL_S:
        return _POLL_S
    return max(left_s, _LAST_POLL_S)


def _since_s(begun_ns: int | None, ended_ns: int) -> float:
    """Seconds; 0 for a burst that has not begun."""
    return 0.0 if begun_ns is None else (ended_ns - begun_ns) / 1e9


def _hottest_c(log: NDArray[np.void]) -> float | None:
    """The highest temperature in a log; None if it has none."""
    temperatures_c = log["board_temperature_c"][np.isfinite(log["board_temperature_c"])]
    return float(temperatures_c.max()) if len(temperatures_c) else None


def _rounded_joints_deg(arm: ArmState) -> Joints:
    return tuple(round(angle, 6) for angle in arm.joints_deg)
