"""Bytes as they come over wires, to drivers and stand-ins: whatever comes, the reader lives on, takes no number
that is none, and understands the next good message.

A seed is what the other end says, as its own writer forms it. It is fed whole and in pieces.
"""

from __future__ import annotations

import contextlib
import functools
import http.client
import json
import math
import mmap
import os
import socket
import struct
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

from fuzz.target import Target

AXES_DEG = (1.5, -90.25, 90.0, 0.0, 45.125, -179.9)
PATIENCE_S = 5.0
GVCP_HEADER = struct.Struct(">BBHHH")


def pieces(data: bytes) -> Iterator[bytes]:
    """The data in pieces, by chance the same each time."""
    random = Random(len(data))
    while data:
        count = random.choice((1, 2, 7, 100, 5000))
        yield data[:count]
        data = data[count:]


def finite(numbers: Iterable[float]) -> None:
    assert all(map(math.isfinite, numbers)), list(numbers)


# -- RSI ---------------------------------------------------------------------------------------------------------


def rsi_settings() -> Any:
    from sim.devices.kuka_settings import Settings

    return Settings()


def rsi_packets() -> list[bytes]:
    from sim.devices.kuka_rsi_wire import PacketWriter

    other = (
        b'<Rob Type="KUKA">\r\n<AIPos A1="0.0" A2="-90.0" A3="90.0" A4="0.0" A5="0.0" A6="0.0"/>'
        b'<Delay D="3" /><IPOC>4208163634</IPOC>\r\n</Rob>'
    )
    return [PacketWriter(rsi_settings()).packet(AXES_DEG, 0, 123456789), other]


def read_rsi_packet(path: Path) -> None:
    from drivers.kuka.rsi.wire import controller_type, packet_parser

    data = path.read_bytes()
    controller_type(data)
    packet = packet_parser("AIPos", "Delay")(data)
    if packet is not None:
        finite(packet.joints_deg)
        assert packet.delay is None or 0 <= packet.delay < 2**63
        assert packet.ipoc.isdigit()


def rsi_answers() -> list[bytes]:
    return [
        b'<Sen Type="ImFree"><EStr></EStr><AKorr A1="0.001000" A2="0.0" A3="0.0" A4="0.0" A5="-0.02" A6="0.0"/>'
        b"<Stop>0</Stop><IPOC>123456789</IPOC></Sen>"
    ]


def read_rsi_answer(path: Path) -> None:
    from sim.devices.kuka_rsi_wire import Answer, answer_reader

    answer = answer_reader(rsi_settings())(path.read_bytes())
    if isinstance(answer, Answer):
        finite(answer.values)


# -- EKI ---------------------------------------------------------------------------------------------------------


def eki_statuses() -> list[bytes]:
    axes = " ".join(f'A{axis}="{angle}"' for axis, angle in enumerate(AXES_DEG, 1))
    status = (
        '<Status Session="7" Taken="3" Done="2" Moving="1" Fault="0" Time="123456" Override="100" T1="0" '
        'Lapsed="0"/>'
        f'<Arm Model="#KR10R1100SIXX" Serial="12345"/><Axes {axes}/>'
        '<Pose Valid="1" X="700.5" Y="0.0" Z="900.0" A="180.0" B="0.0" C="-180.0"/>'
    )
    return [f"<Coupole>{status}</Coupole>".encode() * 3]


def read_eki_statuses(path: Path) -> None:
    from drivers.kuka.eki.wire import StatusReader

    reader = StatusReader()
    for data in (eki_statuses()[0], *pieces(path.read_bytes()), b"</Coupole>", eki_statuses()[0]):
        statuses = reader.feed(data)
        for status in statuses:
            finite(status.joints_deg)
            finite(status.pose or ())
    assert statuses, "a good message after it is not understood"


def eki_commands() -> list[bytes]:
    from drivers.kuka.eki.wire import Command, command_xml

    return [command_xml(Command(7, number, verb, 50, 100, AXES_DEG)) for number, verb in ((1, 2), (2, 1), (3, 0))]


def read_eki_commands(path: Path) -> None:
    from sim.devices.kuka_eki_wire import Command, Messages

    messages = Messages()
    with contextlib.suppress(ElementTree.ParseError, ValueError, KeyError):  # the session ends by them
        for data in pieces(path.read_bytes()):
            for message in messages.messages(data):
                finite(Command.of(message).axes_deg)


# -- SCPI --------------------------------------------------------------------------------------------------------


