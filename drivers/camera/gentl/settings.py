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
    """Selects one of the producer's cameras; empty: any, if there is only one."""
    pixel_format: str = "BayerGB12"
    region: Region | None = None
    """None: the whole sensor."""
    features: dict[str, Value] = Field(default_factory=dict)
    """GenICam features to set at opening, in this order; the driver's own table (`genicam_state`) leaves them."""
    leave: tuple[str, ...] = ()
    """Features of the driver's own table that stay as they are in the camera."""
    black_dn: Annotated[int, Field(ge=0)] | None = None
    """Black level, DN; None: the value of the feature `BlackLevel`, if that is in DN."""
    free_running: bool = False
    """A camera without trigger: it exposes at its own rate and exposure time. For viewing only; no shot can be
    proven with it."""
    trigger_line: str = "Line0"
    """Entry of `TriggerSource` to which the box's cable is connected."""
    trigger_activation: str = "RisingEdge"
    software_trigger: str = "Software"
    exposed_counter: Counter | None = None
    """Counts exposures. Without one, frames lost at the end of a burst cannot be counted."""
    over_trigger_counter: Counter | None = None
    """Counts edges that came too early."""
    readout_us: Annotated[int, Field(gt=0)] | None = None
    """Least time between frames; None: the feature `SensorReadoutTime`, else `AcquisitionFrameRate`'s maximum."""
    exposure_gap_us: Annotated[int, Field(ge=0)] = 100
    """Least time from the end of one exposure to the start of the next."""
    timestamps: Literal["camera", "host"] = "camera"
    """`host`: for producers without timestamps; a frame is then stamped when it is taken, long after its edge."""
    timestamp_jitter_us: Annotated[float, Field(gt=0)] = 20.0
    """Largest deviation of the timestamps from the edges; from the camera's data sheet, or measured."""
    buffers: Annotated[int, Field(ge=2)] = 16
    """Least number of buffers queued."""

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        return [package("harvesters", "gentl"), package("genicam", "gentl"), library_file(self.producer)]
