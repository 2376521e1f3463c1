"""A burst that the host fires, light by light, with any box and any camera that takes a software trigger.

**Proof.** A frame belongs to a light if it is the only frame that was exposed, and it was exposed entirely while
that light was on. The camera is armed in the dark, and the light is switched on. After the box has confirmed this,
the camera is triggered. The light must still be on, without interruption, when the frame has arrived. For a box
without a log (`Burst.marks` is `plain`) the only evidence is the host's clock and the box's confirmation. There an
LED that cannot be switched off would light all later frames. So a burst begins and ends with dark frames as marks,
and no frame of the burst is proven until both marks have been found dark.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from typing import Protocol

import numpy as np

from coupole.acquisition.arm_supervisor import ArmMovedError, ArmSupervisor
from coupole.acquisition.opened_cell import OpenedCell
from coupole.acquisition.recorder import Recorder
from coupole.acquisition.verdict import NOTHING_TO_MATCH, Verdict
from coupole.devices import (
    NO_LED,
    STEP_RECORD_DTYPE,
    UNKNOWN_NS,
    Frame,
    FrameFormat,
    StepRecord,
)
from coupole.plan.bursts import Burst
from coupole.plan.shot_id import ShotId
from coupole.storage.step_fields import step_fields

_ONE_SHOT_BUFFERS = 8
_UNCOUNTED = -1
"""Stands for a camera without an exposure counter. The proof then rests on the fact that no other frame arrived
while the light was on."""
DARK_QUANTILE, DARK_SHARE = 0.99, 0.02
"""A mark is dark if the first share of its pixels is less than the second share of the camera's range above black.
Noise is far below this limit. An LED that lights a hundredth of the picture is detected."""


@dataclass(frozen=True)
class _Taken:
    """One light and the camera's frames under it."""

    frame: Frame | None
    record: StepRecord
    alone: bool
    """The frame is the only one, and arrived while the light was on without interruption."""
    t_trigger_ns: int
    """Time of the trigger, on the box's clock, or on the host's if the box has none."""


@dataclass(frozen=True)
class _Kept:
    """A stored frame that waits for the burst's marks."""

    slot: int
    shot: ShotId
    fields: dict[str, int]


class Dose(Protocol):
    """Light on the object (`coupole.acquisition.dose`). Both methods raise DoseBudgetReached and StorageError."""

    def begin(self, burst: Burst) -> None: ...

    def ask_again(self, burst: Burst, step: int) -> None: ...


@dataclass(frozen=True)
class Overseer:
    """The session, which follows bursts and may pause them."""

    tell: Callable[[Burst, int], None]
    """Called during a burst, with the number of its step."""
    wait_while_paused: Callable[[], None]


