"""Settings of a XIMEA camera."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from coupole.devices import HostNeed
from drivers.camera.xiapi.library import LIBRARY
from drivers.host_checks import huge_pages, library


class Region(BaseModel):
    """Part of the sensor, in pixels; even offsets keep the Bayer pattern."""

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
    """Serial number as printed on the camera; empty: the only camera connected."""
    library: str = LIBRARY
    """Name or path of libm3api."""
    region: Region | None = None
    """None: the whole sensor."""
    bit_depth: Literal[8, 10, 12] = 12
    packed: bool = True
    """Pixels of 10 and 12 bits are packed: 12 megapixels of 12 bits are 18.9 MB instead of 25.2 MB."""
    trigger_input: Annotated[int, Field(ge=1, le=12)] = 1
    """`gpi_selector` of the input for the box's cable."""
    trigger_edge: Literal["rising", "falling"] = "rising"
    ready_output: Annotated[int, Field(ge=1, le=12)] | None = None
    """`gpo_selector` of the output that signals to the box when the camera is ready for an edge."""
    ready_inverted: bool = False
    """The line is low while the camera is ready."""
    black_dn: Annotated[int, Field(ge=0)] | None = None
    """Black level, DN; None: the camera's `image_black_level`."""
    readout_us: Annotated[int, Field(gt=0)] | None = None
    """Least time between frames; None: from the largest `framerate` at the shortest exposure."""
    exposure_gap_us: Annotated[int, Field(ge=0)] = 100
    """Least time from the end of one exposure to the start of the next."""
    timestamps: Literal["seconds", "4ns"] = "seconds"
    """Timestamp fields of an image: seconds and microseconds, by xiApi.h; or one 64-bit count of 4 ns in both
    fields, by XIMEA's Rust bindings for the xiB series."""
    timestamp_jitter_us: Annotated[float, Field(gt=0)] = 20.0
    """Largest deviation of the camera's timestamps from the edges; to be measured."""
    buffers: Annotated[int, Field(ge=2)] = 16
    """Least number of images queued."""
    parameters: dict[str, int | float | str] = Field(default_factory=dict)
    """Further xiAPI parameters, set at opening in this order. The driver's own table (`state`) leaves them out."""
    leave: tuple[str, ...] = ()
    """Parameters of the driver's own table that stay as they are in the camera."""

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        return [library(self.library, "Install XIMEA's software package for Linux."), huge_pages()]
