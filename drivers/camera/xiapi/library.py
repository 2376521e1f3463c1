"""XIMEA's C library libm3api: the structures, constants and functions that the driver uses.

The sources are xiApi.h of XIMEA's software package, as published with the `xiapi-sys` bindings, and `xidefs.py` of
the package ximea-py 4.27.13. Both have the same layout of XI_IMG (288 bytes on 64-bit machines). DWORD has 32
bits.
"""

from __future__ import annotations

import ctypes
from typing import Any

from coupole.errors import DeviceLost

LIBRARY = "libm3api.so.2"

TRIGGER_OFF, TRIGGER_RISING, TRIGGER_FALLING, TRIGGER_SOFTWARE = 0, 1, 2, 3  # XI_TRG_SOURCE
TRIGGER_STARTS_FRAME = 0  # XI_TRG_SELECTOR
OVERLAP_READ_OUT = 1  # XI_TRG_OVERLAP
GPI_TRIGGER = 1  # XI_GPI_MODE
GPO_TRIGGER_WAIT, GPO_TRIGGER_WAIT_NEGATED = 6, 7  # XI_GPO_MODE
RAW16 = 6  # XI_IMG_FORMAT
BUFFERS_SAFE = 1  # XI_BP
OPEN_BY_SERIAL = 1  # XI_OPEN_BY

BAYER_PATTERNS = {0: "MONO", 1: "RGGB", 4: "BGGR", 5: "GRBG", 6: "GBRG"}
"""Supported values of XI_COLOR_FILTER_ARRAY."""

TRANSPORT_SKIPPED, API_SKIPPED, TRANSFERRED, MISSED_OVERLAP, MISSED_BUFFER_FULL, BUFFER_OVERFLOWS = range(6)
"""XI_COUNTER_SELECTOR."""

OK, TIMEOUT, LOCKED = 0, 10, 57
ABSENT = frozenset({12, 26, 100, 106, 107, 119})
"""Error codes: the camera does not have this parameter, or does not have it at present."""
GONE = frozenset({1, 2, 3, 45, 46, 49, 55, 56})
"""Error codes: the camera does not answer, was reset, or stopped by itself."""

_CODES = """
0 OK 1 INVALID_HANDLE 2 READREG 3 WRITEREG 4 FREE_RESOURCES 5 FREE_CHANNEL 6 FREE_BANDWIDTH 7 READBLK 8 WRITEBLK
9 NO_IMAGE 10 TIMEOUT 11 INVALID_ARG 12 NOT_SUPPORTED 13 ISOCH_ATTACH_BUFFERS 14 GET_OVERLAPPED_RESULT
15 MEMORY_ALLOCATION 16 DLLCONTEXTISNULL 17 DLLCONTEXTISNONZERO 18 DLLCONTEXTEXIST 19 TOOMANYDEVICES
20 ERRORCAMCONTEXT 21 UNKNOWN_HARDWARE 22 INVALID_TM_FILE 23 INVALID_TM_TAG 24 INCOMPLETE_TM 25 BUS_RESET_FAILED
26 NOT_IMPLEMENTED 27 SHADING_TOOBRIGHT 28 SHADING_TOODARK 29 TOO_LOW_GAIN 30 INVALID_BPL 31 BPL_REALLOC
32 INVALID_PIXEL_LIST 33 INVALID_FFS 34 INVALID_PROFILE 35 INVALID_CALIBRATION 36 INVALID_BUFFER 38 INVALID_DATA
39 TGBUSY 40 IO_WRONG 41 ACQUISITION_ALREADY_UP 42 OLD_DRIVER_VERSION 43 GET_LAST_ERROR 44 CANT_PROCESS
45 ACQUISITION_STOPED 46 ACQUISITION_STOPED_WERR 47 INVALID_INPUT_ICC_PROFILE 48 INVALID_OUTPUT_ICC_PROFILE
49 DEVICE_NOT_READY 50 SHADING_TOOCONTRAST 51 ALREADY_INITIALIZED 52 NOT_ENOUGH_PRIVILEGES
53 NOT_COMPATIBLE_DRIVER 54 TM_INVALID_RESOURCE 55 DEVICE_HAS_BEEN_RESETED 56 NO_DEVICES_FOUND
57 RESOURCE_OR_FUNCTION_LOCKED 58 BUFFER_SIZE_TOO_SMALL 59 COULDNT_INIT_PROCESSOR 60 NOT_INITIALIZED
61 RESOURCE_NOT_FOUND 100 UNKNOWN_PARAM 101 WRONG_PARAM_VALUE 103 WRONG_PARAM_TYPE 104 WRONG_PARAM_SIZE
105 BUFFER_TOO_SMALL 106 NOT_SUPPORTED_PARAM 107 NOT_SUPPORTED_PARAM_INFO 108 NOT_SUPPORTED_DATA_FORMAT
109 READ_ONLY_PARAM 111 BANDWIDTH_NOT_SUPPORTED 112 INVALID_FFS_FILE_NAME 113 FFS_FILE_NOT_FOUND
114 PARAM_NOT_SETTABLE 115 SAFE_POLICY_NOT_SUPPORTED 116 GPUDIRECT_NOT_AVAILABLE 117 INCORRECT_SENS_ID_CHECK
118 INCORRECT_FPGA_TYPE 119 PARAM_CONDITIONALLY_NOT_AVAILABLE 120 ERR_FRAME_BUFFER_RAM_INIT
201 PROC_OTHER_ERROR 202 PROC_PROCESSING_ERROR 203 PROC_INPUT_FORMAT_UNSUPPORTED
204 PROC_OUTPUT_FORMAT_UNSUPPORTED 205 OUT_OF_RANGE
"""
_WORDS = _CODES.split()
CODE_NAMES = {int(code): f"XI_{name}" for code, name in zip(_WORDS[::2], _WORDS[1::2], strict=True)}
"""XI_RET by number."""


