"""Settings of a camera over a GenTL producer."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from coupole.devices import HostNeed
from drivers.camera.genicam_settings import GenICamSettings
from drivers.host_checks import library_file, package


class Settings(GenICamSettings):
    """Settings of the driver in the rig file."""

    producer: Path
    """The camera maker's GenTL producer, a file that ends in .cti."""
    serial: str = ""
    model: str = ""
    """Selects one of the producer's cameras. Empty means any, if there is only one."""
    free_running: bool = False
    """True for a camera without a trigger, which exposes at its own rate and exposure time. It is for viewing
    only: no shot can be proven with it."""
    timestamps: Literal["camera", "host"] = "camera"
    """Source of timestamps. `host` is for producers without timestamps: a frame then gets the time when it is
    taken, long after its edge."""

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        return [package("harvesters", "gentl"), package("genicam", "gentl"), library_file(self.producer)]
