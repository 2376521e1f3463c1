"""Settings that all GenICam drivers share."""

from __future__ import annotations

from typing import Annotated, Protocol

from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictFloat, StrictInt, StrictStr

Value = StrictBool | StrictInt | StrictFloat | StrictStr
"""Value of a feature. For an enumeration it is the name of its entry."""


class Region(BaseModel):
    """Part of the sensor, in pixels."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    left_px: Annotated[int, Field(ge=0)] = 0
    top_px: Annotated[int, Field(ge=0)] = 0


class Counter(BaseModel):
    """A counter of the camera: features to set first (selectors), and the feature that holds the count."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    select: dict[str, Value] = Field(default_factory=dict)
    read: str = "CounterValue"


class GenICamSettings(Protocol):
    """Settings that `genicam_image` and `genicam_trigger` use. Each driver's own class documents them."""

    @property
    def region(self) -> Region | None: ...

    @property
    def features(self) -> dict[str, Value]: ...

    @property
    def leave(self) -> tuple[str, ...]: ...

    @property
    def pixel_format(self) -> str: ...

    @property
    def trigger_line(self) -> str: ...

    @property
    def trigger_activation(self) -> str: ...

    @property
    def software_trigger(self) -> str: ...

    @property
    def exposed_counter(self) -> Counter | None: ...

    @property
    def over_trigger_counter(self) -> Counter | None: ...
