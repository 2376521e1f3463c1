"""Settings that all GenICam drivers share."""

from __future__ import annotations

from typing import Annotated

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


class GenICamSettings(BaseModel):
    """Settings in the rig file that all GenICam drivers have."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    device: str = "camera"
    """The camera's name in messages."""
    pixel_format: str = "BayerGB12"
    region: Region | None = None
    """Part of the sensor that is read. None means the whole sensor."""
    features: dict[str, Value] = Field(default_factory=dict)
    """GenICam features to set at opening, in this order. The driver's own table (`genicam_state`) does not set
    them."""
    leave: tuple[str, ...] = ()
    """Features of the driver's own table that stay unchanged in the camera."""
    black_dn: Annotated[int, Field(ge=0)] | None = None
    """Black level, DN. None means the value of the feature `BlackLevel`, if it is in DN."""
    trigger_line: str = "Line0"
    """Entry of `TriggerSource` to which the box's cable is connected."""
    trigger_activation: str = "RisingEdge"
    software_trigger: str = "Software"
    exposed_counter: Counter | None = None
    """Counter of exposures. Without it, frames that are lost at the end of a burst cannot be counted."""
    over_trigger_counter: Counter | None = None
    """Counter of edges that came too early."""
    readout_us: Annotated[int, Field(gt=0)] | None = None
    """Least time between frames. None means the feature `SensorReadoutTime`, or otherwise the maximum of
    `AcquisitionFrameRate`."""
    exposure_gap_us: Annotated[int, Field(ge=0)] = 100
    """Least time from the end of one exposure to the start of the next."""
    timestamp_jitter_us: Annotated[float, Field(gt=0)] = 20.0
    """Largest deviation of the timestamps from the edges, from the camera's data sheet or from a measurement."""
    buffers: Annotated[int, Field(ge=2)] = 16
    """Least number of queued buffers."""
