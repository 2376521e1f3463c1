"""Finds GigE Vision and USB3 Vision cameras, and opens one with control of it."""

from __future__ import annotations

import contextlib
import ctypes
import ipaddress
import time
from dataclasses import dataclass
from typing import Any

from coupole.errors import DeviceError, DeviceLost, DeviceRefused
from drivers.camera.aravis.library import call, is_a, load

_STALE_CONTROL_S = 4.0
"""Time for which opening is retried. A camera drops a client 3 s after its last heartbeat."""
_RETRY_S = 0.25
_PRIMARY_APPLICATION_IP = 0xA14
"""Bootstrap register of GigE Vision: address of the client that controls the camera."""


@dataclass(frozen=True)
class Found:
    """A camera that answered discovery."""

    id: str
    address: str
    vendor: str
    model: str
    serial: str
    protocol: str


def discover() -> list[Found]:
    """Return all cameras that answer within about a second; none if libaravis is not installed."""
    library = load()
    if library is None:
        return []
    library.arv_update_device_list()
    names = ("id", "address", "vendor", "model", "serial_nbr", "protocol")
    return [
        Found(*((getattr(library, f"arv_get_device_{name}")(index) or b"").decode() for name in names))
        for index in range(library.arv_get_n_devices())
    ]


def name_of(device: str, address: str) -> str:
    """Return the name with which libaravis opens a camera. An IP address is unchanged. For a serial number, an
    Aravis id or an empty text, it is the name of the matching camera. Raises DeviceLost if none matches, and
    DeviceRefused if several match."""
    with contextlib.suppress(ValueError):
        return str(ipaddress.IPv4Address(address))
    cameras = discover()
    fitting = [camera for camera in cameras if address in {"", camera.id, camera.serial, camera.address}]
    if len(fitting) == 1:
        return fitting[0].id
    descriptions = ", ".join(f"{c.vendor} {c.model} {c.serial} ({c.address})" for c in cameras) or "none"
    raise (DeviceRefused if fitting else DeviceLost)(
        device,
        expected=f"one camera {address}" if address else "exactly one camera",
        happened=f"cameras that answer: {descriptions}",
        remedy="Check cable and power, or give `address` in the camera's settings of the rig.",
    )


def open_controlled(library: Any, device: str, name: str) -> int:
    """Return a handle of the camera with control of it. This waits until the camera has dropped a client that
    died.

    Raises DeviceLost if no camera answers to `name`, DeviceRefused if another client controls it.
    """
    end_s = time.monotonic() + _STALE_CONTROL_S
    while True:
        handle: int = call(device, f"a camera at {name}", library.arv_open_device, name.encode())
        if not is_a(library, handle, "arv_gv_device") or library.arv_gv_device_is_controller(handle):
            return handle
        owner = _owner(library, device, handle)
        library.g_object_unref(handle)
        if time.monotonic() > end_s:
            raise DeviceRefused(
                device,
                expected=f"control of the camera at {name}",
                happened=f"it is in use by {owner}",
                remedy="Close the other program.",
            )
        time.sleep(_RETRY_S)


def _owner(library: Any, device: str, handle: int) -> str:
    address = ctypes.c_uint32()
    read_register = library.arv_device_read_register
    with contextlib.suppress(DeviceError):
        call(device, "the client's address", read_register, handle, _PRIMARY_APPLICATION_IP, ctypes.byref(address))
    return str(ipaddress.IPv4Address(address.value)) if address.value else "another client"
