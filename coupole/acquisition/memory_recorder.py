"""Recorders that write nothing: for a dry run, which judges the exposure of pictures, and for metering, which
takes samples of pictures.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.frame_samples import FrameSamples
from coupole.acquisition.recorder import ViewStart
from coupole.devices import Frame, FrameFormat
from coupole.plan.bursts import Burst
from coupole.plan.choices import FrameSample
from coupole.plan.shot_id import ShotId
from coupole.preflight.exposure_advice import Metered, sample_of
from coupole.storage.journal_events import Event
from coupole.viewing.progress import ViewExposure

_NOTHING_EARLIER = "{}: no frames of an earlier session are kept"


class MemoryRecorder:
    """Part of a `coupole.acquisition.recorder.Recorder`: keeps events and proven shots in memory. Each kind of
    recorder stores frames in its own way."""

    name = "memory"

    def __init__(self) -> None:
        self.events: list[Event] = []
        self._proven: set[ShotId] = set()
        self._view = ""
        self._format: FrameFormat | None = None
        self._samples = FrameSamples()

    def light_before_lux_h(self) -> tuple[float, ...]:
        return ()

    def proven(self) -> set[ShotId]:
        return self._proven

    def has_room(self, view: str) -> bool:
        """Always true: nothing is stored."""
        return True

    def begin_view(self, start: ViewStart) -> None:
        self._view, self._format = start.view, start.frame_format
        self._samples.begin(start.frame_format)

    def sample_frames(self, *, is_wanted: bool) -> None:
        self._samples.is_wanted = is_wanted

    def sample(self, shot: ShotId) -> FrameSample:
        return self._samples.of_shot(shot, _refuse_to_read)

    def earlier_pixels(self, shot: ShotId) -> NDArray[np.uint16]:
        raise KeyError(_NOTHING_EARLIER.format(shot))

    def prove(self, slot: int, shot: ShotId, fields: Mapping[str, int]) -> None:
        self._samples.prove(slot, shot)
        self._proven.add(shot)

    def see_mark(self, slot: int, burst: Burst, step: int) -> None:
        """Keep nothing of the mark."""

    def free(self, slot: int) -> None:
        self._samples.free(slot)

    def note(self, event: Event) -> None:
        self.events.append(event)

    def keep_picture(self, name: str, content: bytes) -> str:
        return ""

    def commit(self, *, now: bool) -> None:
        """Do nothing: no data are kept for later."""


class DryRecorder(MemoryRecorder):
    """Recorder for a dry run. It judges the exposure of frames that have a picture."""

    name = "dry run"

    def __init__(self) -> None:
        super().__init__()
        self.exposures: dict[str, ViewExposure] = {}
        self._slots: list[tuple[float, float] | None] = []

    def store(self, frame: Frame, exposure_us: int) -> int:
        assert self._format is not None
        if not frame.rendered:
            self._slots.append(None)
        else:
            black, white = self._format.black_dn, self._format.white_dn
            bright = (float(np.quantile(frame.pixels, 0.999)) - black) / (white - black)
            self._slots.append((bright, float(np.mean(frame.pixels >= white))))
        slot = len(self._slots) - 1
        self._samples.keep(slot, self._samples.of_frame(frame.pixels))
        return slot

    def prove(self, slot: int, shot: ShotId, fields: Mapping[str, int]) -> None:
        super().prove(slot, shot, fields)
        slot_figures = self._slots[slot]
        if slot_figures is not None and shot.is_shot:
            self.exposures.setdefault(self._view, ViewExposure()).add_figures(*slot_figures)

    def end_view(self) -> None:
        self._slots.clear()
        self._samples.end()


def _refuse_to_read(shot: ShotId) -> FrameSample:
    raise KeyError(_NOTHING_EARLIER.format(shot))


class MeterRecorder(MemoryRecorder):
    """Recorder for metering: keeps a sample of each frame's pixels."""

    name = "meter"

    def __init__(self) -> None:
        super().__init__()
        self.views: dict[str, Metered] = {}
        self._slots: list[tuple[int, NDArray[np.int32]]] = []

    def store(self, frame: Frame, exposure_us: int) -> int:
        assert self._format is not None
        self._slots.append((exposure_us, sample_of(frame.pixels) - self._format.black_dn))
        return len(self._slots) - 1

    def prove(self, slot: int, shot: ShotId, fields: Mapping[str, int]) -> None:
        super().prove(slot, shot, fields)
        if shot.is_shot:
            assert self._format is not None
            exposure_us, sample = self._slots[slot]
            view = self.views.setdefault(self._view, Metered(self._format))
            view.samples.setdefault(shot.light, {}).setdefault(exposure_us, []).append(sample)

    def end_view(self) -> None:
        self._slots.clear()
