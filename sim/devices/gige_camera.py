"""The simulated GigE Vision camera: Aravis's fake camera on loopback, with Coupole's registers and sensor.

Control and stream are real GVCP and GVSP packets, sent by a thread of libaravis. The fake camera has no exposure
timing, overlap or trigger input: those are in `camera_body`. The fake is only told to send single frames, one at a
time, since it would merge several requests. While it or the link is busy, the world pauses. Registers written by
clients are polled: at every edge, and every few milliseconds of world time.
"""

from __future__ import annotations

import ctypes
import threading
import time
from collections import deque
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from coupole.errors import DeviceRefused, DeviceTimeout
from sim.devices import camera_body
from sim.devices import gige_registers as reg
from sim.devices.camera_body import CameraBody, Shot, Surroundings
from sim.devices.gige_pixels import LAYOUTS, encode
from sim.world.reactor import Reactor

_SLOTS = 6
_POLL_HZ = 200.0
"""Rate at which the fake checks whether to send; it busy-waits for 1 ms of each period."""
_LOOK_S, _LOOK_FOR_TRIGGERS_S = 0.01, 0.001
_PATIENCE_S, _NAP_S = 30.0, 0.001
_PIXEL_FORMAT = {("GBRG", 12): 0x01100012, ("MONO", 12): 0x01100005, ("MONO", 8): 0x01080001}


