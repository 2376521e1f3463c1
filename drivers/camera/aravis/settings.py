"""Settings of the Aravis driver in the rig file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from coupole.devices import HostNeed
from drivers.camera.aravis.library import HOW_TO_INSTALL, load
from drivers.camera.genicam_settings import GenICamSettings
from drivers.host_checks import receive_buffer


class Settings(GenICamSettings):
    """Settings of the driver in the rig file."""

    address: str = ""
    """IP address, serial number or Aravis id. Empty means the only connected camera."""
    packet_size: Annotated[int, Field(ge=576, le=65500)] | None = None
    """Bytes of a GigE Vision packet. None means the largest that the network transmits; jumbo frames have 9000."""
    packet_socket: bool = True
    """True: packets are received past the kernel's network stack, if the process has the privilege
    (CAP_NET_RAW)."""
    frame_retention_ms: Annotated[int, Field(ge=1)] = 200
    """Longest time for the last packets of a frame, before it counts as incomplete."""

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        is_installed = load() is not None
        return [
            HostNeed("libaravis-0.8", is_installed, "installed" if is_installed else "missing", HOW_TO_INSTALL),
            receive_buffer(),
        ]
