"""Whatever a client sends, the world goes on: each stand-in gets hundreds of byte strings and still works."""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import CellFolder
from garbage import garbage

from sim.devices import kuka_eki_controller, ledbox_firmware, text_box, ur_controller
from sim.devices.pty_port import PtyPort
from sim.world.clock import ClockWriter
from sim.world.reactor import Reactor

COUNT = 400
PATIENCE_S = 20.0


@contextmanager
def running(folder: Path, build: Callable[[Reactor], Any]) -> Iterator[Any]:
    """A stand-in on a reactor with a thread of its own. Fails if an error ended the reactor."""
    reactor = Reactor(ClockWriter(folder / "clock", speed=1.0))
    stand_in = build(reactor)
    ended: list[BaseException] = []

    def run() -> None:
        try:
            reactor.run()
        except BaseException as error:  # noqa: BLE001  whatever it is, the test tells it
            ended.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield stand_in
    finally:
        with contextlib.suppress(OSError):
            reactor.stop()
        thread.join()
        stand_in.close()
    assert ended == []


# -- boxes on serial lines --------------------------------------------------------------------------------------

SCPI = (
    b"*IDN?\n",
    b"SEQ:BANK 1;DATA #232" + bytes(32) + b"\n",
    b"SEQuence:LOG? 0,100\n",
    b"OUTPut:PANel2 1;PANel2?\n",
    b"MEASure:TEMPerature? (@12)\n",
    b"SYSTem:WATChdog 2.5\n",
    b"TRIGger:OUTPut:WIDTh 50;POLarity INV\n",
    b"INITiate;ABORt\n",
)
LINES = (b"ID\n", b"LED 12 ON 100\n", b"LED 12 OFF\n", b"ALL OFF\n")


def scpi_box(reactor: Reactor) -> ledbox_firmware.LedBoxFirmware:
    return ledbox_firmware.LedBoxFirmware(reactor, ledbox_firmware.Settings(baud=0, block_timeout_s=0.05))


def lines_box(reactor: Reactor) -> text_box.TextBox:
    return text_box.TextBox(
        reactor,
        text_box.Settings(baud=0),
        on_light=lambda led, on_ns, off_ns: None,
        on_dark=lambda led, t_ns: None,
    )


def read_all(line: int, quiet_s: float = 0.05) -> bytes:
    """What comes until the line is quiet."""
    found = b""
    while select.select([line], [], [], quiet_s)[0]:
        found += os.read(line, 65536)
    return found


def ask_until(line: int, question: bytes, answer: bytes) -> None:
    """Ask again until the answer comes: a block that began in the garbage takes the first questions."""
    end_s = time.monotonic() + PATIENCE_S
    while answer not in read_all(line):
        assert time.monotonic() < end_s, f"no {answer!r}"
        os.write(line, question)


@pytest.mark.parametrize(
    ("build", "real", "question", "answer"),
    [
        (scpi_box, SCPI, b"\n*IDN?\n", b"Coupole,LED control box"),
        (lines_box, LINES, b"\nID\n", b"Coupole,text box"),
    ],
)
def test_a_box_answers_after_garbage(
    tmp_path: Path, build: Callable[[Reactor], Any], real: tuple[bytes, ...], question: bytes, answer: bytes
) -> None:
    with running(tmp_path, build) as box:
        line = os.open(box.port, os.O_RDWR | os.O_NOCTTY)
        try:
            for data in garbage(real, COUNT):
                os.write(line, data)
                read_all(line, quiet_s=0.0)
            ask_until(line, question, answer)
        finally:
            os.close(line)


def test_what_a_client_does_not_read_is_lost_and_told(tmp_path: Path) -> None:
    """Four megabytes of answers; the box still obeys, and says that responses are missing."""
    with running(tmp_path, scpi_box) as box:
        line = os.open(box.port, os.O_RDWR | os.O_NOCTTY)
        try:
            for _ in range(1200):
                os.write(line, b"*IDN?;" * 80 + b"*IDN?\n")
            os.write(line, b"OUTPut:PANel1 1\n")
            found = b""
            while piece := read_all(line, 0.3):
                found += piece
            assert 2**19 < len(found) < 2**20 + 2**18  # its buffer, and the kernel's
            ask_until(line, b"OUTPut:PANel1?\n", b"1\n")
            ask_until(line, b"SYST:ERR?\n", b'-430,"Query DEADLOCKED')
        finally:
            os.close(line)


def test_the_line_of_a_client_that_reads_nothing_holds_a_megabyte(tmp_path: Path) -> None:
    reactor = Reactor(ClockWriter(tmp_path / "clock", speed=1.0))
    with closing(PtyPort(reactor, baud=0)) as port:
        port.listen(lambda data: None)
        taken = sum(port.send(bytes(1000)) for _ in range(5000))
    assert 1000 < taken < 1100


