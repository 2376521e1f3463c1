"""One burst: run a table, take its frames, prove them while it runs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.arm_supervisor import ArmSupervisor
from coupole.acquisition.dose import DoseMeter
from coupole.acquisition.frame_grabber import FrameGrabber, buffers_for, memory_for_buffers
from coupole.acquisition.frame_matching import UNLABELLED, FaultModel, Match, match
from coupole.acquisition.opened_cell import OpenedCell
from coupole.acquisition.recorder import Recorder
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
)
from coupole.errors import CoupoleError, DeviceError, DeviceTimeout
from coupole.plan.bursts import Burst
from coupole.plan.shot_id import ShotId
from coupole.storage.journal_events import BurstEnded, Joints
from coupole.viewing.progress import Outcome

_POLL_S = 0.05
_STALL_S = 5.0
"""A box that logs no step for so much longer than a step takes has stopped."""
_LAST_STRETCH_S = 0.3
"""Of a burst: time enough for a host that fell behind in a hurry to catch up before the end."""
_BOX_JITTER_US = 20.0
_ONE_SHOT_BUFFERS = 8
_UNCOUNTED = -1
"""A camera that does not count its exposures: one frame came while the light shone, which must do."""
_INVALID_EXPOSURE = STATUS_LED_OPEN | STATUS_OVER_TEMPERATURE


@dataclass(frozen=True)
class Verdict:
    """Of one burst, after its end."""

    match: Match
    dead: list[ShotId]
    """Shots whose LED drew no current."""


_NONE = np.zeros(0, np.int64)
NOTHING_TO_MATCH = Match(_NONE, _NONE > 0, _NONE > 0, _NONE > 0, ambiguous=False, reason="", clocks=None)


@dataclass
class _RunningBurst:
    """A burst that runs: what box and camera have said of it so far."""

    burst: Burst
    grabber: FrameGrabber
    arm_before: ArmState
    arm_after: ArmState | None = None
    """Measured after the last frame; None while it runs, and where the arm did not stand still."""
    log: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, STEP_RECORD_DTYPE))
    judged: Match | None = None
    proven: set[int] = field(default_factory=set)
    """Frames that the recorder has been told of."""


class BurstRunner:
    """Fires bursts at an arm that stands. `tell(burst, step)` is called as it goes."""

    def __init__(
        self,
        cell: OpenedCell,
        recorder: Recorder,
        arm: ArmSupervisor,
        dose: DoseMeter,
        outcome: Outcome,
        *,
        gain_db: float,
        max_frames_per_s: float,
        tell: Callable[[Burst, int], None],
        wait_while_paused: Callable[[], None],
    ) -> None:
        self._cell, self._recorder, self._arm, self._dose = cell, recorder, arm, dose
        self._outcome, self._gain_db, self._max_frames_per_s = outcome, gain_db, max_frames_per_s
        self._tell, self._wait_while_paused = tell, wait_while_paused
        self._buffer_memory_bytes = memory_for_buffers()
        self._buffers = 0
        """Never fewer than the burst before had: a ring that changes its size is memory to be touched anew."""
        self.times_s: list[float] = []
        """From start to last proof of each burst, on the rig's clock."""

    def exposure(self, burst: Burst) -> Exposure:
        """How the camera must be configured for a burst."""
        return Exposure(burst.timing.exposure_us, self._gain_db, burst.hardware)

    def fire(self, burst: Burst, following: Burst | None) -> Verdict:
        """Run one table and prove its frames; whatever happens, note what light was given and what was seen.

        The table of the burst that is `following` is brought into the box meanwhile. Raises ArmMovedError.
        """
        frame_format = self._cell.camera.configure(self.exposure(burst))
        self._cell.ledbox.load(burst.table)
        if not burst.hardware:
            return self._by_software(burst)
        needed_us = self._cell.camera.min_period_us(self.exposure(burst))
        if burst.timing.period_us < needed_us:
            raise DeviceError(
                "camera",
                expected=f"to be triggered every {needed_us} us at the most",
                happened=f"the rig's `sensor:` has it triggered every {burst.timing.period_us} us",
                remedy="Lower `max_frames_per_s`, or raise `exposure_gap_us`, in the rig.",
            )
        period_s = burst.timing.period_us * 1e-6
        wanted = buffers_for(len(burst.labels), frame_format.frame_bytes, period_s, self._buffer_memory_bytes)
        self._buffers = max(self._buffers, wanted)
        return self._by_cable(burst, following, self._buffers)

    # -- the box triggers the camera ----------------------------------------------------------------------

    def _by_cable(self, burst: Burst, following: Burst | None, buffers: int) -> Verdict:
        box, camera, clock = self._cell.ledbox, self._cell.camera, self._cell.clock
        grabber = FrameGrabber(camera, lambda frame: self._recorder.put(frame, burst.timing.exposure_us))
        running = _RunningBurst(burst, grabber, self._cell.robot.measured())
        camera.arm(buffers)
        try:
            grabber.start()
            if burst.panel:
                box.panel(burst.panel, True)
            started_ns = clock.now_ns()
            box.start(burst.table)
            if following is not None:
                box.load(following.table)
            self._arm.hurry(burst.duration_s - _LAST_STRETCH_S)
            self._follow(running)
            self.times_s.append((clock.now_ns() - started_ns) / 1e9)
            if burst.panel:
                box.panel(burst.panel, False)
        except BaseException:
            with contextlib.suppress(DeviceError):
                camera.disarm()
            with contextlib.suppress(CoupoleError):
                self._end(running, camera=None)
            raise
        statistics = camera.statistics()
        camera.disarm()
        self._end(running, camera=statistics)
        log = running.log
        dark = (log["led"] != NO_LIGHT) & ((log["status"] & STATUS_LED_OPEN) != 0)
        assert running.judged is not None
        return Verdict(running.judged, [shot for i in np.flatnonzero(dark) if (shot := burst.shots[i])])

    def _follow(self, running: _RunningBurst) -> None:
        """Read log and frames until the burst is over, proving as it goes."""
        box, clock, burst, grabber = self._cell.ledbox, self._cell.clock, running.burst, running.grabber
        readout_s = 1.0 / self._max_frames_per_s + burst.timing.exposure_us * 1e-6
        step_s = burst.timing.period_us * 1e-6
        next_step = Deadline(clock, step_s + _STALL_S)
        last_frames: Deadline | None = None
        edges = 0
        judged_at = (-1, -1)
        taken, confirmed, heard_ns = 0, 0, 0
        while True:
            if (news_ns := self._arm.heard_at_rest()) > heard_ns:
                heard_ns, confirmed = news_ns, taken  # what had come by the last round was taken at rest
            taken = len(grabber)  # before the log is read: the proof needs frames that are older than the log
            steps = box.poll_log()
            if len(steps):
                running.log = np.concatenate([running.log, steps])
                next_step = Deadline(clock, step_s + _STALL_S)
            if len(running.log) == len(burst.table) and last_frames is None:
                last_frames = Deadline(clock, readout_s + self._cell.camera.delivery_s)
                edges = box.edges()
            complete = last_frames is not None and (taken >= edges or last_frames.expired)
            if complete:
                clock.sleep(readout_s)  # a surplus frame may be on its way still
                taken = confirmed = len(grabber)
                running.arm_after = self._arm.await_news()
            if complete or (confirmed, len(running.log)) != judged_at:
                judged_at = (confirmed, len(running.log))
                running.judged = self._match(running, taken, complete=complete)
                self._prove(running, confirmed, complete=complete)
                self._tell(burst, len(running.log))
            if complete:
                return
            self._recorder.commit(now=False)
            if last_frames is None and next_step.expired:
                raise DeviceTimeout(
                    "led box",
                    expected=f"a step of the burst every {1e3 * step_s:.0f} ms",
                    happened=f"none came for {next_step.seconds:.1f} s; "
                    f"{len(running.log)} of {len(burst.table)} are in its log",
                    remedy="Check the box, then resume the run.",
                )
            clock.sleep(_POLL_S)

    def _match(self, running: _RunningBurst, taken: int, *, complete: bool) -> Match:
        frame_ids, timestamps_ns = running.grabber.frames(taken)
        return match(
            running.log,
            frame_ids,
            timestamps_ns,
            id_modulus=self._cell.camera.id_modulus,
            complete=complete,
            model=FaultModel(jitter_us=self._cell.camera.timestamp_jitter_us + _BOX_JITTER_US),
        )

    def _prove(self, running: _RunningBurst, confirmed: int, *, complete: bool) -> None:
        """Hand newly proven frames to the recorder, of the first `confirmed`, once their bytes are written."""
        judged, grabber, log = running.judged, running.grabber, running.log
        assert judged is not None
        for frame in np.flatnonzero(judged.step_of_frame != UNLABELLED).tolist():
            if frame in running.proven or frame >= confirmed or not (complete or grabber.kept(frame)):
                continue
            record = log[judged.step_of_frame[frame]]
            label = running.burst.labels[int(record["step"])]
            invalid = record["led"] != NO_LIGHT and record["status"] & _INVALID_EXPOSURE
            if label and not invalid:
                shot = ShotId(running.burst.view, label)
                self._recorder.prove(grabber.slot(frame), shot, _fields(record, int(record["t_trigger_ns"])))
                running.proven.add(frame)

    def _end(self, running: _RunningBurst, camera: CameraStatistics | None) -> None:
        """Note light and figures, give back what is not wanted, make the rest last."""
        log, grabber = running.log, running.grabber
        grabber.stop()
        for frame in range(grabber.count):
            if frame not in running.proven:
                self._recorder.free(grabber.slot(frame))
        if camera is not None:
            self._outcome.over_triggers += max(0, camera.over_triggers)
            self._outcome.lost_transfers += max(0, camera.lost_transfers)
        clocks = running.judged.clocks if running.judged is not None else None
        self._note(
            running.burst,
            log,
            running.arm_before,
            running.arm_after,
            frames=grabber.count,
            table_s=running.burst.duration_s,
            clocks=None if clocks is None else vars(clocks),
            camera=None if camera is None else vars(camera),
            hottest_board_c=float(log["board_temperature_dc"].max()) / 10 if len(log) else None,
        )

    # -- the host triggers the camera ---------------------------------------------------------------------

    def _by_software(self, burst: Burst) -> Verdict:
        """One light at a time, fired by the host: a frame is proven by being the only one, taken while the box
        says that this very step is running, from before the trigger until after the frame has come."""
        logs = []
        dead: list[ShotId] = []
        arm_before, arm_after = self._cell.robot.measured(), None
        try:
            for index, shot in enumerate(burst.shots):
                assert shot is not None
                self._arm.attend()
                self._wait_while_paused()
                frame, record, lit_throughout = self._fire_one(burst, burst.table[index : index + 1])
                logs.append(record)
                step = record[0]
                if step["led"] != NO_LIGHT and step["status"] & _INVALID_EXPOSURE:
                    dead.append(shot)
                    lit_throughout = False
                arm_after = None
                arm_after = self._arm.await_news()
                if frame is not None:
                    self._keep(frame, burst, shot, step, proven=lit_throughout)
                self._tell(burst, index)
                self._recorder.commit(now=False)
        finally:
            log = np.concatenate([np.zeros(0, STEP_RECORD_DTYPE), *logs])
            self._note(burst, log, arm_before, arm_after, frames=len(log))
        return Verdict(NOTHING_TO_MATCH, dead)

    def _keep(self, frame: Frame, burst: Burst, shot: ShotId, step: np.void, *, proven: bool) -> None:
        slot = self._recorder.put(frame, burst.timing.exposure_us)
        frame.release()
        if not proven:
            self._recorder.free(slot)
            return
        t_trigger_ns = int(step["t_on_ns"]) + burst.timing.trigger_delay_us * 1000
        self._recorder.prove(slot, shot, _fields(step, t_trigger_ns))

    def _fire_one(self, burst: Burst, single: NDArray[np.void]) -> tuple[Frame | None, NDArray[np.void], bool]:
        """Light one step, trigger the camera; the frame, the step's record, and whether the one frame that was
        exposed came while the step was running."""
        box, camera, clock = self._cell.ledbox, self._cell.camera, self._cell.clock
        camera.arm(_ONE_SHOT_BUFFERS)
        try:
            if burst.panel:
                box.panel(burst.panel, True)
            box.load(single)
            box.start(single)
            clock.sleep(burst.timing.trigger_delay_us * 1e-6)
            camera.trigger()
            frame = camera.next_frame(burst.timing.on_us * 1e-6 + camera.delivery_s)
            lit_throughout = box.running() and camera.statistics().exposed in (1, _UNCOUNTED)
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

    def _note(
        self,
        burst: Burst,
        log: NDArray[np.void],
        arm_before: ArmState,
        arm_after: ArmState | None,
        **figures: Any,
    ) -> None:
        """The burst's line in the journal."""
        self._recorder.note(
            BurstEnded(
                view=burst.view,
                steps=len(log),
                on_s=self._dose.add(burst, log),
                joints_before_deg=_rounded(arm_before),
                joints_after_deg=_rounded(arm_after) if arm_after else None,
                **figures,
            )
        )
        self._recorder.commit(now=True)


def _fields(record: np.void, t_trigger_ns: int) -> dict[str, int]:
    """What the frame table keeps of a step's record."""
    names = ("led", "step", "board_temperature_dc", "led_current_ma", "status")
    return {"t_trigger_ns": t_trigger_ns, **{name: int(record[name]) for name in names}}


def _rounded(arm: ArmState) -> Joints:
    return tuple(round(angle, 6) for angle in arm.joints_deg)
