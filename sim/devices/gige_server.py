"""The network end of the simulated GigE Vision camera, in a process of its own: control (GVCP) and stream (GVSP).

`python -S -m sim.devices.gige_server` with one argument, the JSON form of `Start`. Registers and images are in
memory shared with the world. Over a socket, the world names the images to send. This process answers clients at
any time, even while the world pauses. It refuses values out of the camera's limits with the protocol's status
codes (GigE Vision 1.2: chapters 16 and 18, GVCP; 22 to 24, GVSP). It needs only the standard library, so that it
starts quickly.

If this process ends, the world loses only its camera.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import random
import select
import socket
import struct
import sys
import time
from collections import deque
from dataclasses import asdict, dataclass

from sim.devices import gige_registers as reg
from sim.devices.gige_registers import Registers

PORT = 3956
"""Port that GigE Vision fixes."""
BROADCASTS = ("255.255.255.255", "127.255.255.255")
"""Addresses at which clients look for cameras."""
SEND = struct.Struct("<BIIQQ6I")
"""Message of the world to send an image: verb, slot, session, frame id, timestamp ns, width, height, left, top,
pixel format, bytes."""
LOSE_PACKETS, LOSE_CONTROL = struct.Struct("<Bd"), struct.Struct("<B")
DOES_SEND, DOES_LOSE_PACKETS, DOES_LOSE_CONTROL = 1, 2, 3
SENT = struct.Struct("<I")
"""Message from camera to world: the slot that may be used again."""

_KEY = 0x42
_HEADER = struct.Struct(">BBHHH")
"""Header of a command: key, flags, command, size of the rest, request id; of an acknowledgement: status (2 bytes),
command, size, id."""
_ACKNOWLEDGE = 1
_DISCOVERY, _READ_REGISTERS, _WRITE_REGISTERS, _READ_MEMORY, _WRITE_MEMORY = 0x02, 0x80, 0x82, 0x84, 0x86
_DISCOVERY_BYTES, _MOST_BYTES = 0xF8, 576
_LEADER, _TRAILER, _PAYLOAD = 1, 2, 3
_IMAGE = 1
_HEADERS_BYTES = 20 + 8 + 8
"""Bytes of the IP, UDP and GVSP headers, which are part of the packet's size."""
_LISTEN_S = 0.1


@dataclass(frozen=True)
class Start:
    """Data with which the process is started."""

    address: str
    link_fd: int
    """SEQPACKET socket to the world."""
    memory_fd: int
    """Shared memory: registers, then the slots of images."""
    slot_bytes: int
    slots: int
    link_mb_per_s: float

    def json(self) -> str:
        return json.dumps(asdict(self))


@dataclass(frozen=True)
class _Image:
    """An image to send."""

    slot: int
    session: int
    frame_id: int
    timestamp_ns: int
    width: int
    height: int
    left_px: int
    top: int
    pixel_format: int
    size: int


