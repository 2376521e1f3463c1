"""Settings of a camera over a GenTL producer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from coupole.devices import HostNeed
from drivers.camera.genicam_settings import Counter, Region, Value
from drivers.host_checks import library_file, package


class Settings(BaseModel):
    """Settings of the driver in the rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    producer: Path
    """The camera maker's GenTL producer, a file that ends in .cti."""
    device: str = "camera"
    """The camera's name in messages."""
    serial: str = ""
    model: str = ""
    """Selects one of the producer's cameras. Empty means any, if there is only one."""
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
    free_running: bool = False
    """True for a camera without a trigger, which exposes at its own rate and exposure time. It is for viewing
    only: no shot can be proven with it."""
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
    timestamps: Literal["camera", "host"] = "camera"
    """Source of timestamps. `host` is for producers without timestamps: a frame then gets the time when it is
    taken, long after its edge."""
    timestamp_jitter_us: Annotated[float, Field(gt=0)] = 20.0
    """Largest deviation of the timestamps from the edges, from the camera's data sheet or from a measurement."""
    buffers: Annotated[int, Field(ge=2)] = 16
    """Least number of queued buffers."""

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        return [package("harvesters", "gentl"), package("genicam", "gentl"), library_file(self.producer)]
