"""A simulated camera without a network. Its frames are in a ring of page-aligned slots, which it shares with the
host.

Clients are notified of frames over a Unix socket and return the slots. `memory_camera` is the driver at the other
end; the sensor is in `sim.devices.camera_body`.
"""

from __future__ import annotations

import contextlib
import json
import math
import mmap
import os
import socket
import struct
import time
from collections import deque
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from sim.devices import camera_body
from sim.devices.camera_body import CameraBody, Shot, Surroundings
from sim.world.reactor import Reactor

FRAME_MESSAGE = struct.Struct("<IQQB")
"""Slot, frame id, timestamp ns, 1 if the frame holds a picture."""
SLOT_MESSAGE = struct.Struct("<I")
_HOST_PATIENCE_S, _HOST_NAP_S = 30.0, 0.005


class Settings(camera_body.Settings):
    """Properties of the simulated camera."""

    kind: Literal["memory"] = "memory"
    slots: Annotated[int, Field(ge=8)] = 48


class _Command(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class _Configure(_Command):
    do: Literal["configure"]
    exposure_us: Annotated[int, Field(ge=1, le=10**9)]
    gain_db: Annotated[float, Field(ge=-100, le=100)]
    hardware_trigger: bool


class _Arm(_Command):
    do: Literal["arm"]
    buffers: Annotated[int, Field(ge=0, le=65535)]


class _Plain(_Command):
    do: Literal["limits", "memory", "trigger", "statistics", "disarm"]


_COMMAND: TypeAdapter[_Configure | _Arm | _Plain] = TypeAdapter(
    Annotated[_Configure | _Arm | _Plain, Field(discriminator="do")]
)
"""Commands that a client may send."""


def _receive_message(client: socket.socket, size: int) -> bytes:
    """Return the next message; empty if the client is gone. (A client that is killed with unread messages resets
    the connection.)"""
    try:
        return client.recv(size)
    except ConnectionResetError:
        return b""


class CameraServer:
    """One camera with a trigger input, `edge(t_ns)`."""

    def __init__(
        self,
        reactor: Reactor,
        settings: Settings,
        *,
        path: Path,
        frame_format: dict[str, Any],
        surroundings: Surroundings,
    ) -> None:
        self._reactor, self._settings, self._format = reactor, settings, frame_format
        self._body = CameraBody(reactor, settings, self, surroundings)
        self.edge, self.ready = self._body.edge, self._body.ready
        self.lose_frames, self.ignore_edges = self._body.lose_frames, self._body.ignore_edges
        self._shape = (frame_format["height_px"], frame_format["width_px"])
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(path))
        self._listener.listen(4)
        self._control: socket.socket | None = None
        self._stream: socket.socket | None = None
        self._memory: mmap.mmap | None = None
        self._memory_fd = -1
        self._generation = self._session = 0
        self._frames: list[NDArray[np.uint16]] = []
        self._free: deque[int] = deque()
        self._counted_before = dict(self._body.counters)
        reactor.add_reader(self._listener, self._accept)

    @property
    def is_armed(self) -> bool:
        return self._body.armed

    # -- the wire (see sim.devices.camera_body.Wire) --------------------------------------------------------------

    def claim(self) -> int | None:
        """Return a slot. If no slot is free, the world pauses until the host returns one. So the host's load has
        no effect on the simulated camera."""
        patience_end = time.monotonic() + _HOST_PATIENCE_S
        while not self._free and self._stream is not None and time.monotonic() < patience_end:
            self._body.deliver()
            if self._stream is not None and self._reactor.hold_for(self._stream, _HOST_NAP_S):
                self._take_slots_back()
        return self._free.popleft() if self._free else None

    def pixels(self, slot: int) -> NDArray[np.uint16]:
        return self._frames[slot]

    def send(self, shot: Shot) -> bool:
        if self._stream is None:
            return False
        try:
            self._stream.send(FRAME_MESSAGE.pack(shot.slot, shot.frame_id, shot.timestamp_ns, shot.is_rendered))
        except BlockingIOError:
            self._reactor.after(1e-3, self._body.deliver)
            return False
        except OSError:
            self._drop_stream()
            return False
        return True

    # -- the client ---------------------------------------------------------------------------------------

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:  # it has left already
            return
        client.setblocking(False)
        self._reactor.add_reader(client, lambda: self._welcome(client))

    def _welcome(self, client: socket.socket) -> None:
        """Handle the first message of a new client."""
        self._reactor.remove_reader(client)
        purpose = _receive_message(client, 64)
        if purpose == b"control" and self._control is None:
            self._control = client
            self._reactor.add_reader(client, self._on_command)
        elif purpose == b"frames" and self._stream is None:
            self._stream = client
            self._reactor.add_reader(client, self._take_slots_back)
        else:
            with contextlib.suppress(OSError):
                client.send(b'{"error": "the camera is in use by another client"}')
            client.close()
            return
        with contextlib.suppress(OSError):
            client.send(b"{}")

    def _on_command(self) -> None:
        assert self._control is not None
        data = _receive_message(self._control, 4096)
        if not data:
            self._drop_control()
            return
        try:
            self._control.send(json.dumps(self._answer(data)).encode())
        except OSError:  # it is gone, or reads nothing
            self._drop_control()

    def _answer(self, data: bytes) -> dict[str, Any]:
        """Obey the client's command. Data that are not a command are answered with an error."""
        try:
            command = _COMMAND.validate_json(data)
        except ValidationError as error:
            return {"error": str(error)}
        match command:
            case _Configure():
                return self._configure(command)
            case _Arm():
                return self._arm(command.buffers)
            case _Plain():
                reply: dict[str, Any] = getattr(self, f"_do_{command.do}")()
                return reply

    def _configure(self, command: _Configure) -> dict[str, Any]:
        self._body.exposure_ns, self._body.hardware = command.exposure_us * 1000, command.hardware_trigger
        self._body.gain = 10.0 ** (command.gain_db / 20.0)
        return self._format

    def _do_limits(self) -> dict[str, Any]:
        return {"readout_us": math.ceil(self._body.readout_ns / 1e3), "exposure_gap_us": self._body.gap_ns // 1000}

    def _arm(self, buffers: int) -> dict[str, Any]:
        self._end_session()
        self._allocate(max(buffers, self._settings.slots))
        self._counted_before = dict(self._body.counters)
        self._body.arm()
        return {"slots": len(self._frames), "session": self._session % 65536, "memory": self._generation}

    def _do_memory(self) -> dict[str, Any]:
        """Send the ring's file descriptor before the reply."""
        assert self._control is not None
        if self._memory_fd < 0:
            return {"error": "the camera was never armed"}
        socket.send_fds(self._control, [b"memory"], [self._memory_fd])
        return {}

    def _do_trigger(self) -> dict[str, Any]:
        if not self._body.armed or self._body.hardware:
            return {"error": "software trigger on a camera that is not armed for it"}
        self._body.expose(self._reactor.now_ns)
        return {}

    def _do_statistics(self) -> dict[str, Any]:
        """Counts since the camera was armed."""
        return {name: count - self._counted_before[name] for name, count in self._body.counters.items()}

    def _do_disarm(self) -> dict[str, Any]:
        self._end_session()
        return {}

    def _end_session(self) -> None:
        self._body.disarm()
        self._session += 1
        self._free = deque(range(len(self._frames)))

    def _allocate(self, slots: int) -> None:
        frame_bytes = self._shape[0] * self._shape[1] * 2
        pitch = -(-frame_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
        if self._memory is None or len(self._frames) < slots:
            self._frames = []
            self._body.pictured.clear()
            if self._memory_fd >= 0:
                os.close(self._memory_fd)
            self._generation += 1
            self._memory_fd = os.memfd_create("camera-ring")
            os.ftruncate(self._memory_fd, slots * pitch)
            self._memory = mmap.mmap(self._memory_fd, slots * pitch)
            self._frames = [
                np.frombuffer(self._memory, np.uint16, frame_bytes // 2, k * pitch).reshape(self._shape)
                for k in range(slots)
            ]
        self._free = deque(range(len(self._frames)))

    def _take_slots_back(self) -> None:
        while self._stream is not None:
            try:
                data = _receive_message(self._stream, SLOT_MESSAGE.size)
            except BlockingIOError:
                return
            if not data:
                self._drop_stream()
                return
            if len(data) != SLOT_MESSAGE.size:
                continue
            slot, session = divmod(SLOT_MESSAGE.unpack(data)[0], 65536)
            if session == self._session % 65536 and slot < len(self._frames) and slot not in self._free:
                self._free.append(slot)

    def _drop_stream(self) -> None:
        if self._stream is not None:
            self._reactor.remove_reader(self._stream)
            self._stream.close()
            self._stream = None

    def _drop_control(self) -> None:
        """Disarm the camera, because the client is gone."""
        self._end_session()
        self._drop_stream()
        if self._control is not None:
            self._reactor.remove_reader(self._control)
            self._control.close()
            self._control = None

    def unplug(self) -> None:
        """Unplug the cable: the client is dropped, and no other client can connect."""
        self._drop_control()
        self._reactor.remove_reader(self._listener)
        self._listener.close()

    def close(self) -> None:
        self._body.close()
        for link in (self._listener, self._control, self._stream):
            if link is not None:
                link.close()
        if self._memory_fd >= 0:
            os.close(self._memory_fd)
            self._memory_fd = -1
