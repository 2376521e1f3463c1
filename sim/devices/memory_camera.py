"""Driver of the simulated camera without a network: frames are in memory shared with the world.

It is for machines without libaravis, and for rates above the rates of loopback. The other end is
`sim.devices.camera_server`.
"""

from __future__ import annotations

import contextlib
import errno
import json
import mmap
import os
import select
import socket
import threading
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from coupole.clock import Clock
from coupole.devices import CameraStatistics, Exposure, Frame, FrameFormat, Identity
from coupole.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout
from sim.devices.camera_server import FRAME_MESSAGE, SLOT_MESSAGE

_REPLY_TIMEOUT_S = 60.0


class Settings(BaseModel):
    """`address`: path of the world's camera socket; filled in from the world's endpoint."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    address: str
    device: str = "camera"


class MemoryCamera:
    """`coupole.devices.Camera` on the world's shared memory."""

    id_modulus = (1, 65535)
    timestamp_jitter_us = 20.0
    delivery_s = 1.0

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._name = settings.device
        self._format: FrameFormat | None = None
        self._frames: list[NDArray[np.uint16]] = []
        self._memory: mmap.mmap | None = None
        self._generation = self._session = -1
        self._lock = threading.Lock()
        self._control = self._connect(settings.address, b"control")
        try:
            self._stream = self._connect(settings.address, b"frames")
        except DeviceError:
            self._control.close()
            raise

    def _connect(self, address: str, purpose: bytes) -> socket.socket:
        link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        link.settimeout(_REPLY_TIMEOUT_S)
        try:
            link.connect(address)
            link.send(purpose)
            reply = json.loads(link.recv(4096) or b'{"error": "the world hung up"}')
        except OSError as error:
            link.close()
            raise DeviceLost(
                self._name,
                expected=f"the world's camera at {address}",
                happened=str(error),
                remedy="Check that `coupole sim` is still running.",
            ) from error
        if "error" in reply:
            link.close()
            raise DeviceRefused(
                self._name,
                expected="a free camera",
                happened=reply["error"],
                remedy="Close the other client.",
            )
        return link

    def _ask(self, do: str, **arguments: Any) -> dict[str, Any]:
        with self._lock:
            return self._exchange(do, arguments)[0]

    def _exchange(self, do: str, arguments: dict[str, Any]) -> tuple[dict[str, Any], list[int]]:
        try:
            self._control.send(json.dumps({"do": do, **arguments}).encode())
            descriptors: list[int] = []
            if do == "memory":
                _, descriptors, _, _ = socket.recv_fds(self._control, 64, 1)
            data = self._control.recv(4096)
        except TimeoutError as error:
            raise DeviceTimeout(
                self._name,
                expected=f"an answer to `{do}` within {_REPLY_TIMEOUT_S:g} s",
                happened="none came",
                remedy="Restart the world.",
            ) from error
        except OSError as error:
            raise self._loss(str(error)) from error
        if not data:
            raise self._loss("the connection was closed")
        reply: dict[str, Any] = json.loads(data)
        if "error" in reply:
            raise DeviceRefused(
                self._name,
                expected=f"`{do}` to be done",
                happened=reply["error"],
                remedy="This is a fault of the program that drives the camera.",
            )
        return reply, descriptors

    def _loss(self, observation: str) -> DeviceLost:
        return DeviceLost(
            self._name,
            expected="a link to the camera",
            happened=observation,
            remedy="Check cable and power, then resume the run.",
        )

    def identify(self) -> Identity:
        return Identity("Coupole", "memory camera", "sim-0", "1", simulated=True)

    def self_test(self) -> Mapping[str, str]:
        limits = self._ask("limits")
        return {"readout_us": str(limits["readout_us"]), "simulated": "yes"}

    def configure(self, exposure: Exposure) -> FrameFormat:
        reply = self._ask(
            "configure",
            exposure_us=exposure.exposure_us,
            gain_db=exposure.gain_db,
            hardware_trigger=exposure.hardware_trigger,
        )
        self._format = FrameFormat(**reply)
        return self._format

    def min_period_us(self, exposure: Exposure) -> int:
        limits = self._ask("limits")
        return max(int(limits["readout_us"]), exposure.exposure_us + int(limits["exposure_gap_us"]))

    def arm(self, buffers: int) -> None:
        if self._format is None:
            raise DeviceRefused(
                self._name,
                expected="configure() before arm()",
                happened="no exposure is set",
                remedy="This is a fault of the program that drives the camera.",
            )
        reply = self._ask("arm", buffers=buffers)
        self._session = reply["session"]
        if reply["memory"] != self._generation:
            self._map(reply["slots"], self._format)
            self._generation = reply["memory"]
        self._stream.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while self._stream.recv(64):
                pass
        self._stream.setblocking(True)

    def _map(self, slots: int, frame_format: FrameFormat) -> None:
        with self._lock:
            _, descriptors = self._exchange("memory", {})
        if not descriptors:  # the system drops them if this process may open no more
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        pitch = -(-frame_format.frame_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
        try:
            self._memory = mmap.mmap(descriptors[0], slots * pitch)
        finally:
            os.close(descriptors[0])
        shape = (frame_format.height_px, frame_format.width_px)
        self._frames = [
            np.frombuffer(self._memory, np.uint16, frame_format.frame_bytes // 2, k * pitch).reshape(shape)
            for k in range(slots)
        ]

    def next_frame(self, timeout_s: float) -> Frame | None:
        try:
            if not select.select([self._stream], [], [], timeout_s)[0]:
                return None
            data = self._stream.recv(FRAME_MESSAGE.size)
        except OSError as error:
            raise self._loss(str(error)) from error
        if not data:
            raise self._loss("the camera's stream was closed")
        slot, frame_id, timestamp_ns, is_rendered = FRAME_MESSAGE.unpack(data)
        return Frame(
            frame_id,
            timestamp_ns,
            self._frames[slot],
            partial(self._release, slot * 65536 + self._session),
            bool(is_rendered),
        )

    def _release(self, ticket: int) -> None:
        with contextlib.suppress(OSError):
            self._stream.send(SLOT_MESSAGE.pack(ticket))

    def trigger(self) -> None:
        self._ask("trigger")

    def statistics(self) -> CameraStatistics:
        return CameraStatistics(**self._ask("statistics"))

    def disarm(self) -> None:
        self._ask("disarm")

    def close(self) -> None:
        with contextlib.suppress(DeviceError):
            self.disarm()
        self._control.close()
        self._stream.close()
        self._frames = []
