"""A XIMEA camera behind a stand-in for libm3api: compiled from `xiapi_stub.c`, edges sent by the test."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coupole.clock import SystemClock
from coupole.devices import Camera, Frame
from coupole.testing.camera_state_conformance import Left
from drivers.camera.xiapi.driver import Settings, XiCamera

SOURCE = Path(__file__).with_name("xiapi_stub.c")
COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler for the stand-in of libm3api")
BUFFERS = 32
"""More than any test leaves untaken; the stand-in drops what has no room."""
_PATIENCE_S = 10.0


def compile_stub(folder: Path) -> Path:
    """The stand-in as a library that ctypes can load."""
    assert COMPILER is not None
    library = folder / "libm3api-stand-in.so"
    command = [COMPILER, "-std=c11", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-O1", "-pthread"]
    subprocess.run([*command, str(SOURCE), "-o", str(library)], check=True)
    return library


class XiWorld:
    """See `CameraWorld`. Time is the camera's own and costs none of the machine's."""

    def __init__(self, library: Path) -> None:
        self._library, self._now_ns = str(library), 0
        self.stub: Any = ctypes.CDLL(self._library)
        self.stub.stub_edge.argtypes = (ctypes.c_uint32, ctypes.c_uint64)
        self.stub.stub_reset(1)
        self._drivers = ExitStack()

    def open(self, **settings: Any) -> XiCamera:
        given = {"library": self._library, "buffers": BUFFERS, **settings}
        camera = XiCamera(Settings.model_validate(given), SystemClock())
        return self._drivers.enter_context(closing(camera))

    def leave(self, left: Left) -> None:
        """Through xiAPI's functions, without our driver."""
        handle = ctypes.c_void_p()
        assert self.stub.xiOpenDevice(0, ctypes.byref(handle)) == 0
        for name, value in left:
            assert self.stub.xiSetParamFloat(handle, name.encode(), ctypes.c_float(value)) == 0, name
        assert self.stub.xiCloseDevice(handle) == 0

    def begun_ns(self, frame: Frame) -> int:
        return frame.timestamp_ns

    def open_nothing(self) -> Camera:
        return self.open(serial="99999999")

    def fire(self, *periods_us: int) -> list[int]:
        """Each edge waits until its image has room on the host: losses are for `self.stub` to make."""
        start_ns = self._now_ns + 50_000_000
        at_ns = [start_ns + int(offset) * 1000 for offset in np.cumsum([0, *periods_us])]
        for t_ns in at_ns:
            end_s = time.monotonic() + _PATIENCE_S
            while self.is_armed and not self.stub.stub_has_room():
                assert time.monotonic() < end_s
                time.sleep(1e-3)
            self.edge(t_ns)
        return at_ns

    def edge(self, t_ns: int, trigger_input: int = 1) -> None:
        """An edge now, whether or not its image has room."""
        self.stub.stub_edge(trigger_input, t_ns)
        self._now_ns = t_ns

    def unplug(self) -> None:
        self.stub.stub_unplug()

    def parameter(self, name: str) -> int:
        """What the camera was told."""
        value: int = self.stub.stub_parameter(name.encode())
        return value

    @property
    def is_armed(self) -> bool:
        return bool(self.stub.stub_acquiring())

    def close(self) -> None:
        self._drivers.close()
