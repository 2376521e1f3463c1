"""Settings of a XIMEA camera."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from coupole.devices import HostNeed
from drivers.camera.xiapi.library import LIBRARY
from drivers.host_checks import huge_pages, library


class Region(BaseModel):
    """Part of the sensor, in pixels. Even offsets keep the Bayer pattern."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    width_px: Annotated[int, Field(gt=0, multiple_of=2)]
    height_px: Annotated[int, Field(gt=0, multiple_of=2)]
    left_px: Annotated[int, Field(ge=0, multiple_of=2)] = 0
    top_px: Annotated[int, Field(ge=0, multiple_of=2)] = 0


class Settings(BaseModel):
    """Settings of a XIMEA camera in a rig."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    device: str = "camera"
    """The camera's name in messages."""
    serial: str = ""
    """Serial number as printed on the camera. Empty means the only connected camera."""
    library: str = LIBRARY
    """Name or path of libm3api."""
    region: Region | None = None
    """Part of the sensor that is read. None means the whole sensor."""
    bit_depth: Literal[8, 10, 12] = 12
    packed: bool = True
    """True: pixels of 10 and 12 bits are packed. 12 megapixels of 12 bits are then 18.9 MB instead of 25.2 MB."""
    trigger_input: Annotated[int, Field(ge=1, le=12)] = 1
    """`gpi_selector` of the input for the box's cable."""
    trigger_edge: Literal["rising", "falling"] = "rising"
    ready_output: Annotated[int, Field(ge=1, le=12)] | None = None
    """`gpo_selector` of the output that tells the box when the camera is ready for an edge."""
    ready_inverted: bool = False
    """True if the line is low while the camera is ready."""
    black_dn: Annotated[int, Field(ge=0)] | None = None
    """Black level, DN. None means the camera's `image_black_level`."""
    readout_us: Annotated[int, Field(gt=0)] | None = None
    """Least time between frames. None means from the largest `framerate` at the shortest exposure."""
    exposure_gap_us: Annotated[int, Field(ge=0)] = 100
    """Least time from the end of one exposure to the start of the next."""
    timestamps: Literal["seconds", "4ns"] = "seconds"
    """Form of the timestamp fields of an image. `seconds`: seconds and microseconds, as in xiApi.h. `4ns`: one
    64-bit count of 4 ns in both fields, as in XIMEA's Rust bindings for the xiB series."""
    timestamp_jitter_us: Annotated[float, Field(gt=0)] = 20.0
    """Largest deviation of the camera's timestamps from the edges. It must be measured."""
    buffers: Annotated[int, Field(ge=2)] = 16
    """Least number of queued images."""
    parameters: dict[str, int | float | str] = Field(default_factory=dict)
    """Further xiAPI parameters, set at opening in this order. The driver's own table (`state`) does not set
    them."""
    leave: tuple[str, ...] = ()
    """Parameters of the driver's own table that stay unchanged in the camera."""

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        return [library(self.library, "Install XIMEA's software package for Linux."), huge_pages()]