def code_name(code: int) -> str:
    return CODE_NAMES.get(code, f"error {code}")


_U32, _F32 = ctypes.c_uint32, ctypes.c_float


class Image(ctypes.Structure):
    """XI_IMG."""

    _fields_ = (
        ("size", _U32),
        ("bp", ctypes.c_void_p),
        ("bp_size", _U32),
        ("frm", _U32),
        ("width", _U32),
        ("height", _U32),
        ("nframe", _U32),
        ("tsSec", _U32),
        ("tsUSec", _U32),
        ("GPI_level", _U32),
        ("black_level", _U32),
        ("padding_x", _U32),
        ("AbsoluteOffsetX", _U32),
        ("AbsoluteOffsetY", _U32),
        ("transport_frm", _U32),
        ("img_desc", _U32 * 28),
        ("DownsamplingX", _U32),
        ("DownsamplingY", _U32),
        ("flags", _U32),
        ("exposure_time_us", _U32),
        ("gain_db", _F32),
        ("acq_nframe", _U32),
        ("image_user_data", _U32),
        ("exposure_sub_times_us", _U32 * 5),
        ("data_saturation", ctypes.c_double),
        ("wb_red", _F32),
        ("wb_green", _F32),
        ("wb_blue", _F32),
        ("lg_black_level", _U32),
        ("hg_black_level", _U32),
        ("lg_range", _U32),
        ("hg_range", _U32),
        ("gain_ratio", _F32),
        ("fDownsamplingX", _F32),
        ("fDownsamplingY", _F32),
        ("color_filter_array", _U32),
    )


_HANDLE, _TEXT = ctypes.c_void_p, ctypes.c_char_p
_FUNCTIONS: dict[str, tuple[Any, ...]] = {
    "xiGetNumberDevices": (ctypes.POINTER(_U32),),
    "xiOpenDevice": (_U32, ctypes.POINTER(_HANDLE)),
    "xiOpenDeviceBy": (_U32, _TEXT, ctypes.POINTER(_HANDLE)),
    "xiCloseDevice": (_HANDLE,),
    "xiStartAcquisition": (_HANDLE,),
    "xiStopAcquisition": (_HANDLE,),
    "xiGetImage": (_HANDLE, _U32, ctypes.POINTER(Image)),
    "xiSetParamInt": (_HANDLE, _TEXT, ctypes.c_int),
    "xiSetParamFloat": (_HANDLE, _TEXT, _F32),
    "xiSetParamString": (_HANDLE, _TEXT, ctypes.c_void_p, _U32),
    "xiGetParamInt": (_HANDLE, _TEXT, ctypes.POINTER(ctypes.c_int)),
    "xiGetParamFloat": (_HANDLE, _TEXT, ctypes.POINTER(_F32)),
    "xiGetParamString": (_HANDLE, _TEXT, ctypes.c_void_p, _U32),
}
"""Arguments of the functions. Each function returns an XI_RET. ctypes releases the GIL during a call."""


def load(name: str, device: str) -> Any:
    """Return the library with its functions declared. Raises DeviceLost if it is not installed."""
    try:
        library = ctypes.CDLL(name)
        for function, arguments in _FUNCTIONS.items():
            entry_point = getattr(library, function)
            entry_point.argtypes, entry_point.restype = arguments, ctypes.c_int
    except (OSError, AttributeError) as error:
        raise DeviceLost(
            device,
            expected=f"XIMEA's library {name}",
            happened=str(error),
            remedy="Install XIMEA's software package for Linux, or give the library's path in the rig.",
        ) from error
    return library
