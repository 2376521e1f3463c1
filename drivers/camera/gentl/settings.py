"""What a rig says of a camera behind a GenTL producer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from drivers.camera.genicam_settings import Counter, Region, Value


class Settings(BaseModel):
    """Settings of the driver in the rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    producer: Path
    """The camera maker's GenTL producer, a file that ends in .cti."""
    device: str = "camera"
    """How messages call it."""
    serial: str = ""
    model: str = ""
    """Which camera, of those that the producer finds; empty: any, but there must be only one."""
    pixel_format: str = "BayerGB12"
    region: Region | None = None
    """None: as the camera has it."""
    features: dict[str, Value] = Field(default_factory=dict)
    """GenICam features to set at opening, in this order, before all else."""
    black_dn: Annotated[int, Field(ge=0)] | None = None
    """Digital number of black; None: what the feature `BlackLevel` holds, where that is in DN."""
    free_running: bool = False
    """A camera without trigger: frames come at its own pace and with its own exposure. To look through only; no
    shot can be proven with it."""
    trigger_line: str = "Line0"
    """Entry of `TriggerSource` that the box's cable is on."""
    trigger_activation: str = "RisingEdge"
    software_trigger: str = "Software"
    exposed_counter: Counter | None = None
    """Counts exposures. Without one, the host cannot tell how many frames were lost at a burst's end."""
    over_trigger_counter: Counter | None = None
    """Counts edges that came too early."""
    readout_us: Annotated[int, Field(gt=0)] | None = None
    """Least time between frames; None: the feature `SensorReadoutTime`, else `AcquisitionFrameRate`'s maximum."""
    exposure_gap_us: Annotated[int, Field(ge=0)] = 100
    """Least time from the end of one exposure to the start of the next."""
    timestamps: Literal["camera", "host"] = "camera"
    """`host`: for producers that give none; a frame is then stamped when it is taken, far from its edge."""
    timestamp_jitter_us: Annotated[float, Field(gt=0)] = 20.0
    """Largest deviation of the timestamps from the edges; from the camera's data sheet, or measured."""
    buffers: Annotated[int, Field(ge=2)] = 16
    """At least so many are queued."""
