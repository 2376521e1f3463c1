"""The corrections in an answer: from the controller's present place to the commanded axes.

Absolute corrections count from the start of the session. The controller sums relative corrections. So the
reference of a relative correction is the sum of the corrections that the controller has applied, as rounded on
the wire. An increment that arrived too late is included in the next one, and rounding errors do not accumulate.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from coupole.wrist_lengths import WristLengths
from drivers.kuka.rsi.pose import corrected_pose, correction, flange_pose

Six = tuple[float, ...]

DECIMALS = 6
"""Decimals of a correction on the wire."""
NAMES = {"axes": ("A1", "A2", "A3", "A4", "A5", "A6"), "pose": ("X", "Y", "Z", "A", "B", "C")}
"""Attributes of a correction, for axes and for the pose."""
TAGS = {"axes": "AKorr", "pose": "RKorr"}
"""The element that contains the correction, unless the rig names another (`correction_tag`)."""
_NOTHING: Six = (0.0,) * 6


class Corrections:
    """Computes corrections. A `place` is the arm's position: its axes, or the flange's pose."""

    def __init__(self, corrects: str, mode: str, geometry: WristLengths) -> None:
        self._relative = mode == "relative"
        self.place: Callable[[Six], Any] = tuple
        """The place at given axes."""
        self.between: Callable[[Any, Any], Six] = _axes_between
        """The correction from one place to another."""
        self._moved: Callable[[Any, Six], Any] = _axes_moved
        if corrects == "pose":
            self.place, self.between, self._moved = partial(flange_pose, geometry), correction, corrected_pose
        self._from: Any = None
        """The place from which the next correction counts."""
        self._last = self._applied = _NOTHING
        """The last correction that was sent, and the last that the controller is known to have applied."""
        self.led_to: Any = None
        """The place to which the last correction leads."""

    def begin(self, start_deg: Six) -> None:
        """Begin a session with the axes at `start_deg`."""
        self._from = self.led_to = self.place(start_deg)
        self._last = self._applied = _NOTHING

    def note_applied(self) -> None:
        """Note that the controller has applied the last correction."""
        self._applied = self._last
        if self._relative:
            self._from = self._moved(self._from, self._last)
            self._last = _NOTHING

    def to(self, commanded_deg: Six) -> Six:
        """Return the correction that leads to `commanded_deg`."""
        values = self.between(self._from, self.place(commanded_deg))
        self._last = tuple(round(value, DECIMALS) for value in values)
        return self._last

    def hold(self) -> Six:
        """Return the correction that causes no further motion."""
        self._last = _NOTHING if self._relative else self._applied
        return self._last

    def step(self, values: Six) -> Six:
        """Return the step from the place of the last answer to the place of an answer with these corrections."""
        before, self.led_to = self.led_to, self._moved(self._from, values)
        return values if self._relative else self.between(before, self.led_to)


def _axes_between(before_deg: Six, after_deg: Six) -> Six:
    return tuple(map(float.__sub__, after_deg, before_deg))


def _axes_moved(before_deg: Six, values_deg: Six) -> Six:
    return tuple(map(float.__add__, before_deg, values_deg))
