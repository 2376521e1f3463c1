"""Sample of a run's proven frames, with exposure, histograms and small pictures of each view."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from coupole.errors import StorageError
from coupole.geometry import Transform
from coupole.plan.shot_id import Led
from coupole.storage.journal_events import FrameProven
from coupole.storage.run import Run
from coupole.storage.view_reader import View, read_view
from coupole.viewing.progress import OVER_EXPOSED, ViewExposure
from coupole.viewing.raw_preview import BINS, Coding, channels, look

PICTURES_PER_VIEW = 12
_PICTURES_PER_EXPOSURE = 4
"""Least number of pictures for each exposure time of a bracket."""
_PICTURE_WIDTH_PX = 320


@dataclass
class SampledExposure:
    """One exposure time of a view, from some of its frames, which are spread evenly over its lights."""

    exposure_us: int
    frames: int
    """Number of proven shots. The sample has `sample.pictures` of these shots."""
    sample: ViewExposure = field(default_factory=ViewExposure)
    worst: str = ""
    """The sampled shot with the largest share of saturated pixels; empty if no pixel is saturated."""
    histograms: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    """Numbers of pixels of all sampled frames by colour (R, G, B; Y for MONO), in `BINS` equal steps from 0 to
    full scale."""
    black_share: float = 0.0
    """The black level as a share of full scale."""

    def add(self, shot: str, raw: NDArray[np.uint16], coding: Coding) -> None:
        """Count a frame [H, W], DN."""
        before = self.sample.saturated_share
        self.sample.add(raw, black_dn=coding.black_dn, white_dn=coding.white_dn)
        self.worst = shot if self.sample.saturated_share > before else self.worst
        self.black_share = coding.black_dn / coding.white_dn
        for name, plane in channels(raw, coding.pattern).items():
            steps = (plane.ravel().astype(np.uint32) * BINS) // (coding.white_dn + 1)
            counts = np.bincount(np.minimum(steps, BINS - 1), minlength=BINS)
            self.histograms[name[0]] = self.histograms.get(name[0], 0) + counts


@dataclass
class SampledView:
    """A view's proven frames, and the results of a sample of them."""

    name: str
    expected_frames: int = 0
    """Frames that the plan asks for, with dark frames."""
    proven: int = 0
    darks: int = 0
    leds: int = 0
    """Different LEDs among the proven shots."""
    exposures: list[SampledExposure] = field(default_factory=list)
    """Shortest first."""
    pictures: list[tuple[str, bytes]] = field(default_factory=list)
    """Name of the shot, and a JPEG with saturated pixels in red."""
    base_from_camera: Transform | None = None
    """Measured pose; None if the view has no frame, or if its file has no pose."""
    trouble: str = ""
    """Reason why the view's file cannot be read; empty if it can."""

    def verdict(self) -> str:
        """`over-exposed` if even the shortest exposure saturates, `under-exposed` if even the longest is dark,
        otherwise `well exposed`; empty without pictures."""
        figures = [exposure.sample for exposure in self.exposures if exposure.sample.pictures]
        if not figures:
            return ""
        if figures[0].saturated_share > OVER_EXPOSED:
            return figures[0].verdict()
        return (
            "well exposed"
            if len(figures) > 1 and figures[-1].saturated_share > OVER_EXPOSED
            else figures[-1].verdict()
        )


def sampled_views(run: Run, proven: Iterable[FrameProven]) -> list[SampledView]:
    """All views of a run, in the plan's order. If a file cannot be read, `trouble` of its view says why."""
    frames: dict[str, list[FrameProven]] = {name: [] for name in run.views}
    shot_counts = dict.fromkeys(frames, 0)
    for event in proven:
        frames.setdefault(event.shot.view, []).append(event)
    for shot in run.expected_shots():
        shot_counts[shot.view] += 1
    return [_sampled_view(run, name, of_view, shot_counts.get(name, 0)) for name, of_view in frames.items()]


def _sampled_view(run: Run, name: str, proven: Sequence[FrameProven], expected_frames: int) -> SampledView:
    shots = sorted((event for event in proven if event.shot.is_shot), key=lambda event: str(event.shot))
    leds = {event.shot.light for event in shots if isinstance(event.shot.light, Led)}
    view = SampledView(name, expected_frames, len(proven), len(proven) - len(shots), len(leds))
    if shots:
        try:
            _look_into(view, read_view(run.view_path(name), shots), shots)
        except (StorageError, IndexError, ValueError) as error:
            view.trouble = str(error)
    return view


def _look_into(view: SampledView, file: View, shots: Sequence[FrameProven]) -> None:
    coding = Coding(file.pattern, file.black_dn, file.white_dn)
    if len(file.poses):
        pose = np.asarray(file.poses["base_from_camera"][file.records[shots[0].index]["pose"]], np.float64)
        view.base_from_camera = pose if pose.shape == (4, 4) and np.isfinite(pose).all() else None
    by_exposure: dict[int, list[FrameProven]] = {}
    for event in shots:
        by_exposure.setdefault(int(file.records[event.index]["exposure_us"]), []).append(event)
    count = max(_PICTURES_PER_EXPOSURE, PICTURES_PER_VIEW // len(by_exposure))
    for exposure_us, of_exposure in sorted(by_exposure.items()):
        sample = SampledExposure(exposure_us, len(of_exposure))
        view.exposures.append(sample)
        kept_frames = [event for event in of_exposure if not file.is_discarded(event.index)]
        places = np.unique(np.linspace(0, len(kept_frames) - 1, count).round().astype(int)) if kept_frames else ()
        for event in (kept_frames[place] for place in places):
            raw = file.pixels(event.index)
            sample.add(str(event.shot), raw, coding)
            picture = look(raw, coding, _PICTURE_WIDTH_PX, saturation=True, focus=False)
            view.pictures.append((str(event.shot), picture))