# -- arms on networks -------------------------------------------------------------------------------------------

EKI = (
    b'<Coupole><Command Session="7" Number="1" Verb="1" Velocity="20" Acceleration="30"/>'
    b'<Axes A1="1.0" A2="-90.0" A3="90.0" A4="0.0" A5="90.0" A6="0.0"/></Coupole>',
    b'<Coupole><Command Session="7" Number="2" Verb="0" Velocity="20" Acceleration="30"/></Coupole>',
    b'<Coupole><Command Session="7" Number="3" Verb="2"/></Coupole>',
)
RTDE = (
    b"\x00\x05V\x00\x02",
    struct.pack(">HBd", 3 + 8 + 18, 79, 125.0) + b"timestamp,actual_q",
    struct.pack(">HBd", 3 + 8 + 13, 79, 125.0) + b"no_such_thing",
    struct.pack(">HB", 3 + 43, 73) + b"input_int_register_0,input_double_register_",
    struct.pack(">HB", 3 + 20, 73) + b"input_int_register_0",
    struct.pack(">HBBi", 8, 85, 1, 35),
    struct.pack(">HBBi", 8, 85, 0, 1),
    b"\x00\x03S",
)


def tcp(address: str, port: int) -> socket.socket:
    link = socket.create_connection((address, port), timeout=PATIENCE_S)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return link


def throw(connect: Callable[[], socket.socket], pieces: Iterator[bytes], at_once: int = 8) -> None:
    """Send the pieces over connections of `at_once` each; those that the other end closes are made anew."""
    link = connect()
    for number, data in enumerate(pieces):
        with contextlib.suppress(OSError):
            link.sendall(data)
        if number % at_once == at_once - 1:
            link.close()
            link = connect()
    link.close()


def test_the_eki_controller_takes_commands_after_garbage(tmp_path: Path) -> None:
    settings = kuka_eki_controller.Settings(status_ms=4)
    with running(tmp_path, lambda reactor: kuka_eki_controller.KukaEkiController(reactor, settings)) as arm:
        host, port = arm.address.rsplit(":", 1)
        throw(lambda: tcp(host, int(port)), garbage(EKI, COUNT))
        with tcp(host, int(port)) as link:
            link.sendall(EKI[2].replace(b'"7"', b'"4711"'))
            found = b""
            while b'Session="4711" Taken="3"' not in found[-4000:]:
                found += (piece := link.recv(65536))
                assert piece, "it hung up"


@pytest.mark.parametrize("wrong", [b"Velocity", b"Acceleration"])
def test_an_eki_command_that_would_stop_time_is_no_command(tmp_path: Path, wrong: bytes) -> None:
    """A speed of 0: the motion would never end."""
    settings = kuka_eki_controller.Settings(status_ms=4)
    with running(tmp_path, lambda reactor: kuka_eki_controller.KukaEkiController(reactor, settings)) as arm:
        host, port = arm.address.rsplit(":", 1)
        with tcp(host, int(port)) as link:
            message = EKI[0].replace(wrong + b'="20"', wrong + b'="0"').replace(wrong + b'="30"', wrong + b'="0"')
            link.sendall(message)
            with contextlib.suppress(ConnectionResetError):
                while link.recv(65536):
                    pass
        tcp(host, int(port)).close()


