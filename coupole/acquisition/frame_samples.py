"""Samples of frames for a chooser: taken while frames are stored, read back for frames of an earlier session."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from coupole.devices import FrameFormat
from coupole.plan.choices import FrameSample
from coupole.plan.shot_id import ShotId
from coupole.preflight.exposure_advice import sample_of

_SAMPLED_PX = 8192
"""Pixels of a sample, about: enough for shares of a thousandth, few enough to keep those of a whole view."""


def frame_sample(pixels: NDArray[np.uint16], black_dn: int, white_dn: int) -> FrameSample:
    """The sample of a frame [H, W]; clipping is counted in all its pixels."""
    cell_step = max(1, math.isqrt(pixels.size // _SAMPLED_PX))
    signal_dn = np.clip(sample_of(pixels, cell_step) - black_dn, -32768, 32767).astype(np.int16)
    return FrameSample(np.count_nonzero(pixels >= white_dn) / pixels.size, signal_dn, white_dn - black_dn)


class FrameSamples:
    """Samples of one view's frames: by slot, and by shot once it is proven. `of_frame` and `keep` may be called
    from several threads, all else from one."""

    def __init__(self) -> None:
        self.is_wanted = False
        """True if frames are to be sampled."""
        self._format: FrameFormat | None = None
        self._of_slot: dict[int, FrameSample] = {}
        self._of_shot: dict[ShotId, FrameSample] = {}

    def begin(self, frame_format: FrameFormat) -> None:
        """The next frames have this format."""
        self._format = frame_format

    def of_frame(self, pixels: NDArray[np.uint16]) -> FrameSample | None:
        """The sample of a frame that arrives; None if none is wanted."""
        if not self.is_wanted or self._format is None:
            return None
        return frame_sample(pixels, self._format.black_dn, self._format.white_dn)

    def keep(self, slot: int, sample: FrameSample | None) -> None:
        """A frame was stored in a slot."""
        if sample is not None:
            self._of_slot[slot] = sample

    def prove(self, slot: int, shot: ShotId) -> None:
        """The frame of a slot is proven."""
        sample = self._of_slot.pop(slot, None)
        if sample is not None:
            self._of_shot[shot] = sample

    def free(self, slot: int) -> None:
        """The frame of a slot is not needed."""
        self._of_slot.pop(slot, None)

    def of_shot(self, shot: ShotId, read_sample: Callable[[ShotId], FrameSample]) -> FrameSample:
        """The sample of a proven frame; `read_sample` gives one of an earlier session. Raises what it raises."""
        if shot not in self._of_shot:
            self._of_shot[shot] = read_sample(shot)
        return self._of_shot[shot]

    def end(self) -> None:
        """The view has ended: its samples are not needed any more."""
        self._of_slot.clear()
        self._of_shot.clear()
