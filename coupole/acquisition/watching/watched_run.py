"""A watched run: a recorder that looks at the frames that it passes on, and judges them burst by burst.

If shots may be taken again, frames are proven only after their burst has been judged, because a proven frame is
never overwritten. A spoilt frame stays unproven, and the sequencer takes its shot again as any other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.observer import Control, Observer
from coupole.acquisition.recorder import Recorder, ViewStart
from coupole.acquisition.watching.burst_judge import BurstJudge, FirstFrames, LightTable
from coupole.acquisition.watching.camera_noise import CameraNoise
from coupole.acquisition.watching.finding_picture import finding_picture
from coupole.acquisition.watching.findings import FOR_A_PERSON, NOT_WATCHED, TAKEN_AGAIN, Found, SeenFrame
from coupole.acquisition.watching.frame_look import FrameLook, LookGrid, compile_now
from coupole.devices import Frame
from coupole.errors import StorageError
from coupole.geometry import apply
from coupole.plan.bursts import Burst
from coupole.plan.choices import FrameSample
from coupole.plan.schedule import ViewPose
from coupole.plan.shot_id import Dark, Led, Sentinel, ShotId, ShotLabel
from coupole.plan.watch import NOTHING
from coupole.preflight.job import Job
from coupole.storage.journal_events import Event, FindingNoted

_MOST_PICTURES = 200
"""Greatest number of pictures of one session. In a long run the findings of many bursts look alike."""

_FIRST_UNKEPT = 1_000_000
"""Number from which marks that are not kept are counted. It is higher than the numbers of all kept marks."""


def judge_of(job: Job, grid: LookGrid, view: ViewPose, first: FirstFrames) -> BurstJudge:
    """Return the judge of a view's bursts, with the figures of the job's rig."""
    rig, leds = job.cell.rig, job.cell.leds
    target_mm = apply(rig.support.base_from_support.matrix(), view.target_mm or (0.0, 0.0, 0.0))
    offsets = leds.positions_mm - target_mm
    directions = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    light = leds.illuminance_lux(target_mm[None], emission=rig.dome.emission)[0]
    ids = leds.ids.tolist()
    table = LightTable(dict(zip(ids, directions, strict=True)), dict(zip(ids, light.tolist(), strict=True)))
    lens = rig.lens
    magnification = lens.focal_length_mm / (lens.focus_distance_mm - lens.focal_length_mm)
    mm_per_bin = grid.bin_px * rig.sensor.pixel_pitch_um * 1e-3 / magnification
    noise = CameraNoise.of(rig.watch, grid, job.plan.gain_db)
    return BurstJudge(rig.watch, noise, mm_per_bin, table, first)


def _unkept_mark(burst: Burst, step: int) -> ShotLabel:
    """Return a label for a mark that has none. It is used only to judge the burst; no file contains it."""
    return ShotLabel(Dark(_FIRST_UNKEPT + step), burst.exposure_index, burst.repeat)


def _is_unkept(label: ShotLabel) -> bool:
    return isinstance(label.light, Dark) and label.light.number >= _FIRST_UNKEPT


class WatchedRecorder:
    """A `coupole.acquisition.recorder.Recorder` in front of another one. It watches the frames that it passes
    on."""

    def __init__(self, recorder: Recorder, job: Job, observer: Observer, control: Control) -> None:
        self._recorder, self._job, self._observer, self._control = recorder, job, observer, control
        self._watch = job.plan.watching
        self._views = {view.name: view for view in job.schedule.views}
        self._first = FirstFrames()
        self._earlier = {shot for shot in recorder.proven() if isinstance(shot.light, Sentinel)}
        """Sentinels of earlier sessions."""
        self._grid: LookGrid | None = None
        self._judge: BurstJudge | None = None
        self._looks: dict[int, FrameLook] = {}
        """Looks of stored frames, by slot."""
        self._seen: dict[ShotLabel, FrameLook] = {}
        """Looks of the burst's proven frames."""
        self._timeline: list[ShotLabel] = []
        """Labels of the present burst, in the order of time. A shot that was taken again is at its last place."""
        self._held: dict[ShotId, tuple[int, Mapping[str, int]]] = {}
        """Frames that will be proven as soon as their burst is judged: slot and fields."""
        self._known_leds: set[int] = set()
        """LEDs that a finding has named already."""
        self._pictures = 0
        self.name = recorder.name
        if self._watch.frames != "none":
            compile_now()

    # -- what a recorder does -----------------------------------------------------------------------------

    def light_before_lux_h(self) -> tuple[float, ...]:
        return self._recorder.light_before_lux_h()

    def proven(self) -> set[ShotId]:
        return self._recorder.proven()

    def has_room(self, view: str) -> bool:
        return self._recorder.has_room(view)

    def begin_view(self, start: ViewStart) -> None:
        self._recorder.begin_view(start)
        self._first.begin_view()
        self._seen.clear()
        self._timeline = []
        self._grid = LookGrid(start.frame_format, is_sparse=self._watch.frames == "darks")
        self._judge = None
        if self._watch.frames == "all":
            self._compare_with_earlier(start.view)

    def _compare_with_earlier(self, view: str) -> None:
        """Compare this session's sentinels with the first sentinels of an earlier session."""
        sentinels = sorted(
            (shot for shot in self._earlier if shot.view == view),
            key=lambda shot: (shot.label.repeat, cast("Sentinel", shot.light).number),
        )
        firsts: dict[tuple[int, int], ShotId] = {}
        for shot in sentinels:
            firsts.setdefault((shot.label.exposure, cast("Sentinel", shot.light).led), shot)
        grid = cast("LookGrid", self._grid)
        try:
            looks = {place: grid.look(self._recorder.earlier_pixels(shot)) for place, shot in firsts.items()}
        except StorageError as error:
            self._tell_not_watched(view, tuple(firsts.values()), f"not compared with the session before: {error}")
            return
        for (exposure_index, led), look in looks.items():
            self._first.note_earlier(self._job.plan.exposure.exposures_us[exposure_index], led, look)

    def store(self, frame: Frame, exposure_us: int) -> int:
        slot = self._recorder.store(frame, exposure_us)
        if self._grid is not None and frame.rendered and self._watch.frames != "none":
            self._looks[slot] = self._grid.look(frame.pixels)
        return slot

    def sample_frames(self, *, is_wanted: bool) -> None:
        self._recorder.sample_frames(is_wanted=is_wanted)

    def sample(self, shot: ShotId) -> FrameSample:
        return self._recorder.sample(shot)

    def earlier_pixels(self, shot: ShotId) -> NDArray[np.uint16]:
        return self._recorder.earlier_pixels(shot)

    def prove(self, slot: int, shot: ShotId, fields: Mapping[str, int]) -> None:
        look = self._looks.pop(slot, None)
        if look is not None and (self._watch.frames == "all" or shot.is_dark):
            self._seen[shot.label] = look
        if self._watch.retake:
            self._held[shot] = slot, fields
        else:
            self._recorder.prove(slot, shot, fields)

    def see_mark(self, slot: int, burst: Burst, step: int) -> None:
        """Keep the look at a dark mark, which shows the light of the room. In a burst with a panel the marks are
        not dark."""
        if slot in self._looks and not burst.panel:
            self._seen[_unkept_mark(burst, step)] = self._looks[slot]

    def free(self, slot: int) -> None:
        self._looks.pop(slot, None)
        self._recorder.free(slot)

    def note(self, event: Event) -> None:
        self._recorder.note(event)

    def commit(self, *, now: bool) -> None:
        self._recorder.commit(now=now)

    def end_view(self) -> None:
        self._prove_held(set())
        self._looks.clear()
        self._recorder.end_view()

    def keep_picture(self, name: str, content: bytes) -> str:
        return self._recorder.keep_picture(name, content)

    # -- watching -----------------------------------------------------------------------------------------

    def judge(self, burst: Burst, *, may_retake: bool) -> str:
        """Judge a burst that was fired, and prove its frames. Findings are written to the journal and reported.
        Returns why shots are left unproven, to be taken again; the text is empty if there are none."""
        try:
            findings = self._findings_in(burst)
        except Exception as error:  # noqa: BLE001  a defect of what only looks must not end a run
            findings = []
            self._go_on_unwatched(burst, error)
        for finding in findings:
            self._note(burst, finding)
        spoilt: set[ShotLabel] = set()
        if may_retake and self._watch.retake:
            spoilt = {label for finding in findings if finding.kind in TAKEN_AGAIN for label in finding.labels}
        spoilt &= {shot.label for shot in self._held}
        self._prove_held(spoilt)
        if self._watch.pause and any(finding.kind in FOR_A_PERSON for finding in findings):
            self._observer.note("paused because of this finding: remove the cause, then go on")
            self._control.pause.set()
        return "; ".join(finding.words for finding in findings if finding.kind in TAKEN_AGAIN) if spoilt else ""

    def _findings_in(self, burst: Burst) -> list[Found]:
        """Judge a burst; return the findings that are new."""
        frames = self._frames_of(burst)
        if not frames or self._grid is None:
            return []
        self._judge = self._judge or judge_of(self._job, self._grid, self._views[burst.view], self._first)
        findings = self._judge.judge(frames, burst.timing.exposure_us)
        findings = [self._with_shots(burst, finding) for finding in findings]
        new_labels = {label for label in burst.labels if label}
        return [finding for finding in findings if self._is_news(finding) and new_labels & set(finding.labels)]

    def _go_on_unwatched(self, burst: Burst, error: Exception) -> None:
        """Stop watching, and say so where findings are shown."""
        self._watch = NOTHING
        shots = tuple(ShotId(burst.view, label) for label in burst.labels if label)
        defect = f"{type(error).__name__}: {error}. This is a defect of Coupole: please report it"
        self._tell_not_watched(burst.view, shots, f"watching has ended, the run goes on: {defect}")

    def _tell_not_watched(self, view: str, shots: tuple[ShotId, ...], words: str) -> None:
        self._tell(
            FindingNoted(kind=NOT_WATCHED, view=view, shots=shots, figure=0.0, limit=0.0, unit="", message=words)
        )

    def _frames_of(self, burst: Burst) -> list[SeenFrame]:
        """Return frames of the burst, and of earlier attempts, in the order of time."""
        labels = [label or _unkept_mark(burst, step) for step, label in enumerate(burst.labels)]
        if not {label for label in burst.labels if label} <= set(self._timeline):
            self._timeline = []
            self._seen = {label: look for label, look in self._seen.items() if label in set(labels)}
        again = set(labels)
        self._timeline = [label for label in self._timeline if label not in again] + labels
        return [SeenFrame(label, self._seen[label]) for label in self._timeline if label in self._seen]

    def _with_shots(self, burst: Burst, finding: Found) -> Found:
        """Return the same finding without marks that are not kept. If only dark frames were judged, add the shots
        of the burst."""
        kept = (label for label in finding.labels if not _is_unkept(label))
        finding = replace(finding, labels=tuple(kept))
        if self._watch.frames == "all":
            return finding
        shots = (label for label in burst.labels if label and label.is_shot)
        return replace(finding, labels=tuple(dict.fromkeys([*finding.labels, *shots])))

    def _is_news(self, finding: Found) -> bool:
        """True unless the finding is an LED that is already known to be wrong: it is not named again in each
        view."""
        if finding.kind != "LED":
            return True
        leds = {label.light.id for label in finding.labels if isinstance(label.light, Led)}
        is_news = not leds <= self._known_leds
        self._known_leds |= leds
        return is_news

    def _note(self, burst: Burst, finding: Found) -> None:
        self._tell(
            FindingNoted(
                kind=finding.kind,
                view=burst.view,
                shots=tuple(ShotId(burst.view, label) for label in finding.labels),
                figure=round(finding.figure, 6),
                limit=round(finding.limit, 6),
                unit=finding.unit,
                message=finding.words,
                picture=self._kept_picture(burst, finding),
            )
        )

    def _kept_picture(self, burst: Burst, finding: Found) -> str:
        """The path of a finding's picture in the run. It is empty if there are many pictures already, or if the
        picture cannot be written, because no frame depends on it."""
        if self._pictures >= _MOST_PICTURES:
            return ""
        self._pictures += 1
        name = f"{burst.view}-e{burst.exposure_index}-r{burst.repeat}-{finding.kind.replace(' ', '-')}.png"
        try:
            return self.keep_picture(name, finding_picture(finding))
        except StorageError as error:
            self._observer.note(f"{burst.view}: the picture of the finding was not kept: {error}")
            return ""

    def _tell(self, finding: FindingNoted) -> None:
        """Show a finding, and note it for the journal."""
        picture = f" ({finding.picture})" if finding.picture else ""
        self._observer.note(f"{finding.view}: {finding.kind}: {finding.message}{picture}")
        self._recorder.note(finding)

    def _prove_held(self, spoilt: set[ShotLabel]) -> None:
        """Prove the frames that waited, and free the spoilt ones."""
        held_frames, self._held = self._held, {}
        for shot, (slot, fields) in held_frames.items():
            if shot.label in spoilt:
                self._seen.pop(shot.label, None)
                self._recorder.free(slot)
            else:
                self._recorder.prove(slot, shot, fields)