class Line:
    """A box's line that says what the case holds, then nothing."""

    bytes_per_s = 1e6
    clears = 0

    def __init__(self, said: Iterable[bytes]) -> None:
        self._said = iter(said)

    def write(self, data: bytes, deadline: Any, clears: int) -> None:
        pass

    def read_bytes(self, deadline: Any, clears: int) -> bytes:
        for data in self._said:
            return data
        raise TimeoutError("nothing came")

    def clear(self) -> None:
        pass

    def device_clear(self) -> None:
        pass

    def close(self) -> None:
        pass


def scpi_replies() -> list[bytes]:
    return [
        b'1080;#216ABCDEFGHIJKLMNOP;0,"No error"\n',
        b'Coupole,LED control box,SIM-0001,1.0;-222,"Data out of range; limits"\n0,"No error"\n',
    ]


def read_scpi_reply(path: Path) -> None:
    """Every failure is one of the driver's own."""
    from coupole.clock import SystemClock
    from drivers.ledbox.scpi import ScpiSession

    session = ScpiSession("led box", "case", Line(pieces(path.read_bytes())), SystemClock())
    for unit in session.ask("SYST:LEDS?", 2, 16):
        if isinstance(unit, str):
            session.number(unit)


def scpi_messages() -> list[bytes]:
    return [
        b"*IDN?\nSYST:LEDS?;WATC 2.5;WATC?\n",
        b"SEQ:BANK 1;DATA #232" + bytes(range(32)) + b";CRC?;COUN?\nSEQuence:DATA:APPend #10;:SEQ:STAT?\n",
        b"SEQuence:LOG? 0,100;:TRIG:COUN?\nOUTPut:PANel2 1;PANel2?\nMEAS:TEMP? 12\n",
        b"TRIGger:OUTPut:WIDTh 50;POLarity INV;:INITiate;ABORt\n*RST;*CLS\n",
    ]


class Wire:
    """The box's own end of a line, without a port."""

    port = "case"

    def __init__(self) -> None:
        self.sent = bytearray()

    def listen(self, on_bytes: Callable[[bytes], None], on_break: Callable[[], None] | None = None) -> None:
        self.received, self.on_break = on_bytes, on_break

    def send(self, data: bytes) -> bool:
        self.sent += data
        return True

    def drop_output(self) -> None:
        self.sent.clear()

    def mute(self) -> None:
        pass

    def close(self) -> None:
        pass


def read_scpi_messages(path: Path) -> None:
    """The box lives; after a device clear it is dark and answers as ever."""
    from sim.devices.ledbox_firmware import LedBoxFirmware, Settings
    from sim.world.clock import ClockWriter
    from sim.world.reactor import Reactor

    wire = Wire()
    LedBoxFirmware(
        Reactor(ClockWriter(path.with_suffix(".clock"), 1.0)),
        Settings(baud=0),
        link=wire,
    )
    for data in pieces(path.read_bytes()):
        wire.received(data)
    assert wire.on_break is not None
    wire.on_break()
    assert not wire.sent
    wire.received(b"\n*CLS;:SEQ:STAT?;:OUTP:PAN1?;PAN2?\n")
    assert bytes(wire.sent).startswith(b"IDLE"), bytes(wire.sent)
    assert bytes(wire.sent).endswith(b";0;0\n"), bytes(wire.sent)


# -- RTDE --------------------------------------------------------------------------------------------------------


def rtde_handshakes() -> list[bytes]:
    def packet(kind: int, payload: bytes) -> bytes:
        return struct.pack(">HB", 3 + len(payload), kind) + payload

    return [
        packet(86, b"\0\2")
        + packet(118, b"")
        + packet(79, struct.pack(">d", 125.0) + b"timestamp,actual_q,runtime_state")
        + packet(73, b"input_int_register_24,input_double_register_24")
        + packet(83, b"")
        + packet(85, b"\1" + struct.pack(">id", 7, 0.5))
    ]


def read_rtde(path: Path) -> None:
    from sim.devices.ur_rtde_session import RtdeSession

    sent: list[bytes] = []
    line: Any = SimpleNamespace(inbox=bytearray(), gone=False, send=sent.append)
    session = RtdeSession(line, lambda inputs: None)
    for data in pieces(path.read_bytes()):
        if not line.gone:
            line.inbox += data
            session.take()
            session.cycle(dict)


# -- GVCP --------------------------------------------------------------------------------------------------------


