"""Samples of frames for a chooser. They are taken while frames are stored; samples of an earlier session are read
back."""

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
"""Approximate number of pixels of a sample. It is enough for shares of a thousandth, and small enough to keep the
samples of a whole view."""


def frame_sample(pixels: NDArray[np.uint16], black_dn: int, white_dn: int) -> FrameSample:
    """Return the sample of a frame [H, W]. Clipping is counted in all pixels of the frame."""
    cell_step = max(1, math.isqrt(pixels.size // _SAMPLED_PX))
    signal_dn = np.clip(sample_of(pixels, cell_step) - black_dn, -32768, 32767).astype(np.int16)
    return FrameSample(np.count_nonzero(pixels >= white_dn) / pixels.size, signal_dn, white_dn - black_dn)


class FrameSamples:
    """Samples of one view's frames, by slot, and by shot once the shot is proven. Several threads may call
    `of_frame` and `keep`; all other methods are called by only one thread."""

    def __init__(self) -> None:
        self.is_wanted = False
        """True if frames are to be sampled."""
        self._format: FrameFormat | None = None
        self._of_slot: dict[int, FrameSample] = {}
        self._of_shot: dict[ShotId, FrameSample] = {}

    def begin(self, frame_format: FrameFormat) -> None:
        """Note the format of the next frames."""
        self._format = frame_format

    def of_frame(self, pixels: NDArray[np.uint16]) -> FrameSample | None:
        """Return the sample of a frame that arrives; None if no sample is wanted."""
        if not self.is_wanted or self._format is None:
            return None
        return frame_sample(pixels, self._format.black_dn, self._format.white_dn)

    def keep(self, slot: int, sample: FrameSample | None) -> None:
        """Keep the sample of the frame that was stored in a slot."""
        if sample is not None:
            self._of_slot[slot] = sample

    def prove(self, slot: int, shot: ShotId) -> None:
        """Note that the frame of a slot is proven."""
        sample = self._of_slot.pop(slot, None)
        if sample is not None:
            self._of_shot[shot] = sample

    def free(self, slot: int) -> None:
        """Note that the frame of a slot is not needed."""
        self._of_slot.pop(slot, None)

    def of_shot(self, shot: ShotId, read_sample: Callable[[ShotId], FrameSample]) -> FrameSample:
        """Return the sample of a proven frame. `read_sample` reads a sample of an earlier session. Raises the
        errors of `read_sample`."""
        if shot not in self._of_shot:
            self._of_shot[shot] = read_sample(shot)
        return self._of_shot[shot]

    def end(self) -> None:
        """End the view: its samples are not needed any more."""
        self._of_slot.clear()
        self._of_shot.clear()
