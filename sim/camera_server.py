"""The simulated camera, inside the world: edges make exposures, exposures make frames in shared memory.

It keeps the sensor's rules (an edge that comes before the sensor is ready is counted and ignored), its own
clock and its own frame counter. Frames lie in a ring of page-aligned slots; clients are told of them over a
Unix socket and hand the slots back. `sim.memory_camera` is the driver at the other end.
"""

from __future__ import annotations

import contextlib
import json
import math
import mmap
import os
import random
import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from coupole.geometry import Transform
from sim.lighting import Lighting
from sim.reactor import Reactor

FRAME_MESSAGE = struct.Struct("<IQQB")
"""Slot, frame id, timestamp ns, 1 if the frame holds a picture."""
SLOT_MESSAGE = struct.Struct("<I")
_HOST_PATIENCE_S, _HOST_NAP_S = 30.0, 0.005


@dataclass(frozen=True)
class Exposed:
    """What one exposure saw, for the renderer."""

    seconds_of_led: dict[int, float]
    panels: list[int]
    exposure_s: float
    gain: float
    number: int
    """Counts exposures from power-on."""
    base_from_flange: Transform


Render = Callable[[NDArray[np.uint16], Exposed], None]
"""Fill a frame [h, w] with what an exposure saw."""


class Settings(BaseModel):
    """Character of the simulated camera."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    slots: Annotated[int, Field(ge=8)] = 48
    render_every: Annotated[int, Field(ge=0)] = 1
    """Every n-th frame holds a picture, the others none; 0 for none at all (dry runs)."""
    clock_offset_ns: int = 7_777_000_000
    clock_ppm: float = -23.0
    timestamp_jitter_us: float = 2.0
    first_frame_id: Annotated[int, Field(ge=1, le=65535)] = 1
    id_modulus: Annotated[int, Field(ge=0)] = 65535
    """Last frame id; after it comes 1 (GigE Vision 1)."""
    seed: int = 11


@dataclass
class _Shot:
    slot: int
    frame_id: int
    timestamp_ns: int
    deliver_ns: int
    rendered: bool
    ready: bool = False


def _received(client: socket.socket, size: int) -> bytes:
    """The next message, empty if the client is gone: killed with messages unread, it resets the connection."""
    try:
        return client.recv(size)
    except ConnectionResetError:
        return b""


class CameraServer:
    """One camera with a trigger line; `edge(t_ns)` is the cable."""

    def __init__(
        self,
        reactor: Reactor,
        settings: Settings,
        *,
        path: Path,
        frame_format: dict[str, Any],
        readout_us: float,
        exposure_gap_us: float,
        lighting: Lighting,
        pose: Callable[[], Transform],
        render: Render,
    ) -> None:
        self._reactor, self._settings, self._lighting = reactor, settings, lighting
        self._pose, self._render = pose, render
        self._format = frame_format
        self._shape = (frame_format["height_px"], frame_format["width_px"])
        self._readout_ns, self._gap_ns = round(readout_us * 1e3), round(exposure_gap_us * 1e3)
        self._random = random.Random(settings.seed)
        self._workers = ThreadPoolExecutor(1, "render")
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(path))
        self._listener.listen(4)
        self._control: socket.socket | None = None
        self._stream: socket.socket | None = None
        self._memory: mmap.mmap | None = None
        self._memory_fd = -1
        self._generation = 0
        self._frames: list[NDArray[np.uint16]] = []
        self._free: deque[int] = deque()
        self._pending: deque[_Shot] = deque()
        self._armed = self._hardware = False
        self._gain = 1.0
        self._session = 0
        self._exposure_ns = 8_000_000
        self._ready_ns = self._readout_until_ns = 0
        self._frame_id = settings.first_frame_id
        self._number = 0
        self._counters = dict.fromkeys(("exposed", "delivered", "lost_transfers", "over_triggers", "overflows"), 0)
        self.lose_frames: set[int] = set()
        """Numbers of frames (counted from power-on) whose transfer gets lost."""
        self.ignore_edges: set[int] = set()
        """Numbers of edges (counted from power-on) that the camera does not see."""
        self._edge_number = 0
        reactor.add_reader(self._listener, self._accept)

    # -- the cable ----------------------------------------------------------------------------------------

    def edge(self, t_ns: int) -> None:
        """A rising edge on the trigger line at world time `t_ns`."""
        number, self._edge_number = self._edge_number, self._edge_number + 1
        if self._armed and self._hardware and number not in self.ignore_edges:
            self._start_exposure(t_ns)

    def ready(self) -> bool:
        """The exposure-ready line: an edge now would make a frame."""
        return self._armed and self._reactor.now_ns >= self._next_start_ns()

    @property
    def armed(self) -> bool:
        return self._armed

    def _next_start_ns(self) -> int:
        """The next exposure must not end before the last frame is read out (facts/genicam)."""
        return max(self._ready_ns, self._readout_until_ns - self._exposure_ns)

    def _start_exposure(self, t_ns: int) -> None:
        if t_ns < self._next_start_ns():
            self._counters["over_triggers"] += 1
            return
        end_ns = t_ns + self._exposure_ns
        self._ready_ns = end_ns + self._gap_ns
        self._readout_until_ns = end_ns + self._readout_ns
        self._counters["exposed"] += 1
        frame_id = self._frame_id
        self._frame_id = self._frame_id + 1 if self._frame_id != self._settings.id_modulus else 1
        number, self._number = self._number, self._number + 1
        jitter_ns = self._random.gauss(0.0, self._settings.timestamp_jitter_us * 1e3)
        stamp_ns = self._settings.clock_offset_ns + t_ns * (1 + self._settings.clock_ppm * 1e-6) + jitter_ns
        session = self._session
        self._reactor.at(
            end_ns, lambda: self._end_exposure(session, t_ns, end_ns, frame_id, number, int(stamp_ns))
        )

    def _end_exposure(
        self, session: int, start_ns: int, end_ns: int, frame_id: int, number: int, stamp_ns: int
    ) -> None:
        if session != self._session or not self._armed:
            return
        if number in self.lose_frames:
            self._counters["lost_transfers"] += 1
            return
        if not self._free and not self._wait_for_a_slot():
            self._counters["overflows"] += 1
            return
        every = self._settings.render_every
        shot = _Shot(
            self._free.popleft(),
            frame_id,
            stamp_ns,
            end_ns + self._readout_ns,
            every > 0 and number % every == 0,
        )
        self._pending.append(shot)
        if not shot.rendered:
            shot.ready = True
            self._reactor.at(shot.deliver_ns, self._deliver)
            return
        exposed = Exposed(
            self._lighting.exposure_s(start_ns, end_ns),
            self._lighting.panels(start_ns),
            (end_ns - start_ns) / 1e9,
            self._gain,
            number,
            self._pose(),
        )
        self._workers.submit(self._work, shot, exposed)

    def _wait_for_a_slot(self) -> bool:
        """Let the world stand still until the host hands a slot back: its load is no fault of the camera."""
        patience_end = time.monotonic() + _HOST_PATIENCE_S
        while not self._free and self._stream is not None and time.monotonic() < patience_end:
            self._deliver()
            if self._stream is not None and self._reactor.hold_for(self._stream, _HOST_NAP_S):
                self._take_slots_back()
        return bool(self._free)

    def _work(self, shot: _Shot, exposed: Exposed) -> None:
        self._render(self._frames[shot.slot], exposed)
        shot.ready = True
        self._reactor.call_threadsafe(self._deliver)

    def _deliver(self) -> None:
        """Tell the client of finished frames, in order, not before their readout has ended."""
        while self._pending and self._pending[0].ready and self._stream is not None:
            shot = self._pending[0]
            if shot.deliver_ns > self._reactor.now_ns:
                self._reactor.at(shot.deliver_ns, self._deliver)
                return
            try:
                self._stream.send(FRAME_MESSAGE.pack(shot.slot, shot.frame_id, shot.timestamp_ns, shot.rendered))
            except BlockingIOError:
                self._reactor.after(1e-3, self._deliver)
                return
            except OSError:
                self._drop_stream()
                return
            self._pending.popleft()
            self._counters["delivered"] += 1

    # -- the client ---------------------------------------------------------------------------------------

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        purpose = _received(client, 64)
        if purpose == b"control" and self._control is None:
            self._control = client
            self._reactor.add_reader(client, self._on_command)
        elif purpose == b"frames" and self._stream is None:
            client.setblocking(False)
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
        data = _received(self._control, 4096)
        if not data:
            self._drop_control()
            return
        command = json.loads(data)
        try:
            reply: dict[str, Any] = getattr(self, f"_do_{command.pop('do')}")(**command)
            self._control.send(json.dumps(reply).encode())
        except BrokenPipeError:
            self._drop_control()

    def _do_configure(self, exposure_us: int, gain_db: float, hardware_trigger: bool) -> dict[str, Any]:
        self._exposure_ns, self._hardware = exposure_us * 1000, hardware_trigger
        self._gain = 10.0 ** (gain_db / 20.0)
        return self._format

    def _do_limits(self) -> dict[str, Any]:
        return {"readout_us": math.ceil(self._readout_ns / 1e3), "exposure_gap_us": self._gap_ns // 1000}

    def _do_arm(self, buffers: int) -> dict[str, Any]:
        self._end_session()
        self._allocate(max(buffers, self._settings.slots))
        self._counters = dict.fromkeys(self._counters, 0)
        self._ready_ns = self._readout_until_ns = 0
        self._armed = True
        return {"slots": len(self._frames), "session": self._session % 65536, "memory": self._generation}

    def _do_memory(self) -> dict[str, Any]:
        """Sends the ring's file descriptor ahead of the reply."""
        assert self._control is not None
        socket.send_fds(self._control, [b"memory"], [self._memory_fd])
        return {}

    def _do_trigger(self) -> dict[str, Any]:
        if not self._armed or self._hardware:
            return {"error": "software trigger on a camera that is not armed for it"}
        self._start_exposure(self._reactor.now_ns)
        return {}

    def _do_statistics(self) -> dict[str, Any]:
        return dict(self._counters)

    def _do_disarm(self) -> dict[str, Any]:
        self._end_session()
        return {}

    def _end_session(self) -> None:
        self._armed = False
        self._session += 1
        self._workers.submit(lambda: None).result()
        self._pending.clear()
        self._free = deque(range(len(self._frames)))

    def _allocate(self, slots: int) -> None:
        frame_bytes = self._shape[0] * self._shape[1] * 2
        pitch = -(-frame_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
        if self._memory is None or len(self._frames) < slots:
            self._frames = []
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
                data = _received(self._stream, SLOT_MESSAGE.size)
            except BlockingIOError:
                return
            if not data:
                self._drop_stream()
                return
            slot, session = divmod(SLOT_MESSAGE.unpack(data)[0], 65536)
            if session == self._session % 65536:
                self._free.append(slot)

    def _drop_stream(self) -> None:
        if self._stream is not None:
            self._reactor.remove_reader(self._stream)
            self._stream.close()
            self._stream = None

    def _drop_control(self) -> None:
        """The client is gone: a camera without a client disarms itself."""
        self._end_session()
        self._drop_stream()
        if self._control is not None:
            self._reactor.remove_reader(self._control)
            self._control.close()
            self._control = None

    def unplug(self) -> None:
        """The cable is pulled: no client any more, and none can come."""
        self._drop_control()
        self._reactor.remove_reader(self._listener)
        self._listener.close()

    def close(self) -> None:
        self._workers.shutdown(cancel_futures=True)
        for link in (self._listener, self._control, self._stream):
            if link is not None:
                link.close()
        if self._memory_fd >= 0:
            os.close(self._memory_fd)
            self._memory_fd = -1
