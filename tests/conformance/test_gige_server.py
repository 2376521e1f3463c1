"""The GigE Vision stand-in's network end, from a client of a few lines that knows GVCP and not the simulator.

Its limits are those that its description states (GenICam): they are read from there, and tried on the wire.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import cells
import pytest
from camera_world import in_world
from garbage import garbage
from gige import needs_aravis
from gige_world import GigeWorld, gige_world
from places import REPO

from coupole.errors import DeviceLost
from coupole.testing.camera_conformance import EXPOSURE, take

PORT = 3956
TRIES = 10
READ, WRITE, READ_MEMORY, WRITE_MEMORY, DISCOVERY = 0x80, 0x82, 0x84, 0x86, 0x02
DONE, INVALID_PARAMETER, INVALID_ADDRESS = 0x0000, 0x8002, 0x8003
WRITE_PROTECT, BAD_ALIGNMENT, ACCESS_DENIED = 0x8004, 0x8005, 0x8006
CONTROL = 0xA00
DESCRIPTION = ElementTree.parse(REPO / "sim/devices/gige.xml").getroot()
NAMESPACE = "{http://www.genicam.org/GenApi/Version_1_1}"
NODES = {node.get("Name"): node for node in DESCRIPTION}
SENSOR = {"WidthMax": 40, "HeightMax": 24, "FrameRateMaxReg": 100.0, "OffsetXMax": 0, "OffsetYMax": 0}
"""What the limits that the description leaves to registers are, for the camera of these tests."""


class Client:
    """Control of a camera, by GigE Vision 1.2."""

    def __init__(self) -> None:
        self.link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.link.settimeout(1.0)
        self.link.connect(("127.0.0.1", PORT))
        self._request = 0

    def ask(self, command: int, content: bytes) -> tuple[int, bytes]:
        """Status and content of the acknowledgement; asks again, as clients do, if a datagram was lost."""
        self._request += 1
        for _ in range(TRIES):
            self.link.send(struct.pack(">BBHHH", 0x42, 1, command, len(content), self._request) + content)
            with contextlib.suppress(TimeoutError):
                while True:
                    answer = self.link.recv(2048)
                    status, acknowledged, size, request = struct.unpack_from(">HHHH", answer)
                    if (acknowledged, size, request) == (command + 1, len(answer) - 8, self._request):
                        return status, answer[8:]
        raise TimeoutError(f"no answer to command {command:#x}")

    def write(self, address: int, number: int | float) -> int:
        """Status of writing an integer or a float."""
        if isinstance(number, float):
            return self.ask(WRITE_MEMORY, struct.pack(">Id", address, number))[0]
        return self.ask(WRITE, struct.pack(">II", address, number % 2**32))[0]

    def read(self, address: int) -> int:
        status, data = self.ask(READ, struct.pack(">I", address))
        assert status == DONE
        return int.from_bytes(data, "big")


@pytest.fixture
def world(tmp_path: Path) -> Iterator[GigeWorld]:
    with gige_world(tmp_path) as world:
        yield world


@pytest.fixture
def client(world: GigeWorld) -> Iterator[Client]:
    client = Client()
    assert client.write(CONTROL, 2) == DONE
    with client.link:
        yield client


def text(node: ElementTree.Element, what: str) -> str | None:
    return node.findtext(NAMESPACE + what)


def address_of(register: str) -> int:
    return int(text(NODES[register], "Address") or "", 16)


def limits() -> list[tuple[str, int, float, float]]:
    """Feature, address, least and greatest value, of all numbers that a client may write."""
    found = []
    for name, node in NODES.items():
        register = NODES.get(text(node, "pValue"))
        if (
            node.tag not in {NAMESPACE + "Integer", NAMESPACE + "Float"}
            or register is None
            or not text(node, "Min")
        ):
            continue
        real = node.tag.endswith("Float")
        most = text(node, "Max") or SENSOR.get(text(node, "pMax") or "")
        address = int(text(register, "Address") or "", 16)
        if most is not None and text(register, "AccessMode") == "RW":
            kind = float if real else int
            found.append((str(name), address, kind(float(text(node, "Min") or 0)), kind(float(most))))
    return found


def switches() -> list[tuple[str, int, list[int]]]:
    """Feature, address and values of all enumerations and booleans that a client may write."""
    found = []
    for name, node in NODES.items():
        register = NODES.get(text(node, "pValue"))
        if register is None or text(register, "AccessMode") != "RW":
            continue
        values = [int(text(entry, "Value") or "", 0) for entry in node.findall(NAMESPACE + "EnumEntry")]
        values = [0, 1] if node.tag == NAMESPACE + "Boolean" else values
        if values and name not in {"GevCCP", "CounterEventSource"}:
            found.append((str(name), int(text(register, "Address") or "", 16), values))
    return found


def test_numbers_out_of_the_limits_are_refused_and_those_at_them_are_taken(client: Client) -> None:
    tried = limits()
    assert {"Width", "AcquisitionFrameRate", "ExposureTime", "Gain", "TriggerDelay"} <= {one[0] for one in tried}
    for name, address, least, most in tried:
        step = 1 if isinstance(least, int) else 1e-3
        assert client.write(address, least) == DONE, name
        assert client.write(address, most) == DONE, name
        assert client.write(address, most + step) == INVALID_PARAMETER, name
        if least > 0 or isinstance(least, float):
            assert client.write(address, least - step) == INVALID_PARAMETER, name
        if isinstance(least, float):
            for number in (float("nan"), float("inf"), -1e300):
                assert client.write(address, number) == INVALID_PARAMETER, name


def test_choices_that_there_are_not_are_refused(client: Client) -> None:
    tried = switches()
    assert {"PixelFormat", "TriggerMode", "ReverseX", "ExposureAuto"} <= {one[0] for one in tried}
    for name, address, values in tried:
        for value in values:
            assert client.write(address, value) == DONE, name
        assert client.write(address, max(values) + 1) == INVALID_PARAMETER, name


def test_a_refused_value_leaves_the_one_before(client: Client) -> None:
    address = next(place for name, place, *_ in limits() if name == "Width")
    assert client.write(address, 16) == DONE
    assert client.write(address, 18) == INVALID_PARAMETER
    assert client.read(address) == 16


def test_other_mistakes_have_their_own_status(client: Client) -> None:
    sensor_width = address_of("SensorWidthReg")
    assert client.write(sensor_width, 8) == WRITE_PROTECT
    assert client.write(0x48, 8) == WRITE_PROTECT
    assert client.write(0x00FF_0000, 8) == INVALID_ADDRESS
    assert client.write(CONTROL + 2, 8) == BAD_ALIGNMENT
    assert client.ask(READ, struct.pack(">I", 0x00FF_0000))[0] == INVALID_ADDRESS
    assert client.ask(READ_MEMORY, struct.pack(">IHH", 0x48, 0, 6))[0] == BAD_ALIGNMENT
    assert client.ask(0x99, b"")[0] == 0x8001
    exposure = address_of("ExposureReg")
    other = Client()
    with other.link:
        assert other.write(CONTROL, 2) == ACCESS_DENIED
        assert other.write(exposure, 5000.0) == ACCESS_DENIED


def test_the_image_cannot_be_changed_while_the_camera_acquires(client: Client) -> None:
    width, acquisition = address_of("WidthReg"), address_of("AcquisitionReg")
    assert client.write(acquisition, 1) == DONE
    assert client.write(width, 16) == WRITE_PROTECT
    assert client.write(acquisition, 0) == DONE
    assert client.write(width, 16) == DONE


def test_a_frame_rate_of_zero_harms_nothing(world: GigeWorld, client: Client) -> None:
    """It runs free, at the rate that it has."""
    rate, acquisition = (
        int(text(NODES[name], "Address") or "", 16) for name in ("FrameRateReg", "AcquisitionReg")
    )
    assert client.write(rate, 0.0) == INVALID_PARAMETER
    assert client.write(acquisition, 1) == DONE
    exposed = address_of("ExposedReg")
    cells.wait_until(lambda: client.read(exposed) > 2, "frames")


def test_the_camera_answers_after_garbage(world: GigeWorld, client: Client) -> None:
    real = [
        struct.pack(">BBHHHI", 0x42, 1, READ, 4, 7, 0x48),
        struct.pack(">BBHHHII", 0x42, 1, WRITE, 8, 7, 0x1100, 16),
        struct.pack(">BBHHHIHH", 0x42, 1, READ_MEMORY, 8, 7, 0x200, 0, 512),
        struct.pack(">BBHHHId", 0x42, 1, WRITE_MEMORY, 12, 7, 0x2018, 1.0),
        struct.pack(">BBHHH", 0x42, 1, DISCOVERY, 0, 7),
    ]
    for number, data in enumerate(garbage(real, 400)):
        client.link.send(data)
        if number % 20 == 0:
            client.ask(DISCOVERY, b"")  # so that no datagram is lost for want of room
    status, found = client.ask(DISCOVERY, b"")
    assert (status, found[0x48:0x4F]) == (DONE, b"Coupole")
    assert world.reactor.now_ns > 0


@needs_aravis
def test_the_cameras_process_may_die_without_the_world(
    world: GigeWorld, capfd: pytest.CaptureFixture[str]
) -> None:
    camera = world.open()
    camera.configure(EXPOSURE)
    camera.arm(8)
    world.fire()
    assert len(take(camera, 1)) == 1
    os.kill(world.camera.pid, signal.SIGKILL)
    with pytest.raises(DeviceLost, match="camera: expected"):
        camera.next_frame(30.0)
    world.fire(10_000)
    in_world(world.reactor, lambda: None)
    assert not world.is_armed
    assert "the simulated GigE Vision camera is gone: its process ended (-9)" in capfd.readouterr().err
