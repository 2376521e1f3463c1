"""Watching the measurement: the settings of a plan, and the figures of a rig from which limits follow."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from coupole.plan.base_model import Model

SENTINELS = 3
"""Number of LEDs of a view's sentinels. With three LEDs, a change of one LED alone can be distinguished from a
change of all."""
Electrons = Annotated[float, Field(gt=0, le=1e6)]
Share = Annotated[float, Field(gt=0, lt=1)]


class Watch(Model):
    """Watching of a run while it is acquired."""

    frames: Literal["all", "darks", "none"] = "all"
    """Frames that are watched. `all`: each frame is watched, and some LEDs are lit again as sentinels. `darks`:
    only dark frames are watched. `none`: no frame is watched."""
    every: Annotated[int, Field(ge=3, le=10_000)] = 16
    """Number of lights from one sentinel to the next. A thing that is in the field for a shorter time may not be
    seen."""
    retake: bool = False
    """True if shots that a hand, an LED or a lamp has spoilt are taken again, at most `reshoot_limit` times."""
    pause: bool = False
    """True if the session pauses after a burst with a finding that only a person can correct."""


DARKS_ONLY, EVERYTHING, NOTHING = Watch(frames="darks"), Watch(), Watch(frames="none")


class WatchLimits(Model):
    """Figures of camera and LEDs from which the limits of watching follow."""

    full_well_e: Electrons = 13_500.0
    """Electrons that fill the range of pixels at gain 0 dB; the default is the CMV12000's, by its data sheet."""
    read_noise_e: Electrons = 13.0
    """Standard deviation of a pixel's readout."""
    row_noise_e: Electrons = 2.0
    """Standard deviation of the offset that all pixels of a row have in common."""
    dark_e_per_s: Annotated[float, Field(ge=0, le=1e9)] = 100.0
    """Dark current of a pixel. Dark frames may rise by this much, as happens in a sensor that warms up by 6 K."""
    led_flicker: Share = 0.001
    """Standard deviation of an LED's flux from flash to flash, as a share of the flux."""
    sigmas: Annotated[float, Field(ge=3, le=100)] = 6.0
    """Limit of all findings, in standard deviations of the noise alone."""
    least_share: Share = 0.01
    """Change of light or gain below which nothing is reported. The default is the best uncertainty of a measured
    radiance."""
    least_mm: Annotated[float, Field(gt=0, le=100)] = 0.05
    """Displacement below which nothing is reported. The default is a pixel of the full camera, seen from the focus
    distance."""