class HostBurst:
    """Fires bursts with software trigger. The `dose` is asked before the burst and before each of its lights.
    `note` counts the burst's light and writes its journal line."""

    def __init__(
        self,
        cell: OpenedCell,
        recorder: Recorder,
        arm: ArmSupervisor,
        overseer: Overseer,
        dose: Dose,
        note: Callable[..., None],
    ) -> None:
        self._cell, self._recorder, self._arm = cell, recorder, arm
        self._overseer, self._dose, self._note = overseer, dose, note
        self._panel_s = 0.0
        """Greatest time for which the panel of this burst can have been on."""

    def fire(self, burst: Burst, frame_format: FrameFormat) -> Verdict:
        """Fire one light after the other. The dose is recorded even if this raises, with the dose of the light
        that was on. Raises ArmMovedError."""
        records: list[StepRecord] = []
        taken_frames = 0
        dead: list[ShotId] = []
        kept_frames: list[_Kept] = []
        marks = set(range(len(burst.labels))) - set(burst.inner)
        reason = ""
        arm_before, arm_after = self._cell.robot.measured(), None
        self._panel_s = 0.0
        try:
            self._dose.begin(burst)
            for index, shot in enumerate(burst.shots):
                self._arm.attend()
                self._overseer.wait_while_paused()
                if _gives_light(burst, index):
                    self._dose.ask_again(burst, index)
                picture = self._fire_one(burst, index, records)
                taken_frames += 1
                if shot is not None and picture.record.invalid_exposure:
                    dead.append(shot)
                arm_after = None
                arm_after = self._arm.await_news()
                if picture.frame is not None:
                    if index in marks and picture.alone:
                        marks.remove(index)
                        reason = reason or too_bright(picture.frame, frame_format)
                    kept_frames += self._keep(picture, picture.frame, burst, index)
                if burst.marks == "none":
                    self._prove(kept_frames)
                self._overseer.tell(burst, index)
                self._recorder.commit(now=False)
            reason = reason or ("a dark mark was not seen" if marks else "")
            if not reason:
                self._prove(kept_frames)
        except BaseException as error:
            if isinstance(error, ArmMovedError) or self._arm.was_held(error):
                raise  # `_fire_one` has switched the light off
            self._cell.make_safe()
            raise
        finally:
            for kept_frame in kept_frames:
                self._recorder.free(kept_frame.slot)
            log = np.array([astuple(record) for record in records], STEP_RECORD_DTYPE)
            self._note(burst, log, arm_before, arm_after, panel_s=self._panel_s, frames=taken_frames)
        return Verdict(replace(NOTHING_TO_MATCH, reason=reason), dead)

    def _keep(self, exposure: _Taken, frame: Frame, burst: Burst, step: int) -> list[_Kept]:
        """Return the frame, stored but not proven yet. Returns nothing if the frame cannot be proven, or is a mark
        without a label."""
        if not exposure.alone or exposure.record.invalid_exposure:
            frame.release()
            return []
        slot = self._recorder.store(frame, burst.timing.exposure_us)
        frame.release()
        shot = burst.shots[step]
        if shot is None:
            self._recorder.see_mark(slot, burst, step)
            self._recorder.free(slot)
            return []
        return [_Kept(slot, shot, step_fields(exposure.record, exposure.t_trigger_ns))]

    def _prove(self, stored_frames: list[_Kept]) -> None:
        while stored_frames:
            kept_frame = stored_frames.pop(0)
            self._recorder.prove(kept_frame.slot, kept_frame.shot, kept_frame.fields)

    def _fire_one(self, burst: Burst, index: int, step_records: list[StepRecord]) -> _Taken:
        """Light one step, trigger the camera, wait for the light's end, and keep the burst's period. The record of
        the light is appended to `step_records` even if this raises."""
        box, camera, clock = self._cell.ledbox, self._cell.camera, self._cell.clock
        step, timing = burst.table[index], burst.timing
        record: StepRecord | None = None
        camera.arm(_ONE_SHOT_BUFFERS)
        started_ns = clock.now_ns()
        try:
            if burst.panel and index in burst.inner:
                box.panel(burst.panel, True)
            box.flash(int(step["led"]), int(step["on_us"]))
            clock.sleep(timing.trigger_delay_us * 1e-6)
            t_trigger_ns = clock.now_ns()
            camera.trigger()
            frame = camera.next_frame(timing.on_us * 1e-6 + camera.delivery_s)
            alone = box.lit() and self._alone()
            record = box.end_flash()
        finally:
            try:
                box.lights_off()
            finally:
                lasted_ns = clock.now_ns() - started_ns
                step_records.append(record or _cut_short(int(step["led"]), lasted_ns / 1e3))
                self._panel_s += lasted_ns / 1e9 if burst.panel else 0.0
                camera.disarm()
        clock.sleep(max(0.0, timing.period_us * 1e-6 - (clock.now_ns() - started_ns) / 1e9))
        if record.t_on_ns != UNKNOWN_NS:
            t_trigger_ns = record.t_on_ns + timing.trigger_delay_us * 1000
        return _Taken(frame, record, alone, t_trigger_ns)

    def _alone(self) -> bool:
        """True if the camera made exactly one exposure since it was armed."""
        exposed_frames = self._cell.camera.statistics().exposed
        if exposed_frames != _UNCOUNTED:
            return exposed_frames == 1
        other_frame = self._cell.camera.next_frame(0.0)
        if other_frame is not None:
            other_frame.release()
        return other_frame is None


def _gives_light(burst: Burst, index: int) -> bool:
    return bool(burst.table["led"][index] != NO_LED) or (burst.panel > 0 and index in burst.inner)


def _cut_short(led: int, on_us: float) -> StepRecord:
    """Return the record of a flash whose end the box did not report. The flash may have lasted for all of this
    time."""
    return StepRecord(
        step=0,
        led=led,
        edge_sent=False,
        led_open=False,
        over_temperature=False,
        waited=False,
        on_us=0.0 if led == NO_LED else on_us,
        t_on_ns=UNKNOWN_NS,
        t_trigger_ns=UNKNOWN_NS,
        board_temperature_c=math.nan,
        led_current_ma=math.nan,
    )


def too_bright(frame: Frame, frame_format: FrameFormat) -> str:
    """Return why a mark's frame is not dark. The text is empty if the frame is dark, or has no picture (in a dry
    run)."""
    if not frame.rendered:
        return ""
    black_dn, white_dn = frame_format.black_dn, frame_format.white_dn
    limit_dn = black_dn + DARK_SHARE * (white_dn - black_dn)
    bright_dn = float(np.quantile(frame.pixels, DARK_QUANTILE))
    if bright_dn < limit_dn:
        return ""
    return (
        f"a dark mark shows light ({bright_dn:.0f} DN, {limit_dn:.0f} at most): a lamp is on although it "
        "should be off"
    )