def test_the_ur_controller_serves_clients_after_garbage(tmp_path: Path) -> None:
    with running(tmp_path, lambda reactor: ur_controller.UrController(reactor, ur_controller.Settings())) as arm:
        program = (b"def main():\n  movej(1)\nend\n", b"stop\n", b"robotmode\n")
        for port, real in ((30004, RTDE), (30003, program), (29999, program)):
            throw(lambda port=port: tcp(arm.address, port), garbage(real, COUNT // 2))  # type: ignore[misc]
        with tcp(arm.address, 30004) as link:
            link.sendall(RTDE[0])
            assert link.recv(16) == b"\x00\x04V\x01"


@pytest.mark.parametrize(
    "pieces",
    [
        pytest.param((RTDE[2], b"\x00\x03S"), id="outputs that there are not"),
        pytest.param(
            (struct.pack(">HB", 3 + 13, 73) + b"no_such_thing", struct.pack(">HBBi", 8, 85, 1, 35)),
            id="inputs that there are not",
        ),
        pytest.param((RTDE[4], struct.pack(">HBBi", 8, 85, 0, 1)), id="recipe 0"),
    ],
)
def test_an_rtde_recipe_that_makes_no_sense_harms_its_client_only(
    tmp_path: Path, pieces: tuple[bytes, ...]
) -> None:
    with running(tmp_path, lambda reactor: ur_controller.UrController(reactor, ur_controller.Settings())) as arm:
        wrong, right = tcp(arm.address, 30004), tcp(arm.address, 30004)
        with wrong, right:
            for data in pieces:
                wrong.sendall(data)
            wrong.recv(64)
            right.sendall(RTDE[0])
            assert right.recv(16) == b"\x00\x04V\x01"


@pytest.mark.parametrize(("command", "largest"), [(1, 1e308), (3, 1e308), (34, -1e308), (35, 1e308)])
def test_registers_that_make_no_sense_end_the_program_only(tmp_path: Path, command: int, largest: float) -> None:
    """Speeds and frequencies of zero, infinity and no number at all, for each command that has some."""
    names = ",".join(["input_int_register_0", *(f"input_double_register_{n}" for n in range(8))])
    with running(tmp_path, lambda reactor: ur_controller.UrController(reactor, ur_controller.Settings())) as arm:
        with tcp(arm.address, 30003) as script, tcp(arm.address, 30004) as link:
            link.sendall(struct.pack(">HB", 3 + len(names), 73) + names.encode())
            link.recv(4096)
            for number in (0.0, float("inf"), float("nan"), largest, -1.0):
                script.sendall(b"def main():\nend\n")
                cells.wait_until(lambda: arm.program_state == "PLAYING", "the program")
                link.sendall(struct.pack(">HBBi8d", 3 + 1 + 4 + 64, 85, 1, command, *[number] * 8))
                cells.wait_until(lambda: arm.program_state == "STOPPED", f"{number} to end the program")
                link.sendall(struct.pack(">HBBi8d", 3 + 1 + 4 + 64, 85, 1, 0, *[0.0] * 8))
        tcp(arm.address, 30004).close()


# -- the world itself -------------------------------------------------------------------------------------------

COMMANDS = (
    b'{"do": "state"}',
    b'{"do": "fault", "fault": {"kind": "nudge_arm", "deg": 0.05, "seconds": 2.5}}',
    b'{"do": "fault", "fault": {"kind": "over_temperature", "board": 3, "at_s": 1.5}}',
    b'{"do": "fault", "fault": {"kind": "flickering_led", "led": 3, "rms": 0.2}}',
    b'{"do": "fault", "fault": {"kind": "double_trigger", "edge": 3, "delay_us": 200}}',
    b'{"do": "reset_robot"}',
    b"[" * 2000,
    b"[1, 2]",
)
CAMERA = (
    b'{"do": "configure", "exposure_us": 2000, "gain_db": 0.0, "hardware_trigger": true}',
    b'{"do": "arm", "buffers": 8}',
    b'{"do": "trigger"}',
    b'{"do": "memory"}',
    b'{"do": "statistics"}',
)


def seqpacket(path: str) -> socket.socket:
    link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    link.connect(path)  # with a time-out, it would not wait for a busy world
    link.settimeout(PATIENCE_S)
    return link


def sent_camera(path: str, purpose: bytes) -> socket.socket:
    link = seqpacket(path)
    link.send(purpose)
    return link


def test_a_world_goes_on_after_garbage_on_all_its_sockets(cell: CellFolder) -> None:
    """Control and camera, each with hundreds of messages; one client that says nothing, one that reads nothing."""
    with cell.world() as world:
        control, camera = world.endpoints["control"]["address"], world.endpoints["camera"]["address"]
        with seqpacket(control), seqpacket(camera), seqpacket(control) as deaf:
            throw(lambda: seqpacket(control), garbage(COMMANDS, COUNT))
            throw(lambda: sent_camera(camera, b"control"), garbage(CAMERA, COUNT), at_once=40)
            throw(lambda: sent_camera(camera, b"frames"), garbage((bytes(4), bytes(5)), COUNT // 4))
            throw(lambda: seqpacket(camera), garbage((b"control", b"frames"), COUNT // 4), at_once=1)
            deaf.settimeout(0.2)
            with contextlib.suppress(OSError):
                for _ in range(5000):
                    deaf.send(b'{"do": "state"}')
            assert world.ask("state")["t_s"] > 0
            assert "unknown command" in world.ask("no such thing")["error"]
            for fields in ({}, {"first": 0}, {"first": "0", "count": 1}, {"first": -1, "count": 1}):
                assert "expected `first` and `count`" in world.ask("exposures", **fields)["error"]
            assert "error" in world.ask("fault", fault={"kind": "over_temperature", "board": 10**6})
            assert json.dumps(world.ask("state"))
    assert world._process is not None
    assert world._process.wait() == 0