def gvcp_datagrams() -> list[bytes]:
    commands = (
        (0x02, b""),
        (0x80, struct.pack(">I", 0xA00)),
        (0x82, struct.pack(">II", 0xA00, 2)),
        (0x84, struct.pack(">IHH", 0x200, 0, 512)),
        (0x86, struct.pack(">Id", 0x1000, 8000.0)),
    )
    return [GVCP_HEADER.pack(0x42, 1, command, len(data), 7) + data for command, data in commands]


@functools.cache
def gvcp_port() -> socket.socket:
    """A client of a GigE Vision server in a thread of this process, on an address of its own."""
    from sim.devices import gige_registers as reg
    from sim.devices.gige_server import PORT, GigeServer, Start

    address = "127.7.7.7"
    world, end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    memory_fd = os.memfd_create("gige")
    os.truncate(memory_fd, reg.REGISTER_BYTES + mmap.PAGESIZE)
    server = GigeServer(Start(address, end.detach(), memory_fd, mmap.PAGESIZE, 1, 100.0))
    threading.Thread(target=server.serve, daemon=True).start()
    assert world.recv(16) == b"ready"
    _HELD.append(world)
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.settimeout(PATIENCE_S)
    client.connect((address, PORT))
    return client


_HELD: list[socket.socket] = []
"""The world's end of the server's line: the server ends when it is closed."""


def read_gvcp(path: Path) -> None:
    """The camera still answers a discovery after it."""
    client, random = gvcp_port(), Random(path.stat().st_size)
    client.send(path.read_bytes()[:2000])
    asked = random.randrange(1, 2**16)
    client.send(GVCP_HEADER.pack(0x42, 1, 0x02, 0, asked))
    while struct.unpack_from(">HHHH", answer := client.recv(2048)) != (0, 0x03, 0xF8, asked):
        pass
    assert len(answer) == 8 + 0xF8


# -- HTTP --------------------------------------------------------------------------------------------------------


@functools.cache
def live_page() -> tuple[Any, Any, str]:
    """A live view's server, its studio, and the part of its address that is secret."""
    from coupole.viewing.live import Choice, Studio
    from coupole.viewing.live_page import serve

    studio = Studio(Choice(3, 8000))
    server = serve(studio, tuple(range(10)), 100_000, 0)
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
    return server, studio, server.url.rstrip("/").rsplit("/", 1)[-1]


SECRET = b"SECRET"
"""Stands for the address's secret part, which is another each time."""


def http_requests() -> list[bytes]:
    headers = b"Host: localhost\r\nX-Coupole-Live: 1\r\nContent-Length: 13\r\n\r\n"
    return [
        b"GET /" + SECRET + b"/figures HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"POST /" + SECRET + b"/choose HTTP/1.1\r\n" + headers + b'{"led": true}',
        b"GET /" + SECRET + b"/picture?mark=1 HTTP/1.0\r\nHost: 127.0.0.1\r\nOrigin: null\r\n\r\n",
    ]


def read_http(path: Path) -> None:
    """No traceback to the client, no light that the dome does not have, and the page is still served."""
    server, studio, secret = live_page()
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=PATIENCE_S) as client:
        with contextlib.suppress(OSError):  # the server may hang up first
            client.sendall(path.read_bytes().replace(SECRET, secret.encode()))
            client.shutdown(socket.SHUT_WR)
        reply = b""
        with contextlib.suppress(ConnectionError):
            while data := client.recv(65536):
                reply += data
    assert b"Traceback" not in reply
    assert studio.choice.led in range(10)
    link = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=PATIENCE_S)
    link.request("GET", f"/{secret}/figures")
    answer = link.getresponse()
    assert answer.status == 200
    json.loads(answer.read())
    link.close()


def wire(name: str, seeds: Callable[[], list[bytes]], read: Callable[[Path], object]) -> Target:
    return Target(name, f"wires/{name}.bin", seeds, read, names_file=False)


WIRES = (
    wire("rsi-packet", rsi_packets, read_rsi_packet),
    wire("rsi-answer", rsi_answers, read_rsi_answer),
    wire("eki-status", eki_statuses, read_eki_statuses),
    wire("eki-command", eki_commands, read_eki_commands),
    wire("scpi-reply", scpi_replies, read_scpi_reply),
    wire("scpi-message", scpi_messages, read_scpi_messages),
    wire("rtde", rtde_handshakes, read_rtde),
    wire("gvcp", gvcp_datagrams, read_gvcp),
    wire("http", http_requests, read_http),
)
