"""The `lights:` of a plan."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from coupole.plan.base_model import Degrees, LedId, Model


class AllLights(Model):
    kind: Literal["all"]
    """Each LED of the dome, one after the other."""


class LightIds(Model):
    kind: Literal["ids"]
    """LEDs by their ids in the LED table."""
    ids: Annotated[tuple[LedId, ...], Field(min_length=1)]
    """Ids of the LEDs, each once. They are lit in this order."""

    @field_validator("ids")
    @classmethod
    def _no_twice(cls, ids: tuple[int, ...]) -> tuple[int, ...]:
        if twice := sorted({i for i in ids if ids.count(i) > 1}):
            raise ValueError(f"each LED once; these are given more than once: {twice}")
        return ids


class LightBoards(Model):
    """All LEDs of some boards."""

    kind: Literal["boards"]
    """All LEDs of some boards."""
    boards: Annotated[tuple[Annotated[int, Field(ge=0, le=65535)], ...], Field(min_length=1)]
    """Numbers of boards in the LED table."""


class EveryLight(Model):
    """Every n-th LED of the table, from `offset` on."""

    kind: Literal["every"]
    """Every n-th LED of the table."""
    every: Annotated[int, Field(ge=1, le=65535)]
    """The n of "every n-th LED"; 1 means each LED."""
    offset: Annotated[int, Field(ge=0, le=65535)] = 0
    """Number of rows of the table before the first LED."""


class LightCone(Model):
    """LEDs within `half_angle_deg` of a direction seen from the support's centre."""

    kind: Literal["cone"]
    """LEDs within an angle of a direction."""
    azimuth_deg: Degrees
    """Azimuth of the direction, from the support frame's x towards y."""
    elevation_deg: Annotated[float, Field(ge=-90, le=90)]
    """Elevation of the direction above the support's plane."""
    half_angle_deg: Annotated[float, Field(gt=0, le=180)]
    """Angle between the direction and the outermost LED."""


class Panels(Model):
    """The flat white panels, one after the other."""

    kind: Literal["panels"]
    """The flat white panels, one after the other."""
    panels: Annotated[tuple[Annotated[int, Field(ge=1, le=4)], ...], Field(min_length=1)] = (1, 2, 3, 4)
    """Numbers of panels."""


class NoLights(Model):
    """Dark frames only."""

    kind: Literal["none"]
    """Dark frames only."""


MOST_ADAPTIVE_BURSTS = 128
"""Greatest number of bursts of one view, if its LEDs are chosen."""
LedSelection = Annotated[AllLights | LightIds | LightBoards | EveryLight | LightCone, Field(discriminator="kind")]


class EnoughLights(Model):
    """Limits that end the choice of LEDs of a view. The first one that is reached ends it."""

    lights: Annotated[int, Field(ge=6, le=65535)]
    """Greatest number of LEDs of one view. It bounds time, heat, bytes and light."""
    relit_rms: Annotated[float, Field(gt=0, le=1)] | None = None
    """Expected rms error of pictures that are interpolated for the unlit LEDs, as a share of the view's bright
    level."""
    seconds: Annotated[float, Field(gt=0)] | None = None
    """Greatest time of the view's bursts."""
    lux_h: Annotated[float, Field(gt=0)] | None = None
    """Greatest light at the view's target, by the LED table."""


class AdaptiveLights(Model):
    """LEDs that are chosen in the run, from the frames under earlier LEDs of the view."""

    kind: Literal["adaptive"]
    """LEDs that are chosen in the run, from the frames under earlier LEDs of the view."""
    until: EnoughLights
    """Limits at which the choice ends."""
    among: LedSelection = AllLights(kind="all")
    """LEDs that may be chosen."""
    first_lights: Annotated[int, Field(ge=6, le=200)] = 24
    """LEDs of the first burst, spread over the dome."""
    burst_lights: Annotated[int, Field(ge=1, le=256)] = 32
    """Number of LEDs of each later burst."""

    @property
    def burst_sizes(self) -> tuple[int, ...]:
        """Number of LEDs of each burst of a view, if all LEDs are lit that may be lit."""
        first = min(self.first_lights, self.until.lights)
        full, rest = divmod(self.until.lights - first, self.burst_lights)
        return (first, *(self.burst_lights,) * full, *((rest,) if rest else ()))

    @model_validator(mode="after")
    def _few_bursts(self) -> AdaptiveLights:
        if (bursts := len(self.burst_sizes)) > MOST_ADAPTIVE_BURSTS:
            raise ValueError(
                f"at most {MOST_ADAPTIVE_BURSTS} bursts of a view, found {bursts}: raise `burst_lights`"
            )
        return self


Lights = Annotated[
    AllLights | LightIds | LightBoards | EveryLight | LightCone | AdaptiveLights | Panels | NoLights,
    Field(discriminator="kind"),
]
