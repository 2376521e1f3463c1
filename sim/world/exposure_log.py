"""The true light of the newest exposures, for checking labels from outside. The program under test never sees it.

Frames of the simulated camera do not contain this light, rendered or not. A client requests it on the world's
control connection (`exposures`), by the number of the exposure, and finds it by the frame's id and timestamp.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from sim.world.lighting import Lighting


class LitExposure(NamedTuple):
    """One exposure and the LEDs that were lit during it."""

    number: int
    """Counts exposures from power-on."""
    frame_id: int
    timestamp_ns: int
    """Timestamp on the camera's clock, as the frame has it."""
    exposure_s: float
    lit: list[tuple[int, float]]
    """LED number, and seconds at its tabulated flux."""
    panels: list[int]


class ExposureLog:
    """Keeps the newest `size` exposures. With 0 it keeps none, and computes nothing."""

    def __init__(self, lighting: Lighting, size: int) -> None:
        self._lighting = lighting
        self._last: deque[LitExposure] = deque(maxlen=size)
        self.next_number = 0
        """Number of the next exposure."""

    def note(self, number: int, frame_id: int, timestamp_ns: int, start_ns: int, end_ns: int) -> None:
        """An exposure has ended; `start_ns` and `end_ns` are world times."""
        self.next_number = number + 1
        if self._last.maxlen:
            lit = list(self._lighting.exposure_s(start_ns, end_ns).items())
            panels = self._lighting.panels(start_ns)
            exposure_s = (end_ns - start_ns) / 1e9
            self._last.append(LitExposure(number, frame_id, timestamp_ns, exposure_s, lit, panels))

    def since(self, first: int, count: int) -> list[LitExposure]:
        """Return at most `count` exposures, from number `first` on."""
        return [exposure for exposure in self._last if exposure.number >= first][:count]
