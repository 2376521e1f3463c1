"""The camera behind the GenTL producer of the tests; runs in a process of its own.

It must: genicam keeps all of Python waiting while the producer asks the camera something.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections import deque
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from camera_world import fire, flat, in_world, ramp, sensor
from numpy.typing import NDArray

from sim.devices import camera_body
from sim.devices.camera_body import CameraBody, Shot, Surroundings, Triggering
from sim.devices.camera_picture import PictureSettings, read_out
from sim.devices.gige_pixels import encode
from sim.world.clock import ClockWriter
from sim.world.reactor import Reactor

DESCRIPTION_FILE = Path(__file__).with_name("gentl_producer") / "camera.xml"
TEXT_BYTES, TEXTS_BYTES = 32, 160
DESCRIPTION, DESCRIPTION_PLACE = 0x10000, 0xA0
WIDTH, HEIGHT, OFFSET_X, OFFSET_Y = 0x100, 0x108, 0x110, 0x118
SENSOR_WIDTH, SENSOR_HEIGHT, PIXEL_FORMAT, ACQUISITION = 0x120, 0x128, 0x130, 0x138
TRIGGER_SOFTWARE, EXPOSED, OVER_TRIGGERS, EXPOSURE_AUTO = 0x150, 0x168, 0x170, 0x178
START_TRIGGER_MODE, START_TRIGGER_SOURCE = 0x180, 0x188
"""Those of AcquisitionStart."""
TRIGGER_MODE, TRIGGER_SOURCE = 0x190, 0x198
"""Those of FrameStart."""
EXPOSURE_US, BLACK_LEVEL_DN, READOUT_US, TEMPERATURE_C = 0x200, 0x210, 0x218, 0x220
TRIGGER_DELAY_US, GAMMA, BALANCE_RED, BALANCE_BLUE = 0x228, 0x230, 0x238, 0x240
ANALOG_GAIN_DB, DIGITAL_GAIN_DB = 0x248, 0x250
BINNING_X, BINNING_Y, DECIMATION_X, DECIMATION_Y = 0x300, 0x308, 0x310, 0x318
REVERSE_X, REVERSE_Y, TEST_PATTERN, ACQUISITION_MODE = 0x320, 0x328, 0x330, 0x338
FRAME_COUNT, FRAME_RATE_ENABLE, EXPOSURE_MODE, GAIN_AUTO = 0x340, 0x348, 0x350, 0x358
GAMMA_ENABLE, LUT_ENABLE, LINE_INVERTER = 0x368, 0x370, 0x380
TRIGGER_ACTIVATION, TRIGGER_OVERLAP, TRIGGER_DIVIDER = 0x388, 0x390, 0x398
REGISTER_BYTES = 0x400
"""Registers are 64-bit, little-endian; floats from EXPOSURE_US on. They stand in camera.xml too."""
LINE0, SOFTWARE = 0, 2
CONTINUOUS, SINGLE_FRAME, PREVIOUS_FRAME = 1, 2, 2
PULSE_NS = 50_000
SLOWED_NS = 40_000_000
"""Period of frames while the frame rate is limited."""
BAYER_GB12 = 0x01100012
REFUSED_ADDRESS = -1015
"""GC_ERR_INVALID_ADDRESS."""

IDENTITY = struct.Struct(f"<Qc{TEXTS_BYTES}s")
REQUEST = struct.Struct("<IIQ")
HEAD = struct.Struct("<QQIIIIII")
"""Frame id, timestamp in ticks, width, height, left, top, pixel format, bytes of the whole image."""
_MOST_BYTES = 70_000
_SLOTS = 64


class StandIn:
    """One camera on its cable (see gentl_producer/cable.c). It knows triggered exposures only."""

    def __init__(
        self,
        reactor: Reactor,
        settings: camera_body.Settings,
        *,
        path: Path,
        tl_type: str,
        ticks_hz: int,
        frame_format: dict[str, Any],
        surroundings: Surroundings,
    ) -> None:
        self._reactor, self._path, self._ticks_hz = reactor, path, ticks_hz
        self._depth = frame_format["bit_depth"]
        self.body = CameraBody(reactor, settings, self, surroundings)
        self.torn: set[int] = set()
        """Ids of frames that arrive without their lower half."""
        height_px, width_px = frame_format["height_px"], frame_format["width_px"]
        self._frames = np.zeros((_SLOTS, height_px, width_px), np.uint16)
        self._free = deque(range(_SLOTS))
        self._description = DESCRIPTION_FILE.read_bytes()
        self._registers = bytearray(REGISTER_BYTES)
        texts = (tl_type, "Coupole", "Stand-in", path.stem, "1.0")
        for number, text in enumerate(texts):
            struct.pack_into(f"{TEXT_BYTES}s", self._registers, number * TEXT_BYTES, text.encode())
        struct.pack_into("<QQ", self._registers, DESCRIPTION_PLACE, DESCRIPTION, len(self._description))
        for address, value in (
            (WIDTH, width_px),
            (HEIGHT, height_px),
            (SENSOR_WIDTH, width_px),
            (SENSOR_HEIGHT, height_px),
            (PIXEL_FORMAT, BAYER_GB12),
            (EXPOSURE_AUTO, 2),
            *((factor, 1) for factor in (BINNING_X, BINNING_Y, DECIMATION_X, DECIMATION_Y, TRIGGER_DIVIDER)),
            (ACQUISITION_MODE, CONTINUOUS),
            (FRAME_COUNT, 1),
        ):
            self._set_integer(address, value)
        for address, real in (
            (EXPOSURE_US, 5_000.0),
            (BLACK_LEVEL_DN, frame_format["black_dn"]),
            (READOUT_US, surroundings.readout_us),
            (TEMPERATURE_C, 41.5),
            (GAMMA, 1.0),
            (BALANCE_RED, 1.0),
            (BALANCE_BLUE, 1.0),
        ):
            struct.pack_into("<d", self._registers, address, real)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(path))
        self._listener.listen(4)
        self._control: socket.socket | None = None
        self._stream: socket.socket | None = None
        reactor.add_reader(self._listener, self._accept)

    # -- registers ----------------------------------------------------------------------------------------

    def integer(self, address: int) -> int:
        return int(struct.unpack_from("<Q", self._registers, address)[0])

    def real(self, address: int) -> float:
        return float(struct.unpack_from("<d", self._registers, address)[0])

    def _set_integer(self, address: int, value: int) -> None:
        struct.pack_into("<Q", self._registers, address, value)

    def _read(self, address: int, size: int) -> bytes | None:
        if address >= DESCRIPTION:
            start = address - DESCRIPTION
            return self._description[start : start + size].ljust(size, b"\0")
        self._set_integer(EXPOSED, self.body.counters["exposed"])
        self._set_integer(OVER_TRIGGERS, self.body.counters["over_triggers"])
        return bytes(self._registers[address : address + size]) if address + size <= REGISTER_BYTES else None

    def write(self, address: int, data: bytes) -> bool:
        if not WIDTH <= address <= REGISTER_BYTES - len(data):
            return False
        self._registers[address : address + len(data)] = data
        body, triggered = self.body, self.integer(TRIGGER_MODE) == 1
        source = self.integer(TRIGGER_SOURCE)
        body.exposure_ns, body.gain = self._exposure()
        body.triggering = self._triggering()
        body.hardware = triggered and source == LINE0
        if address in {BINNING_X, BINNING_Y, DECIMATION_X, DECIMATION_Y}:
            self._fit_image()
        elif address == ACQUISITION:
            self._acquire(self.integer(ACQUISITION) == 1)
        elif address == TRIGGER_SOFTWARE and body.armed and triggered and source == SOFTWARE:
            body.expose(self._reactor.now_ns)
        return True

    def _exposure(self) -> tuple[int, float]:
        """Exposure time in ns, and gain as a factor; automatic ones are twice what is set."""
        exposure_ns = round(self.real(EXPOSURE_US) * 1e3) * (1 + bool(self.integer(EXPOSURE_AUTO)))
        gain_db = self.real(ANALOG_GAIN_DB) + self.real(DIGITAL_GAIN_DB)
        gain = 10.0 ** (gain_db / 20.0) * (1 + bool(self.integer(GAIN_AUTO)))
        return PULSE_NS if self.integer(EXPOSURE_MODE) else exposure_ns, gain

    def _triggering(self) -> Triggering:
        at_end = self.integer(TRIGGER_ACTIVATION) != self.integer(LINE_INVERTER)
        waits = self.integer(START_TRIGGER_MODE) and self.integer(START_TRIGGER_SOURCE) == LINE0
        mode, count = self.integer(ACQUISITION_MODE), self.integer(FRAME_COUNT)
        return Triggering(
            delay_ns=round(self.real(TRIGGER_DELAY_US) * 1e3) + PULSE_NS * at_end,
            divider=self.integer(TRIGGER_DIVIDER),
            latches=self.integer(TRIGGER_OVERLAP) == PREVIOUS_FRAME,
            least_period_ns=SLOWED_NS * self.integer(FRAME_RATE_ENABLE),
            most_frames=0 if mode == CONTINUOUS else 1 if mode == SINGLE_FRAME else count,
            edges_to_start=int(bool(waits)),
        )

    def _fit_image(self) -> None:
        """An image that has become larger than the sensor gives is made whole; a smaller one stays as it is."""
        for size, offset, of_sensor, factors, step in (
            (WIDTH, OFFSET_X, SENSOR_WIDTH, (BINNING_X, DECIMATION_X), 4),
            (HEIGHT, OFFSET_Y, SENSOR_HEIGHT, (BINNING_Y, DECIMATION_Y), 2),
        ):
            most = self.integer(of_sensor) // (self.integer(factors[0]) * self.integer(factors[1]))
            if self.integer(size) + self.integer(offset) > most:
                self._set_integer(offset, 0)
                self._set_integer(size, most - most % step)

    def _picture(self) -> PictureSettings:
        return PictureSettings(
            left_px=self.integer(OFFSET_X),
            top_px=self.integer(OFFSET_Y),
            width_px=self.integer(WIDTH),
            height_px=self.integer(HEIGHT),
            binning=(self.integer(BINNING_X), self.integer(BINNING_Y)),
            decimation=(self.integer(DECIMATION_X), self.integer(DECIMATION_Y)),
            mirror_axes=(bool(self.integer(REVERSE_X)), bool(self.integer(REVERSE_Y))),
            gamma=self.real(GAMMA) if self.integer(GAMMA_ENABLE) else 1.0,
            inverts=bool(self.integer(LUT_ENABLE)),
            balance=(self.real(BALANCE_RED), self.real(BALANCE_BLUE)),
            test_pattern=bool(self.integer(TEST_PATTERN)),
        )

    def _acquire(self, on: bool) -> None:
        self.body.disarm()
        self._free = deque(range(_SLOTS))
        if on:
            self.body.arm()

    # -- the wire (see sim.devices.camera_body.Wire) --------------------------------------------------------------

    def claim(self) -> int | None:
        return self._free.popleft() if self._free else None

    def pixels(self, slot: int) -> NDArray[np.uint16]:
        return self._frames[slot]

    def send(self, shot: Shot) -> bool:
        left, top, width, height = (self.integer(at) for at in (OFFSET_X, OFFSET_Y, WIDTH, HEIGHT))
        code = self.integer(PIXEL_FORMAT)
        image = np.empty(width * height * (code >> 16 & 0xFF) // 8, np.uint8)
        shown = read_out(self._frames[shot.slot], self._picture(), (1 << self._depth) - 1)
        encode(image, shown, code, self._depth)
        ticks = shot.timestamp_ns * self._ticks_hz // 10**9
        head = HEAD.pack(shot.frame_id, ticks, width, height, left, top, code, len(image))
        sent = image[: len(image) // 2] if shot.frame_id in self.torn else image
        if self._stream is not None:
            try:
                self._stream.send(head + sent.tobytes())
            except BlockingIOError:
                self._reactor.after(1e-3, self.body.deliver)
                return False
            except OSError:
                self._stream = None
        self._free.append(shot.slot)
        return True

    # -- clients ------------------------------------------------------------------------------------------

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        purpose = client.recv(64)
        with contextlib.suppress(OSError):
            if purpose == b"look":
                in_use = b"-" if self._control else b"+"
                client.send(IDENTITY.pack(self._ticks_hz, in_use, bytes(self._registers[:TEXTS_BYTES])))
            elif purpose == b"frames" and self._control is not None:
                client.setblocking(False)
                self._stream = client
                client.send(b"+")
                return
            elif purpose == b"control" and self._control is None:
                self._control = client
                self._reactor.add_reader(client, self._on_request)
                client.send(b"+")
                return
            else:
                client.send(b"-")
        client.close()

    def _on_request(self) -> None:
        assert self._control is not None
        try:
            data = self._control.recv(_MOST_BYTES)
        except OSError:
            data = b""
        if not data:
            self._let_go()
            return
        is_write, size, address = REQUEST.unpack_from(data)
        if is_write:
            done, answer = self.write(address, data[REQUEST.size :]), b""
        else:
            found = self._read(address, size)
            done, answer = found is not None, found or b""
        with contextlib.suppress(OSError):
            self._control.send(struct.pack("<i", 0 if done else REFUSED_ADDRESS) + answer)

    def _let_go(self) -> None:
        """The client is gone: a camera without a client stops."""
        self._set_integer(ACQUISITION, 0)
        self._acquire(on=False)
        if self._control is not None:
            self._reactor.remove_reader(self._control)
            self._control.close()
            self._control = None

    def unplug(self, *, silently: bool) -> None:
        """No client any more, and none can come; silently: as on transports where images just cease."""
        self._reactor.remove_reader(self._listener)
        self._listener.close()
        self._path.unlink()
        self._let_go()
        if self._stream is not None and not silently:
            self._stream.close()
            self._stream = None

    def close(self) -> None:
        self.body.close()
        for link in (self._listener, self._control, self._stream):
            if link is not None:
                link.close()
        self._path.unlink(missing_ok=True)


class Cell:
    """A camera, its trigger cable and its clock."""

    def __init__(self, path: Path, clock: Path, settings: dict[str, Any], character: dict[str, Any]) -> None:
        self._reactor = Reactor(ClockWriter(clock, speed=1.0))
        checked = camera_body.Settings.model_validate(settings)
        render = ramp if character.pop("ramp", False) else flat
        self.camera = StandIn(self._reactor, checked, path=path, **character, **sensor(render=render))
        self._thread = threading.Thread(target=self._reactor.run, daemon=True)
        self._thread.start()

    def fire(self, *periods_us: int) -> list[int]:
        return fire(self._reactor, self.camera.body.edge, periods_us)

    def unplug(self, silently: bool) -> None:
        in_world(self._reactor, lambda: self.camera.unplug(silently=silently))

    def is_armed(self) -> bool:
        return self.camera.body.armed

    def sent(self) -> int:
        """Images that left the camera, from power-on."""
        return self.camera.body.counters["delivered"]

    def register(self, address: int) -> int:
        return self.camera.integer(address)

    def write(self, address: int, data: bytes) -> None:
        """Write a register as a client does."""
        in_world(self._reactor, lambda: self.camera.write(address, data))

    def lose(self, *numbers: int) -> None:
        """Exposures of these numbers do not reach the host."""
        self.camera.body.lose_frames.update(numbers)

    def tear(self, *frame_ids: int) -> None:
        """Frames of these ids arrive without their lower half."""
        self.camera.torn.update(frame_ids)

    def close(self) -> None:
        self._reactor.stop()
        self._thread.join()
        self.camera.close()


def serve(link: Connection) -> None:
    """Cells one after the other, each from `begin` to `close`; what comes in is a method's name and arguments."""
    cell: Cell | None = None
    with contextlib.suppress(EOFError):
        while True:
            name, arguments = link.recv()
            if name == "begin":
                cell = Cell(*arguments)
                link.send(None)
            else:
                link.send(getattr(cell, name)(*arguments))
