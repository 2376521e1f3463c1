"""Registers of the simulated GigE Vision camera, and the functions of libaravis that access them.

Clients read and write registers over the wire, on the fake camera's own thread; the stand-in polls those and
writes its own. No register is written from both sides, since no lock spans the wire.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib.util
import struct
from pathlib import Path
from typing import Any

from coupole.errors import DeviceError

DESCRIPTION = Path(__file__).with_name("gige.xml")

# Fixed by GigE Vision (bootstrap registers) and by Aravis's fake camera.
VENDOR, MODEL, VERSION = 0x48, 0x68, 0x88
CONTROL_PRIVILEGE = 0xA00
WIDTH, HEIGHT, OFFSET_X, OFFSET_Y = 0x100, 0x104, 0x130, 0x134
SENSOR_HEIGHT, SENSOR_WIDTH, PIXEL_FORMAT = 0x118, 0x11C, 0x128
ACQUISITION = 0x124
"""Number of the session that the client started; 0 while none is active."""
FAKE_TRIGGER_MODE, FAKE_TRIGGER_SOURCE, FAKE_TRIGGER = 0x300, 0x304, 0x30C
"""The fake sends one frame when the third register is 1, if mode and source are 1."""

# Coupole's own: 64-bit floats, then 32-bit integers; gige.xml has the same addresses.
TEMPERATURE_C, FRAME_RATE_HZ, FRAME_RATE_MAX_HZ, EXPOSURE_US = 0x2000, 0x2008, 0x2010, 0x2018
READOUT_US, GAIN_DB, BLACK_LEVEL_DN = 0x2020, 0x2028, 0x2030
NEXT_SESSION, TRIGGER_MODE, TRIGGER_SOURCE, TRIGGERS = 0x2040, 0x2048, 0x204C, 0x2054
EXPOSED, OVER_TRIGGERS = 0x205C, 0x2060
LINE0, SOFTWARE = 0, 1
"""Values of TRIGGER_SOURCE."""

FILL = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32)
"""Called when a frame is to be sent: buffer, user data, exposure us, gain, pixel format."""

_POINTER, _TEXT, _U32, _U64 = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_uint32, ctypes.c_uint64
_PROTOTYPES: dict[str, tuple[Any, list[Any]]] = {
    "arv_gv_fake_camera_new_full": (_POINTER, [_TEXT, _TEXT, _TEXT]),
    "arv_gv_fake_camera_is_running": (ctypes.c_int, [_POINTER]),
    "arv_gv_fake_camera_get_fake_camera": (_POINTER, [_POINTER]),
    "arv_fake_camera_read_memory": (ctypes.c_int, [_POINTER, _U32, _U32, _POINTER]),
    "arv_fake_camera_write_memory": (ctypes.c_int, [_POINTER, _U32, _U32, _POINTER]),
    "arv_fake_camera_get_payload": (ctypes.c_size_t, [_POINTER]),
    "arv_fake_camera_set_fill_pattern": (None, [_POINTER, FILL, _POINTER]),
    "arv_fake_camera_set_trigger_frequency": (None, [_POINTER, ctypes.c_double]),
    "arv_buffer_get_data": (_POINTER, [_POINTER, ctypes.POINTER(ctypes.c_size_t)]),
    "arv_buffer_set_frame_id": (None, [_POINTER, _U64]),
    "arv_buffer_set_timestamp": (None, [_POINTER, _U64]),
    "g_object_unref": (None, [_POINTER]),
    "g_object_set_property": (None, [_POINTER, _TEXT, _POINTER]),
    "g_value_init": (_POINTER, [_POINTER, ctypes.c_size_t]),
    "g_value_set_double": (None, [_POINTER, ctypes.c_double]),
}
_G_TYPE_DOUBLE = 15 << 2


def load_library() -> Any:
    """libaravis-0.8, with the GObject functions. Raises DeviceError if it is not installed."""
    names = [ctypes.util.find_library("aravis-0.8"), "libaravis-0.8.so.0"]
    wheel = importlib.util.find_spec("aravis")
    if wheel is not None and wheel.origin is not None:
        names.append(str(Path(wheel.origin).with_name("lib") / "libaravis-0.8.so.0"))
    for name in filter(None, names):
        try:
            library = ctypes.CDLL(name)
        except OSError:
            continue
        for function, (result, arguments) in _PROTOTYPES.items():
            getattr(library, function).restype = result
            getattr(library, function).argtypes = arguments
        return library
    raise DeviceError(
        "world",
        expected="libaravis-0.8, whose fake GigE Vision camera the simulation uses",
        happened="it is not installed",
        remedy="Install it (Debian: apt install libaravis-0.8-0; else pip install aravis-python), or use the rig "
        "with the camera in shared memory.",
    )


class Registers:
    """Register memory of one fake camera, big-endian as on the wire."""

    def __init__(self, library: Any, fake: int) -> None:
        self._library, self._fake = library, fake

    def _read(self, address: int, size: int) -> bytes:
        data = ctypes.create_string_buffer(size)
        self._library.arv_fake_camera_read_memory(self._fake, address, size, data)
        return data.raw

    def _write(self, address: int, data: bytes) -> None:
        self._library.arv_fake_camera_write_memory(self._fake, address, len(data), data)

    def integer(self, address: int) -> int:
        number: int = struct.unpack(">I", self._read(address, 4))[0]
        return number

    def real(self, address: int) -> float:
        number: float = struct.unpack(">d", self._read(address, 8))[0]
        return number

    def payload_bytes(self) -> int:
        """Size of an image with the present width, height and pixel format."""
        size: int = self._library.arv_fake_camera_get_payload(self._fake)
        return size

    def set_integer(self, address: int, number: int) -> None:
        self._write(address, struct.pack(">I", number % 2**32))

    def set_real(self, address: int, number: float) -> None:
        self._write(address, struct.pack(">d", number))

    def set_text(self, address: int, text: str, size: int = 32) -> None:
        self._write(address, text.encode().ljust(size, b"\0"))


def set_double_property(library: Any, instance: int, name: str, number: float) -> None:
    """`g_object_set_property` for a double. A GValue is 24 bytes, initially zero."""
    value = ctypes.create_string_buffer(24)
    library.g_value_init(value, _G_TYPE_DOUBLE)
    library.g_value_set_double(value, number)
    library.g_object_set_property(instance, name.encode(), value)