class GigeServer:
    """One camera on one address."""

    def __init__(self, start: Start) -> None:
        self._start = start
        self._world = socket.socket(fileno=start.link_fd)
        memory = memoryview(
            mmap.mmap(start.memory_fd, reg.REGISTER_BYTES + start.slots * start.slot_bytes),
        )
        self._registers = Registers(memory[: reg.REGISTER_BYTES])
        self._images = memory[reg.REGISTER_BYTES :]
        self._description = reg.DESCRIPTION.read_bytes()
        url = f"Local:dome.xml;{reg.DESCRIPTION_PLACE:x};{len(self._description):x}"
        self._registers.set_text(reg.DESCRIPTION_URL, url, 512)
        self._ports = [_bound(start.address)]
        for address in BROADCASTS:
            with contextlib.suppress(OSError):  # in this case a client must know the camera's address
                self._ports.append(_bound(address))
        self._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stream.bind((start.address, 0))
        self._controller: tuple[str, int] | None = None
        self._heard_s = 0.0
        self._sessions = 0
        self._waiting: deque[_Image] = deque()
        self._link_free_s = 0.0
        """Machine time at which the wire has carried the last image."""
        self._lost_packets = 0.0
        self._random = random.Random(1)

    def serve(self) -> None:
        """Serve until the world closes its end."""
        self._world.send(b"ready")
        while True:
            wait_s = max(0.0, self._link_free_s - time.monotonic()) if self._waiting else _LISTEN_S
            readable, _, _ = select.select([self._world, *self._ports], [], [], min(wait_s, _LISTEN_S))
            if self._world in readable and not self._listen_to_world():
                return
            for port in self._ports:
                if port in readable:
                    self._answer(port)
            self._watch_controller()
            if self._waiting and time.monotonic() >= self._link_free_s:
                self._send(self._waiting.popleft())

    def _listen_to_world(self) -> bool:
        """Take one message; False if the world is gone."""
        message = self._world.recv(128)
        if not message:
            return False
        if message[0] == DOES_SEND:
            self._waiting.append(_Image(*SEND.unpack(message)[1:]))
        elif message[0] == DOES_LOSE_PACKETS:
            self._lost_packets = LOSE_PACKETS.unpack(message)[1]
        else:
            self._release()
        return True

    # -- control ------------------------------------------------------------------------------------------

    def _answer(self, port: socket.socket) -> None:
        """Answer one datagram of a client. Data that are not a command are ignored."""
        data, client = port.recvfrom(2048)
        if len(data) < _HEADER.size or data[0] != _KEY:
            return
        _, flags, command, size, request = _HEADER.unpack_from(data)
        content = data[_HEADER.size :]
        if client == self._controller:
            self._heard_s = time.monotonic()
        status, answer = reg.INVALID_HEADER, b""
        if len(content) == size:
            status, answer = self._obey(command, content, client)
        if flags & _ACKNOWLEDGE:
            head = struct.pack(">HHHH", status, (command + 1) % 2**16, len(answer), request)
            with contextlib.suppress(OSError):
                self._ports[0].sendto(head + answer, client)

    def _obey(self, command: int, content: bytes, client: tuple[str, int]) -> tuple[int, bytes]:
        """Return status and content of the acknowledgement."""
        if command == _DISCOVERY:
            return reg.DONE, self._registers.read_bytes(0, _DISCOVERY_BYTES)
        if command == _READ_REGISTERS and content and len(content) % 4 == 0:
            return self._read_all([address for (address,) in struct.iter_unpack(">I", content)])
        if command == _READ_MEMORY and len(content) == 8:
            address, _, count = struct.unpack(">IHH", content)
            status, data = self._read_registers(address, count)
            return status, content[:4] + data if status == reg.DONE else b""
        if command == _WRITE_REGISTERS and content and len(content) % 8 == 0:
            write_count = 0
            for number, (address, value) in enumerate(struct.iter_unpack(">II", content)):
                status = self._write(address, struct.pack(">I", value), client)
                if status != reg.DONE:
                    return status, struct.pack(">HH", 0, number)
                write_count += 1
            return reg.DONE, struct.pack(">HH", 0, write_count)
        if command == _WRITE_MEMORY and len(content) > 4:
            status = self._write(int.from_bytes(content[:4], "big"), content[4:], client)
            return status, struct.pack(">HH", 0, len(content) - 4 if status == reg.DONE else 0)
        is_known = command in {_READ_REGISTERS, _READ_MEMORY, _WRITE_REGISTERS, _WRITE_MEMORY}
        return reg.INVALID_HEADER if is_known else reg.NOT_IMPLEMENTED, b""

    def _read_all(self, addresses: list[int]) -> tuple[int, bytes]:
        content = b""
        for address in addresses:
            status, data = self._read_registers(address, 4)
            if status != reg.DONE:
                return status, content
            content += data
        return reg.DONE, content

    def _read_registers(self, address: int, count: int) -> tuple[int, bytes]:
        if address % 4 or count % 4:
            return reg.BAD_ALIGNMENT, b""
        if not 0 < count <= _MOST_BYTES:
            return reg.INVALID_PARAMETER, b""
        start = address - reg.DESCRIPTION_PLACE
        if 0 <= start < len(self._description):
            return reg.DONE, self._description[start : start + count].ljust(count, b"\0")
        if address > reg.REGISTER_BYTES - count:
            return reg.INVALID_ADDRESS, b""
        return reg.DONE, self._registers.read_bytes(address, count)

    def _write(self, address: int, data: bytes, client: tuple[str, int]) -> int:
        """Write a register for a client; returns the status."""
        takes = address == reg.CONTROL_PRIVILEGE and self._controller is None
        if client != self._controller and not takes:
            return reg.ACCESS_DENIED
        status = reg.refusal(self._registers, address, data)
        if status == reg.DONE:
            self._registers.write(address, data)
            self._act_on(address, client)
        return status

    def _act_on(self, address: int, client: tuple[str, int]) -> None:
        """Start the action that a written register requests."""
        registers = self._registers
        if address == reg.CONTROL_PRIVILEGE:
            if registers.integer(address):
                self._controller, self._heard_s = client, time.monotonic()
            else:
                self._release()
        elif address == reg.ACQUISITION:
            self._acquire(bool(registers.integer(address)))
        elif address == reg.TRIGGER_SOFTWARE:
            registers.set_integer(reg.TRIGGERS, registers.integer(reg.TRIGGERS) + 1)
        elif address == reg.PACKET_SIZE and reg.fires_test_packet(registers):
            self._transmit(bytes(self._payload_bytes() + 8))
        elif address in {reg.BINNING_X, reg.BINNING_Y, reg.DECIMATION_X, reg.DECIMATION_Y}:
            self._fit_image()

    def _acquire(self, on: bool) -> None:
        self._sessions = self._sessions % 0xFFFF + on
        self._registers.set_integer(reg.SESSION, self._sessions if on else 0)

    def _fit_image(self) -> None:
        """Set a side of the image to the whole side if it reaches beyond the sensor's image. A smaller side stays
        unchanged.
        """
        registers = self._registers
        for size, offset, most, step in (
            (reg.WIDTH, reg.OFFSET_X, registers.widest(), 4),
            (reg.HEIGHT, reg.OFFSET_Y, registers.highest(), 2),
        ):
            if registers.integer(size) + registers.integer(offset) > most:
                registers.set_integer(offset, 0)
                registers.set_integer(size, most - most % step)

    def _watch_controller(self) -> None:
        """Drop a client that was silent for the heartbeat's time."""
        limit_s = self._registers.integer(reg.HEARTBEAT_MS) / 1e3
        if self._controller is not None and time.monotonic() > self._heard_s + limit_s:
            self._release()

    def _release(self) -> None:
        """Stop the camera when it has no client. Its settings stay."""
        self._controller = None
        for address in (reg.CONTROL_PRIVILEGE, reg.ACQUISITION, reg.HOST_PORT):
            self._registers.set_integer(address, 0)
        self._acquire(on=False)

    # -- stream -------------------------------------------------------------------------------------------

    def _payload_bytes(self) -> int:
        """Bytes of the image that a packet carries."""
        return (self._registers.integer(reg.PACKET_SIZE) & 0xFFFF) - _HEADERS_BYTES

    def _send(self, image: _Image) -> None:
        """Send an image, unless its acquisition has ended; its slot is then free."""
        if image.session == self._registers.integer(reg.SESSION):
            leader = struct.pack(
                ">HHQIIIIIHH",
                0,
                _IMAGE,
                image.timestamp_ns,
                image.pixel_format,
                image.width,
                image.height,
                image.left_px,
                image.top,
                0,
                0,
            )
            self._packet(image.frame_id, _LEADER, 0, leader)
            start, piece = image.slot * self._start.slot_bytes, self._payload_bytes()
            number = 0
            for number, at in enumerate(range(start, start + image.size, piece), start=1):
                end = min(at + piece, start + image.size)
                self._packet(image.frame_id, _PAYLOAD, number, self._images[at:end])
            self._packet(image.frame_id, _TRAILER, number + 1, struct.pack(">HHI", 0, _IMAGE, image.height))
            self._link_free_s = time.monotonic() + image.size / (self._start.link_mb_per_s * 1e6)
        self._world.send(SENT.pack(image.slot))

    def _packet(self, frame_id: int, kind: int, number: int, content: bytes | memoryview) -> None:
        if self._random.random() >= self._lost_packets:
            self._transmit(struct.pack(">HHI", 0, frame_id, kind << 24 | number), content)

    def _transmit(self, *parts: bytes | memoryview) -> None:
        host = socket.inet_ntoa(self._registers.read_bytes(reg.HOST_ADDRESS, 4))
        port = self._registers.integer(reg.HOST_PORT)
        with contextlib.suppress(OSError):  # nobody listens there
            self._stream.sendmsg(parts, [], 0, (host, port))


def _bound(address: str) -> socket.socket:
    port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    if address in BROADCASTS:
        port.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    port.bind((address, PORT))
    return port


def main() -> int:
    """Serve one camera; see the module's text."""
    start = Start(**json.loads(sys.argv[1]))
    try:
        server = GigeServer(start)
    except OSError as error:
        socket.socket(fileno=start.link_fd).send(str(error).encode())
        return 1
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the world was killed
        server.serve()
    return 0


if __name__ == "__main__":
    sys.exit(main())
