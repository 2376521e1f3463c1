"""A sensor whose noise is not normal, and whose gain drifts."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

_TAILS, _DRIFT = 21, 22
"""Numbers of the seed's random streams."""
_DEGREES = 2.5
"""Degrees of freedom of Student's distribution, which then has a finite variance but no fourth moment."""


class SensorStranger(BaseModel):
    """Deviations from the sensor's model."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tails_dn: Annotated[float, Field(ge=0)] = 0.0
    """Scale of noise with long tails (Student's, 2.5 degrees of freedom), added to every pixel of every frame."""
    gain_drift: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Relative amplitude of a slow wave of the gain."""
    gain_period_frames: Annotated[float, Field(gt=0)] = 500.0
    seed: int = 1

    def gain(self, frame: int) -> float:
        """Factor of the gain at a frame."""
        phase = np.random.default_rng((self.seed, _DRIFT)).uniform(0.0, 2.0 * np.pi)
        return 1.0 + self.gain_drift * float(np.sin(2.0 * np.pi * frame / self.gain_period_frames + phase))

    def add_tails(self, frame_dn: NDArray[np.uint16], frame: int, white_dn: int) -> None:
        """Add the noise to a frame, DN, in place."""
        if self.tails_dn:
            noise = np.random.default_rng((self.seed, _TAILS, frame)).standard_t(_DEGREES, frame_dn.shape)
            frame_dn[:] = np.clip(np.rint(frame_dn + self.tails_dn * noise), 0, white_dn).astype(np.uint16)
