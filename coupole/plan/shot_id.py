"""Shot ids: view, light or dark, exposure. Only this module writes and reads shot ids.

::

    top/led0417/e0          LED 417, first exposure
    top/led0417/e1/r2       the same light, second exposure, third time (the first repeat is not written)
    top/panel2/e0           flat panel 2
    top/dark3/e0            a dark frame or dark mark
    top/led0417-watch3/e0   LED 417 as a sentinel, for the fourth time: it shows changes, and is not a shot
    top/panel2-mark4/e0     a mark of a panel's burst: the panel shines there too, so it is not dark
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TypeAlias

MAX_CHARACTERS = 80
"""Greatest length of a shot id, which is the width of its field in the frame table."""
_LABEL = re.compile(
    r"(?:led(?P<led>\d{4,5})(?:-watch(?P<watch>\d+))?|panel(?P<panel>\d)(?:-mark(?P<mark>\d+))?|dark(?P<dark>\d+))"
    r"/e(?P<exposure>\d+)(?:/r(?P<repeat>[1-9]\d*))?"
)


@dataclass(frozen=True, slots=True)
class Led:
    """One LED is lit, by its id in the dome's table."""

    id: int

    def __str__(self) -> str:
        return f"led{self.id:04d}"


@dataclass(frozen=True, slots=True)
class Sentinel:
    """One LED is lit to show changes since it was lit before. The frame is not a shot of the plan."""

    led: int
    number: int

    def __str__(self) -> str:
        return f"{Led(self.led)}-watch{self.number}"


@dataclass(frozen=True, slots=True)
class Panel:
    """One flat panel is lit."""

    number: int

    def __str__(self) -> str:
        return f"panel{self.number}"


@dataclass(frozen=True, slots=True)
class PanelMark:
    """A coded step at the ends of a panel's burst. The panel is lit, but the frame is not a shot of the plan."""

    panel: int
    number: int

    def __str__(self) -> str:
        return f"panel{self.panel}-mark{self.number}"


@dataclass(frozen=True, slots=True)
class Dark:
    """No light: a dark frame, or a coded dark step at the ends of a burst."""

    number: int

    def __str__(self) -> str:
        return f"dark{self.number}"


Light: TypeAlias = Led | Sentinel | Panel | PanelMark | Dark


@dataclass(frozen=True, slots=True)
class ShotLabel:
    """A shot's id without its view. Bursts of all views have these labels in common."""

    light: Light
    exposure: int
    """Index into the plan's exposures."""
    repeat: int = 0

    def __str__(self) -> str:
        return f"{self.light}/e{self.exposure}" + (f"/r{self.repeat}" if self.repeat else "")

    @property
    def is_shot(self) -> bool:
        """True for a frame under a light of the plan; False for dark frames, marks and sentinels."""
        return isinstance(self.light, Led | Panel)

    @property
    def is_dark(self) -> bool:
        return isinstance(self.light, Dark)

    @staticmethod
    def parse(text: str) -> ShotLabel:
        """Return the label for a text that `str` wrote. Raises ValueError for any other text."""
        match = _LABEL.fullmatch(text)
        if match is None:
            raise ValueError(f"expected a shot such as led0417/e0, found {text[:MAX_CHARACTERS]!r}")
        label = ShotLabel(_light(match), int(match["exposure"]), int(match["repeat"] or 0))
        if str(label) != text:
            raise ValueError(f"expected {label}, found {text[:MAX_CHARACTERS]!r}")
        return label


@dataclass(frozen=True, slots=True)
class ShotId:
    """One frame of a plan."""

    view: str
    label: ShotLabel

    def __str__(self) -> str:
        return f"{self.view}/{self.label}"

    @property
    def light(self) -> Light:
        return self.label.light

    @property
    def is_shot(self) -> bool:
        """True for a frame under a light of the plan; False for dark frames, marks and sentinels."""
        return self.label.is_shot

    @property
    def is_dark(self) -> bool:
        return self.label.is_dark

    @staticmethod
    def parse(text: str) -> ShotId:
        """Return the id for a text that `str` wrote. Raises ValueError for any other text."""
        view, _, label = text.partition("/")
        if not view or len(text) > MAX_CHARACTERS:
            raise ValueError(f"expected a shot id of {MAX_CHARACTERS} characters at most, found {text[:200]!r}")
        return ShotId(view, ShotLabel.parse(label))


def _light(match: re.Match[str]) -> Light:
    if match["watch"] is not None:
        return Sentinel(int(match["led"]), int(match["watch"]))
    if match["led"] is not None:
        return Led(int(match["led"]))
    if match["dark"] is not None:
        return Dark(int(match["dark"]))
    if match["mark"] is not None:
        return PanelMark(int(match["panel"]), int(match["mark"]))
    return Panel(int(match["panel"]))
