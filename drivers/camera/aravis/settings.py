"""Settings of the Aravis driver in the rig file."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from coupole.devices import HostNeed
from drivers.camera.aravis.library import HOW_TO_INSTALL, load
from drivers.camera.genicam_settings import Counter, Region, Value
from drivers.host_checks import receive_buffer


class Settings(BaseModel):
    """Settings of the driver in the rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    device: str = "camera"
    """The camera's name in messages."""
    address: str = ""
    """IP address, serial number or Aravis id. Empty means the only connected camera."""
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
    """Largest deviation of the camera's timestamps from the edges, from its data sheet or from a measurement."""
    packet_size: Annotated[int, Field(ge=576, le=65500)] | None = None
    """Bytes of a GigE Vision packet. None means the largest that the network transmits; jumbo frames have 9000."""
    packet_socket: bool = True
    """True: packets are received past the kernel's network stack, if the process has the privilege
    (CAP_NET_RAW)."""
    frame_retention_ms: Annotated[int, Field(ge=1)] = 200
    """Longest time for the last packets of a frame, before it counts as incomplete."""
    buffers: Annotated[int, Field(ge=2)] = 16
    """Least number of queued buffers."""

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        is_installed = load() is not None
        return [
            HostNeed("libaravis-0.8", is_installed, "installed" if is_installed else "missing", HOW_TO_INSTALL),
            receive_buffer(),
        ]