class Settings(camera_body.Settings):
    """Properties of the simulated camera."""

    kind: Literal["gige"] = "gige"
    address: str = "127.0.0.1"
    """GigE Vision fixes the port (3956), so each address has one camera. An address other than 127.0.0.1 must
    first be added to the loopback interface (`ip address add 127.0.0.2/8 dev lo`)."""
    serial: Annotated[str, Field(pattern=r"^[\w-]{1,15}$")] = "SIM-1"
    first_frame_id: Annotated[int, Field(ge=1, le=65535)] = 65_401
    """Near the last id, so that frame ids wrap in every longer run."""
    lost_packets: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Fraction of stream packets that are lost on the wire."""
    link_mb_per_s: Annotated[float, Field(gt=0)] = 1_000.0
    """Rate of the wire in machine time; the world pauses for it."""
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
        self._handed: Shot | None = None
        """The frame that the fake camera was told to send and has not begun to send."""
        self._handing = threading.Lock()
        self._taken = threading.Event()
        self._link_free_s = 0.0
        """Machine time at which the wire has carried the last frame."""
        self._session = self._triggers = self._payload_bytes = 0
        self._library = reg.load_library()
        self._fill = reg.FILL(self._on_fill)  # libaravis keeps no reference
        self._camera: int | None = self._power_on()
        self._registers = reg.Registers(
            self._library, self._library.arv_gv_fake_camera_get_fake_camera(self._camera)
        )
        self._set_registers(frame_format)
        self.lose_packets(settings.lost_packets)
        self._look_again()

    # -- power --------------------------------------------------------------------------------------------

    def _power_on(self) -> int:
        address, serial = self._settings.address, self._settings.serial
        camera: int = self._library.arv_gv_fake_camera_new_full(
            address.encode(), serial.encode(), str(reg.DESCRIPTION).encode()
        )
        if not self._library.arv_gv_fake_camera_is_running(camera):
            self._library.g_object_unref(camera)
            raise DeviceRefused(
                "world",
                expected=f"UDP port 3956 of {address} for the simulated GigE Vision camera",
                happened="it could not be bound",
                remedy="End the other world that serves a camera there, or give `world.settings.camera.address` "
                "another address of the loopback interface.",
            )
        fake = self._library.arv_gv_fake_camera_get_fake_camera(camera)
        self._library.arv_fake_camera_set_fill_pattern(fake, self._fill, None)
        self._library.arv_fake_camera_set_trigger_frequency(fake, _POLL_HZ)
        return camera

    def _set_registers(self, frame_format: dict[str, Any]) -> None:
        registers, height, width = self._registers, frame_format["height_px"], frame_format["width_px"]
        registers.set_text(reg.VENDOR, "Coupole")
        registers.set_text(reg.MODEL, "DomeCamera")
        registers.set_text(reg.VERSION, "1")
        for address, number in (
            (reg.SENSOR_WIDTH, width),
            (reg.SENSOR_HEIGHT, height),
            (reg.WIDTH, width),
            (reg.HEIGHT, height),
            (reg.PIXEL_FORMAT, _PIXEL_FORMAT.get((frame_format["bayer_pattern"], self._bit_depth), 0x01100012)),
            (reg.FAKE_TRIGGER_MODE, 1),
            (reg.FAKE_TRIGGER_SOURCE, 1),
            (reg.NEXT_SESSION, 1),
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
        ):
            registers.set_real(address, real)

    def unplug(self) -> None:
        """Unplug the cable: the camera no longer answers."""
        self._body.disarm()
        if self._camera is not None:
            camera, self._camera = self._camera, None
            self._library.g_object_unref(camera)

    def close(self) -> None:
        self.unplug()
        self._body.close()

    # -- faults -------------------------------------------------------------------------------------------

    def lose_packets(self, ratio: float) -> None:
        """From now on this fraction of stream packets is lost on the wire."""
        if self._camera is not None:
            reg.set_double_property(self._library, self._camera, "gvsp-lost-ratio", ratio)

    def lose_control(self) -> None:
        """The camera drops its controlling client, as after a brown-out, and stops."""
        if self._camera is not None:
            self._registers.set_integer(reg.ACQUISITION, 0)
            self._registers.set_integer(reg.CONTROL_PRIVILEGE, 0)
            self._look()

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
    def armed(self) -> bool:
        return self._body.armed

    # -- what the client wrote ----------------------------------------------------------------------------

    def _look_again(self) -> None:
        self._look()
        by_software = self._body.armed and not self._body.hardware
        self._reactor.after(_LOOK_FOR_TRIGGERS_S if by_software else _LOOK_S, self._look_again)

    def _look(self) -> None:
        """Read the registers written by the client and act on them."""
        if self._camera is None:
            return
        registers = self._registers
        controlled = registers.integer(reg.CONTROL_PRIVILEGE) != 0
        session = registers.integer(reg.ACQUISITION) if controlled else 0
        if session != self._session:
            self._change_session(session)
        triggers, before = registers.integer(reg.TRIGGERS), self._triggers
        self._triggers = triggers
        if not session:
            return
        self._body.exposure_ns = round(registers.real(reg.EXPOSURE_US) * 1e3)
        self._body.gain = 10.0 ** (registers.real(reg.GAIN_DB) / 20.0)
        triggered = registers.integer(reg.TRIGGER_MODE) != 0
        source = registers.integer(reg.TRIGGER_SOURCE)
        self._body.hardware = triggered and source == reg.LINE0
        if triggered and source == reg.SOFTWARE:
            for _ in range((triggers - before) % 2**32):
                self._body.expose(self._reactor.now_ns)
            self._show_counters()

    def _change_session(self, session: int) -> None:
        self._session = session
        self._body.disarm()
        with self._handing:
            self._registers.set_integer(reg.FAKE_TRIGGER, 0)
            self._handed, self._free = None, deque(range(_SLOTS))
        if session:
            self._registers.set_integer(reg.NEXT_SESSION, session % 0xFFFF + 1)
            self._payload_bytes = self._registers.payload_bytes()
            self._body.arm()
            if not self._registers.integer(reg.TRIGGER_MODE):
                self._run_free(session)

    def _run_free(self, session: int) -> None:
        """With trigger mode off, the camera exposes at its frame rate."""
        if self._camera is None or session != self._session:
            return
        self._body.expose(self._reactor.now_ns)
        self._show_counters()
        self._reactor.after(1.0 / self._registers.real(reg.FRAME_RATE_HZ), lambda: self._run_free(session))

    def _show_counters(self) -> None:
        if self._camera is not None:
            self._registers.set_integer(reg.EXPOSED, self._body.counters["exposed"])
            self._registers.set_integer(reg.OVER_TRIGGERS, self._body.counters["over_triggers"])

    # -- the wire (see sim.devices.camera_body.Wire) --------------------------------------------------------------

    def claim(self) -> int | None:
        """A slot. If none is free the world pauses until the fake has begun to send."""
        patience_end_s = time.monotonic() + _PATIENCE_S
        while not self._free and self._body.armed and time.monotonic() < patience_end_s:
            self._body.deliver()
            self._nap()
        return self._free.popleft() if self._free else None

    def pixels(self, slot: int) -> NDArray[np.uint16]:
        return self._frames[slot]

    def send(self, shot: Shot) -> bool:
        """Tell the fake to send, once it has begun to send the last frame and the wire has carried that."""
        patience_end_s = time.monotonic() + _PATIENCE_S
        while self._handed is not None or time.monotonic() < self._link_free_s:
            self._look()
            if not self._body.armed:
                return False
            if time.monotonic() > patience_end_s:
                raise DeviceTimeout(
                    "world",
                    expected=f"libaravis's fake camera to send a frame within {_PATIENCE_S:g} s",
                    happened="it did not begin to",
                    remedy="Start the world again.",
                )
            self._nap()
        with self._handing:
            self._handed = shot
            self._registers.set_integer(reg.FAKE_TRIGGER, 1)
        return True

    def _nap(self) -> None:
        self._taken.clear()
        self._taken.wait(_NAP_S)

    def _on_fill(self, buffer: int, _data: int, _exposure_us: int, _gain: int, pixel_format: int) -> None:
        """Called by the fake camera, on its own thread, for the frame to send next."""
        with self._handing:
            shot, self._handed = self._handed, None
            if shot is None:
                return
            # If a client changes the format during a transfer, the old frame is not encoded: no buffer overflow.
            if self._payload_bytes == self._registers.payload_bytes() and pixel_format in LAYOUTS:
                address = self._library.arv_buffer_get_data(buffer, None)
                out = np.ctypeslib.as_array((ctypes.c_uint8 * self._payload_bytes).from_address(address))
                encode(out, self._region(self._frames[shot.slot]), pixel_format, self._bit_depth)
            self._library.arv_buffer_set_frame_id(buffer, shot.frame_id)
            self._library.arv_buffer_set_timestamp(buffer, shot.timestamp_ns)
            self._link_free_s = time.monotonic() + self._payload_bytes / (self._settings.link_mb_per_s * 1e6)
            self._free.append(shot.slot)
        self._taken.set()

    def _region(self, frame: NDArray[np.uint16]) -> NDArray[np.uint16]:
        registers = self._registers
        left, top = registers.integer(reg.OFFSET_X), registers.integer(reg.OFFSET_Y)
        return frame[top : top + registers.integer(reg.HEIGHT), left : left + registers.integer(reg.WIDTH)]
