"""The `exposure:` of a plan."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from coupole.plan.base_model import ExposureUs, Model


class FixedExposure(Model):
    kind: Literal["fixed"]
    """One exposure for each light."""
    exposure_us: ExposureUs
    """Exposure time."""

    @property
    def exposures_us(self) -> tuple[int, ...]:
        return (self.exposure_us,)

    @property
    def frames_of_light(self) -> int:
        """Greatest number of frames of each light."""
        return 1


class BracketExposure(Model):
    """Several exposures for each light, the shortest first as written."""

    kind: Literal["bracket"]
    """Several exposures for each light."""
    exposures_us: Annotated[tuple[ExposureUs, ...], Field(min_length=2, max_length=16)]
    """Exposure times, each longer than the one before."""

    @field_validator("exposures_us")
    @classmethod
    def _increasing(cls, exposures_us: tuple[int, ...]) -> tuple[int, ...]:
        if any(b <= a for a, b in pairwise(exposures_us)):
            raise ValueError("increasing exposures, each longer than the one before")
        return exposures_us

    @property
    def frames_of_light(self) -> int:
        """Greatest number of frames of each light."""
        return len(self.exposures_us)


STEPS_PER_STOP = 4
"""Number of exposure times of `auto` within a factor of two."""


class AutoExposure(Model):
    """Exposures that are chosen in the run, for each view and LED, from frames of the view that are already
    proven.

    The possible times are known before the run, so that `e5` is the same time in all views and sessions.
    """

    kind: Literal["auto"]
    """Exposures that are chosen in the run, for each LED."""
    shortest_us: ExposureUs = 500
    """Shortest exposure that may be chosen."""
    longest_us: ExposureUs
    """Longest exposure that may be chosen: it bounds time, heat and light."""
    clipped_share: Annotated[float, Field(ge=1e-6, le=0.5)] = 1e-3
    """Share of a picture's pixels that may be clipped in the shortest exposure of an LED."""
    snr: Annotated[float, Field(ge=1, le=1000)] = 30.0
    """Signal over noise that pixels must reach in an LED's exposures together."""
    object_share: Annotated[float, Field(ge=0.01, le=0.999)] = 0.9
    """Share of the object's pixels under each LED's direct light that must reach `snr`."""
    most_exposures: Annotated[int, Field(ge=2, le=4)] = 3
    """Greatest number of exposures of one LED in one view."""
    first_lights: Annotated[int, Field(ge=4, le=200)] = 24
    """LEDs of the first pass, spread over the dome. Number of LEDs: at most an eighth of the view's LEDs, but at
    least six.
    """

    @model_validator(mode="after")
    def _a_range(self) -> AutoExposure:
        if self.longest_us < 2 * self.shortest_us:
            raise ValueError(
                f"a `longest_us` of at least twice `shortest_us` ({self.shortest_us}); found {self.longest_us}"
            )
        return self

    @property
    def exposures_us(self) -> tuple[int, ...]:
        """Possible times, four to the stop. Shot ids contain their places in this list."""
        stops = math.log2(self.longest_us / self.shortest_us)
        count = math.ceil(STEPS_PER_STOP * stops - 1e-9)
        times_us = {round(self.shortest_us * 2.0 ** (step / STEPS_PER_STOP)) for step in range(count)}
        return (*sorted(times_us - {self.longest_us}), self.longest_us)

    @property
    def frames_of_light(self) -> int:
        """Greatest number of frames of each light."""
        return self.most_exposures


Exposures = Annotated[FixedExposure | BracketExposure | AutoExposure, Field(discriminator="kind")]
