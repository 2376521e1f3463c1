"""The simulated GigE Vision camera on loopback. Sensor and trigger input are here; control and stream are in
another process.

That process (`gige_server`) speaks GVCP and GVSP with any client, and holds the registers, which both processes
can read. That process may die, as a camera may, without harm to the world. Exposure, trigger and picture are
simulated here (`camera_body`, `camera_picture`). Written registers are polled at every edge, and every few
milliseconds of world time. While the link is busy, the world pauses.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import socket
import subprocess
import sys
import time
from collections import deque
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from coupole.errors import DeviceRefused, DeviceTimeout
from sim.devices import camera_body, gige_server
from sim.devices import gige_registers as reg
from sim.devices.camera_body import CameraBody, Shot, Surroundings, Triggering
from sim.devices.camera_picture import PictureSettings, read_out
from sim.devices.gige_pixels import encode
from sim.world.reactor import Reactor

_SLOTS, _WIRE_SLOTS = 6, 2
"""Frames of the sensor, and encoded images."""
_LOOK_S, _LOOK_FOR_TRIGGERS_S = 0.01, 0.001
_START_S, _PATIENCE_S, _NAP_S = 30.0, 30.0, 0.001
_PULSE_NS = 50_000
"""Length of the box's trigger pulses, for exposures as long as the trigger."""
_PIXEL_FORMAT = {("GBRG", 12): 0x01100012, ("MONO", 12): 0x01100005, ("MONO", 8): 0x01080001}
_BIG_ENDIAN = 1 << 31
_STANDARD_1_2 = 0x0001_0002
_WRITES_MEMORY_AND_CONCATENATES = 0b11
_TICKS_HZ = 1_000_000_000
_ROOT = Path(__file__).parents[2]


class Settings(camera_body.Settings):
    """Properties of the simulated camera."""

    kind: Literal["gige"] = "gige"
    address: str = "127.0.0.1"
    """An address of the loopback interface. Each camera needs its own: the port (3956) is fixed."""
    serial: Annotated[str, Field(pattern=r"^[\w-]{1,15}$")] = "SIM-1"
    first_frame_id: Annotated[int, Field(ge=1, le=65535)] = 65_401
    """First frame id. It is near the last id, so that frame ids wrap in every longer run."""
    lost_packets: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Fraction of stream packets that are lost on the wire."""
    link_mb_per_s: Annotated[float, Field(gt=0)] = 1_000.0
    """Data rate of the wire, by the machine's clock. The world pauses while the wire is busy."""
    temperature_c: float = 41.5


