"""libaravis-0.8 over ctypes: prototypes of the functions used, and translation of its errors.

All argument and result types are declared, because a pointer passed as a C int would be cut to 32 bits. `call` is
for functions whose last parameter is a `GError **`.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import functools
import importlib.util
from pathlib import Path
from typing import Any

from coupole.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout

POINTER, TEXT = ctypes.c_void_p, ctypes.c_char_p
_INT, _UINT, _I64, _U64, _REAL = ctypes.c_int, ctypes.c_uint, ctypes.c_int64, ctypes.c_uint64, ctypes.c_double
_TYPE = ctypes.c_size_t


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", ctypes.c_int), ("message", TEXT))


_ERROR = ctypes.POINTER(ctypes.POINTER(_GError))
_COUNTS = ctypes.POINTER(_U64)
ON_CONTROL_LOST = ctypes.CFUNCTYPE(None, POINTER, POINTER)

_PROTOTYPES: dict[str, tuple[Any, list[Any]]] = {
    # devices
    "arv_update_device_list": (None, []),
    "arv_get_n_devices": (_UINT, []),
    "arv_get_device_id": (TEXT, [_UINT]),
    "arv_get_device_physical_id": (TEXT, [_UINT]),
    "arv_get_device_address": (TEXT, [_UINT]),
    "arv_get_device_vendor": (TEXT, [_UINT]),
    "arv_get_device_model": (TEXT, [_UINT]),
    "arv_get_device_serial_nbr": (TEXT, [_UINT]),
    "arv_get_device_protocol": (TEXT, [_UINT]),
    "arv_open_device": (POINTER, [TEXT, _ERROR]),
    "arv_device_error_quark": (ctypes.c_uint32, []),
    "arv_device_read_register": (_INT, [POINTER, _U64, ctypes.POINTER(ctypes.c_uint32), _ERROR]),
    "arv_gv_device_get_type": (_TYPE, []),
    "arv_gv_device_is_controller": (_INT, [POINTER]),
    "arv_gv_device_auto_packet_size": (_UINT, [POINTER, _ERROR]),
    "arv_gv_device_set_packet_size": (None, [POINTER, _INT, _ERROR]),
    "arv_gv_device_get_packet_size": (_UINT, [POINTER, _ERROR]),
    "arv_gv_device_set_stream_options": (None, [POINTER, _INT]),
    # features
    "arv_device_get_feature": (POINTER, [POINTER, TEXT]),
    "arv_device_get_feature_access_mode": (_INT, [POINTER, TEXT]),
    "arv_device_is_feature_available": (_INT, [POINTER, TEXT, _ERROR]),
    "arv_device_execute_command": (None, [POINTER, TEXT, _ERROR]),
    "arv_device_get_boolean_feature_value": (_INT, [POINTER, TEXT, _ERROR]),
    "arv_device_set_boolean_feature_value": (None, [POINTER, TEXT, _INT, _ERROR]),
    "arv_device_get_string_feature_value": (TEXT, [POINTER, TEXT, _ERROR]),
    "arv_device_set_string_feature_value": (None, [POINTER, TEXT, TEXT, _ERROR]),
    "arv_device_get_integer_feature_value": (_I64, [POINTER, TEXT, _ERROR]),
    "arv_device_set_integer_feature_value": (None, [POINTER, TEXT, _I64, _ERROR]),
    "arv_device_get_integer_feature_bounds": (
        None,
        [POINTER, TEXT, ctypes.POINTER(_I64), ctypes.POINTER(_I64), _ERROR],
    ),
    "arv_device_get_integer_feature_increment": (_I64, [POINTER, TEXT, _ERROR]),
    "arv_device_get_float_feature_value": (_REAL, [POINTER, TEXT, _ERROR]),
    "arv_device_set_float_feature_value": (None, [POINTER, TEXT, _REAL, _ERROR]),
    "arv_device_get_float_feature_bounds": (
        None,
        [POINTER, TEXT, ctypes.POINTER(_REAL), ctypes.POINTER(_REAL), _ERROR],
    ),
    "arv_device_dup_available_enumeration_feature_values_as_strings": (
        ctypes.POINTER(TEXT),
        [POINTER, TEXT, ctypes.POINTER(_UINT), _ERROR],
    ),
    "arv_gc_boolean_get_type": (_TYPE, []),
    "arv_gc_command_get_type": (_TYPE, []),
    "arv_gc_enumeration_get_type": (_TYPE, []),
    "arv_gc_float_get_type": (_TYPE, []),
    "arv_gc_integer_get_type": (_TYPE, []),
    "arv_gc_string_get_type": (_TYPE, []),
    # stream and buffers
    "arv_device_create_stream": (POINTER, [POINTER, POINTER, POINTER, _ERROR]),
    "arv_stream_push_buffer": (None, [POINTER, POINTER]),
    "arv_stream_timeout_pop_buffer": (POINTER, [POINTER, _U64]),
    "arv_stream_get_statistics": (None, [POINTER, _COUNTS, _COUNTS, _COUNTS]),
    "arv_gv_stream_get_type": (_TYPE, []),
    "arv_gv_stream_socket_buffer_get_type": (_TYPE, []),
    "arv_buffer_new": (POINTER, [ctypes.c_size_t, POINTER]),
    "arv_buffer_get_status": (_INT, [POINTER]),
    "arv_buffer_get_frame_id": (_U64, [POINTER]),
    "arv_buffer_get_timestamp": (_U64, [POINTER]),
    "arv_buffer_get_data": (POINTER, [POINTER, ctypes.POINTER(ctypes.c_size_t)]),
    "arv_buffer_get_image_pixel_format": (ctypes.c_uint32, [POINTER]),
    "arv_buffer_get_image_width": (_INT, [POINTER]),
    "arv_buffer_get_image_height": (_INT, [POINTER]),
    # GObject and GLib, which libaravis links
    "g_object_ref": (POINTER, [POINTER]),
    "g_object_unref": (None, [POINTER]),
    "g_object_set_property": (None, [POINTER, TEXT, POINTER]),
    "g_value_init": (POINTER, [POINTER, _TYPE]),
    "g_value_set_enum": (None, [POINTER, _INT]),
    "g_value_set_int": (None, [POINTER, _INT]),
    "g_value_set_uint": (None, [POINTER, _UINT]),
    "g_type_check_instance_is_a": (_INT, [POINTER, _TYPE]),
    "g_signal_connect_data": (ctypes.c_ulong, [POINTER, TEXT, ON_CONTROL_LOST, POINTER, POINTER, _INT]),
    "g_signal_handler_disconnect": (None, [POINTER, ctypes.c_ulong]),
    "g_error_free": (None, [ctypes.POINTER(_GError)]),
    "g_free": (None, [POINTER]),
}
_NOT_CONNECTED, _TRANSFER_ERROR, _TIMEOUT, _NOT_FOUND, _NOT_CONTROLLER = 2, 4, 5, 6, 10
"""Codes of ArvDeviceError (arvdevice.h)."""


HOW_TO_INSTALL = "Install it (Debian: apt install libaravis-0.8-0; else pip install aravis-python)."


@functools.cache
def load() -> Any:
    """Return the library, which also exports GObject's functions; None if it is not installed.

    It is searched for among the system's libraries, then in the wheel `aravis-python`.
    """
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
    return None


def require(device: str) -> Any:
    """Return the library. Raises DeviceError for `device` if it is not installed."""
    library = load()
    if library is None:
        raise DeviceError(
            device,
            expected="libaravis-0.8, which implements GigE Vision and USB3 Vision",
            happened="it is not installed",
            remedy=HOW_TO_INSTALL,
        )
    return library


def call(device: str, doing: str, function: Any, *arguments: Any) -> Any:
    """Call a function that may set a GError; `doing` describes the call in messages about `device`.

    Raises DeviceTimeout, DeviceLost or DeviceRefused.
    """
    error = ctypes.POINTER(_GError)()
    result = function(*arguments, ctypes.byref(error))
    if not error:
        return result
    domain, code = error.contents.domain, error.contents.code
    message = (error.contents.message or b"no message").decode(errors="replace")
    library = load()
    library.g_error_free(error)
    kind, remedy = _kind_and_remedy(code if domain == library.arv_device_error_quark() else -1)
    raise kind(device, expected=doing, happened=f"Aravis says: {message}", remedy=remedy)


def _kind_and_remedy(code: int) -> tuple[type[DeviceError], str]:
    if code == _TIMEOUT:
        return DeviceTimeout, "Check the camera's cable and power, then resume the run."
    if code in {_NOT_CONNECTED, _TRANSFER_ERROR, _NOT_FOUND}:
        return DeviceLost, "Check the camera's cable, power and address, then start again."
    if code == _NOT_CONTROLLER:
        return DeviceLost, "Another program has taken control of the camera: end it, then resume the run."
    return DeviceRefused, "Correct the camera's settings in the rig."


def is_a(library: Any, instance: int, type_name: str) -> bool:
    """True if a GObject instance is of the type that the library's `<type_name>_get_type` returns."""
    return bool(library.g_type_check_instance_is_a(instance, getattr(library, f"{type_name}_get_type")()))


def set_property(library: Any, instance: int, name: str, kind: str, number: int) -> None:
    """`g_object_set_property` for a number of the `kind` int, uint or enum. A GValue is 24 bytes, initially
    zero."""
    value = ctypes.create_string_buffer(24)
    type_of_kind = {"int": 6 << 2, "uint": 7 << 2, "enum": library.arv_gv_stream_socket_buffer_get_type()}
    library.g_value_init(value, type_of_kind[kind])
    getattr(library, f"g_value_set_{kind}")(value, number)
    library.g_object_set_property(instance, name.encode(), value)