class GigeCamera:
    """One camera with a trigger input, `edge(t_ns)`."""

    def __init__(
        self,
        reactor: Reactor,
        settings: Settings,
        *,
        frame_format: dict[str, Any],
        surroundings: Surroundings,
    ) -> None:
        self._reactor, self._settings, self._bit_depth = reactor, settings, frame_format["bit_depth"]
        self._body = CameraBody(reactor, settings, self, surroundings)
        self.lose_frames, self.ignore_edges = self._body.lose_frames, self._body.ignore_edges
        shape = (frame_format["height_px"], frame_format["width_px"])
        self._frames = [np.zeros(shape, np.uint16) for _ in range(_SLOTS)]
        self._free = deque(range(_SLOTS))
        self._slot_bytes = 2 * shape[0] * shape[1]
        self._free_on_wire = deque(range(_WIRE_SLOTS))
        self._session = self._triggers = 0
        memory_bytes = reg.REGISTER_BYTES + _WIRE_SLOTS * self._slot_bytes
        memory_fd = os.memfd_create("gige-camera")
        try:
            os.ftruncate(memory_fd, memory_bytes)
            self._memory = memoryview(mmap.mmap(memory_fd, memory_bytes))
            self._registers = reg.Registers(self._memory)
            self._set_registers(frame_format)
            self._link: socket.socket | None = None
            self._process = self._power_on(memory_fd)
        finally:
            os.close(memory_fd)
        self.lose_packets(settings.lost_packets)
        self._look_again()

    # -- power --------------------------------------------------------------------------------------------

    def _power_on(self, memory_fd: int) -> subprocess.Popen[bytes]:
        """Start the camera's process. Raises DeviceRefused if its address is not available."""
        settings = self._settings
        own_socket, process_socket = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        start = gige_server.Start(
            settings.address,
            process_socket.fileno(),
            memory_fd,
            self._slot_bytes,
            _WIRE_SLOTS,
            settings.link_mb_per_s,
        )
        with process_socket:
            process = subprocess.Popen(
                [sys.executable, "-S", "-m", gige_server.__name__, start.json()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(process_socket.fileno(), memory_fd),
                env={**os.environ, "PYTHONPATH": str(_ROOT)},
            )
        own_socket.settimeout(_START_S)
        try:
            message = own_socket.recv(1024).decode() or "its process ended"
        except TimeoutError:
            message = f"its process did not start within {_START_S:g} s"
        if message != "ready":
            own_socket.close()
            process.kill()
            process.wait()
            raise DeviceRefused(
                "world",
                expected=f"UDP port {gige_server.PORT} of {settings.address} for the simulated GigE Vision camera",
                happened=f"it could not be bound ({message})",
                remedy="End the other world that serves a camera there, or give `world.settings.camera.address` "
                "another address of the loopback interface.",
            )
        own_socket.setblocking(False)
        self._link = own_socket
        self._reactor.add_reader(own_socket, self._listen)
        return process

    def _set_registers(self, frame_format: dict[str, Any]) -> None:
        registers, height, width = self._registers, frame_format["height_px"], frame_format["width_px"]
        registers.write(reg.ADDRESS, socket.inet_aton(self._settings.address))
        registers.set_text(reg.VENDOR, "Coupole")
        registers.set_text(reg.MODEL, "DomeCamera")
        registers.set_text(reg.VERSION, "1")
        registers.set_text(reg.SERIAL, self._settings.serial, 16)
        for address, number in (
            (reg.VERSION_OF_STANDARD, _STANDARD_1_2),
            (reg.DEVICE_MODE, _BIG_ENDIAN | 1),
            (reg.INTERFACES, 1),
            (reg.STREAMS, 1),
            (reg.CAPABILITIES, _WRITES_MEMORY_AND_CONCATENATES),
            (reg.HEARTBEAT_MS, 3000),
            (reg.TICKS_HZ_LOW, _TICKS_HZ),
            (reg.PACKET_SIZE, 1500),
            (reg.SENSOR_WIDTH, width),
            (reg.SENSOR_HEIGHT, height),
            (reg.WIDTH, width),
            (reg.HEIGHT, height),
            (reg.PIXEL_FORMAT, _PIXEL_FORMAT.get((frame_format["bayer_pattern"], self._bit_depth), 0x01100012)),
            *((factor, 1) for factor in (reg.BINNING_X, reg.BINNING_Y, reg.DECIMATION_X, reg.DECIMATION_Y)),
            (reg.ACQUISITION_MODE, reg.CONTINUOUS),
            (reg.FRAME_COUNT, 1),
            (reg.TRIGGER_SELECTOR, reg.FRAME_START),
            (reg.TRIGGER_OVERLAP, reg.OVERLAP_READ_OUT),
            (reg.TRIGGER_DIVIDER, 1),
        ):
            registers.set_integer(address, number)
        fastest_hz = 1e9 / self._body.readout_ns
        for address, real in (
            (reg.TEMPERATURE_C, self._settings.temperature_c),
            (reg.FRAME_RATE_HZ, min(25.0, fastest_hz)),
            (reg.FRAME_RATE_MAX_HZ, fastest_hz),
            (reg.EXPOSURE_US, self._body.exposure_ns / 1e3),
            (reg.READOUT_US, self._body.readout_ns / 1e3),
            (reg.BLACK_LEVEL_DN, frame_format["black_dn"]),
            (reg.GAMMA, 1.0),
            (reg.BALANCE_RATIO, 1.0),
            (reg.BALANCE_RATIO + 8, 1.0),
        ):
            registers.set_real(address, real)

    def unplug(self) -> None:
        """Unplug the cable: the camera no longer answers."""
        self._body.disarm()
        if self._link is not None:
            link, self._link = self._link, None
            self._reactor.remove_reader(link)
            link.close()
            self._process.kill()
            self._process.wait()

    def close(self) -> None:
        self.unplug()
        self._body.close()

    @property
    def pid(self) -> int:
        """Process that speaks with clients."""
        return self._process.pid

    # -- faults -------------------------------------------------------------------------------------------

    def lose_packets(self, ratio: float) -> None:
        """Lose this fraction of stream packets on the wire from now on."""
        self._tell(gige_server.LOSE_PACKETS.pack(gige_server.DOES_LOSE_PACKETS, ratio))

    def lose_control(self) -> None:
        """The camera drops its controlling client, as after a brown-out, and stops."""
        self._tell(gige_server.LOSE_CONTROL.pack(gige_server.DOES_LOSE_CONTROL))

    # -- the trigger cable --------------------------------------------------------------------------------

    def edge(self, t_ns: int) -> None:
        """A rising edge on the trigger line at world time `t_ns`."""
        self._look()
        self._body.edge(t_ns)
        self._show_counters()

    def ready(self) -> bool:
        """The exposure-ready line: an edge now would start an exposure."""
        self._look()
        return self._body.ready()

    @property
    def is_armed(self) -> bool:
        return self._body.armed

    # -- what the client wrote ----------------------------------------------------------------------------

    def _look_again(self) -> None:
        self._look()
        by_software = self._body.armed and not self._body.hardware
        self._reactor.after(_LOOK_FOR_TRIGGERS_S if by_software else _LOOK_S, self._look_again)

    def _look(self) -> None:
        """Read the registers written by the client and act on them."""
        if self._link is None:
            return
        registers, body = self._registers, self._body
        session = registers.integer(reg.SESSION)
        if session != self._session:
            self._session = session
            body.disarm()
            self._free = deque(range(_SLOTS))
        triggers, before = registers.integer(reg.TRIGGERS), self._triggers
        self._triggers = triggers
        if not session:
            return
        source = registers.integer(reg.TRIGGER_SOURCE + 4)
        trigger_is_on = registers.integer(reg.TRIGGER_MODE + 4) != 0
        body.exposure_ns, body.gain = self._exposure()
        body.triggering = self._triggering()
        body.hardware = trigger_is_on and source == reg.LINE0
        if not body.armed:
            body.arm()
            if not trigger_is_on:
                self._run_free(session)
        if trigger_is_on and source == reg.SOFTWARE:
            for _ in range((triggers - before) % 2**32):
                body.expose(self._reactor.now_ns)
            self._show_counters()

    def _exposure(self) -> tuple[int, float]:
        """Return the exposure time in ns, and the gain as a factor. Automatic values are twice the set ones."""
        registers = self._registers
        exposure_ns = round(registers.real(reg.EXPOSURE_US) * 1e3)
        exposure_ns *= 1 + bool(registers.integer(reg.EXPOSURE_AUTO))
        if registers.integer(reg.EXPOSURE_MODE) == reg.TRIGGER_WIDTH:
            exposure_ns = _PULSE_NS
        gain_db = registers.real(reg.GAIN_DB) + registers.real(reg.GAIN_DB + 8)
        return exposure_ns, 10.0 ** (gain_db / 20.0) * (1 + bool(registers.integer(reg.GAIN_AUTO)))

    def _triggering(self) -> Triggering:
        registers = self._registers
        mode = registers.integer(reg.ACQUISITION_MODE)
        waits = registers.integer(reg.TRIGGER_MODE) and registers.integer(reg.TRIGGER_SOURCE) == reg.LINE0
        at_end = registers.integer(reg.TRIGGER_ACTIVATION) != registers.integer(reg.LINE_INVERTER)
        has_rate_limit = registers.integer(reg.FRAME_RATE_ENABLE)
        frames = {reg.SINGLE_FRAME: 1, reg.MULTI_FRAME: registers.integer(reg.FRAME_COUNT)}
        return Triggering(
            delay_ns=round(registers.real(reg.TRIGGER_DELAY_US) * 1e3) + _PULSE_NS * at_end,
            divider=registers.integer(reg.TRIGGER_DIVIDER),
            latches=registers.integer(reg.TRIGGER_OVERLAP) == reg.OVERLAP_PREVIOUS_FRAME,
            least_period_ns=round(1e9 / registers.real(reg.FRAME_RATE_HZ)) if has_rate_limit else 0,
            most_frames=frames.get(mode, 0),
            edges_to_start=int(bool(waits)),
        )

    def _run_free(self, session: int) -> None:
        """Expose at the camera's frame rate, while trigger mode is off."""
        if self._link is None or session != self._session:
            return
        self._body.expose(self._reactor.now_ns)
        self._show_counters()
        self._reactor.after(1.0 / self._registers.real(reg.FRAME_RATE_HZ), lambda: self._run_free(session))

    def _show_counters(self) -> None:
        self._registers.set_integer(reg.EXPOSED, self._body.counters["exposed"])
        self._registers.set_integer(reg.OVER_TRIGGERS, self._body.counters["over_triggers"])

    # -- the wire (see sim.devices.camera_body.Wire) --------------------------------------------------------------

    def claim(self) -> int | None:
        """Return a slot. If no slot is free, the world pauses until the link has taken a frame."""
        patience_end_s = time.monotonic() + _PATIENCE_S
        while not self._free and self._body.armed and time.monotonic() < patience_end_s:
            self._body.deliver()
            self._await_link()
        return self._free.popleft() if self._free else None

    def pixels(self, slot: int) -> NDArray[np.uint16]:
        return self._frames[slot]

    def send(self, shot: Shot) -> bool:
        """Encode a frame, and pass it to the camera's process as soon as this process has room for an image."""
        patience_end_s = time.monotonic() + _PATIENCE_S
        while not self._free_on_wire:
            self._look()
            if not self._body.armed:
                return False
            if time.monotonic() > patience_end_s:
                raise DeviceTimeout(
                    "world",
                    expected=f"the simulated camera's process to send a frame within {_PATIENCE_S:g} s",
                    happened="it did not begin to",
                    remedy="Start the world again.",
                )
            self._await_link()
        if self._link is None:
            return False
        picture, pixel_format = self._picture(), self._registers.integer(reg.PIXEL_FORMAT)
        image = read_out(self._frames[shot.slot], picture, (1 << self._bit_depth) - 1)
        self._free.append(shot.slot)
        if image.shape != (picture.height_px, picture.width_px):
            return True  # a client stopped the camera and changed the image while this looked
        size = image.size * (pixel_format >> 16 & 0xFF) // 8
        slot = self._free_on_wire.popleft()
        out = np.frombuffer(self._memory, np.uint8, size, reg.REGISTER_BYTES + slot * self._slot_bytes)
        encode(out, image, pixel_format, self._bit_depth)
        region = (picture.width_px, picture.height_px, picture.left_px, picture.top_px)
        self._tell(
            gige_server.SEND.pack(
                gige_server.DOES_SEND,
                slot,
                self._session,
                shot.frame_id,
                shot.timestamp_ns,
                *region,
                pixel_format,
                size,
            )
        )
        return True

    def _picture(self) -> PictureSettings:
        integer, real = self._registers.integer, self._registers.real
        return PictureSettings(
            left_px=integer(reg.OFFSET_X),
            top_px=integer(reg.OFFSET_Y),
            width_px=integer(reg.WIDTH),
            height_px=integer(reg.HEIGHT),
            binning=(integer(reg.BINNING_X), integer(reg.BINNING_Y)),
            decimation=(integer(reg.DECIMATION_X), integer(reg.DECIMATION_Y)),
            mirror_axes=(bool(integer(reg.REVERSE_X)), bool(integer(reg.REVERSE_Y))),
            gamma=real(reg.GAMMA) if integer(reg.GAMMA_ENABLE) else 1.0,
            inverts=bool(integer(reg.LUT_ENABLE)),
            balance=(real(reg.BALANCE_RATIO), real(reg.BALANCE_RATIO + 8)),
            test_pattern=bool(integer(reg.TEST_PATTERN)),
        )

    def _await_link(self) -> None:
        if self._link is not None and select.select([self._link], [], [], _NAP_S)[0]:
            self._listen()

    def _tell(self, message: bytes) -> None:
        if self._link is not None:
            with contextlib.suppress(OSError):  # the process is gone: `_listen` learns it
                self._link.send(message)

    def _listen(self) -> None:
        """Take back the slots of images that were sent. If the camera's process has ended, the camera is gone."""
        while self._link is not None:
            try:
                message = self._link.recv(gige_server.SENT.size)
            except BlockingIOError:
                return
            except OSError:
                message = b""
            if not message:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(_START_S)
                self.unplug()
                code = self._process.returncode
                print(f"the simulated GigE Vision camera is gone: its process ended ({code})", file=sys.stderr)
                return
            self._free_on_wire.append(gige_server.SENT.unpack(message)[0])
