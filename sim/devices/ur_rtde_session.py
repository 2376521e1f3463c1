"""One client of the stand-in's RTDE port: handshake, recipes, data packets at the requested frequency."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Protocol

from sim.devices import ur_rtde_wire as wire
from sim.devices.ur_rtde_wire import Value

_FREQUENCY_HZ = 500.0
_VERSION = (5, 15, 0, 126600)


class Line(Protocol):
    """The connection, as needed by a session."""

    inbox: bytearray
    gone: bool

    def send(self, data: bytes) -> None: ...


class RtdeSession:
    """One client's session. `on_inputs` receives registers when the client writes them."""

    def __init__(self, line: Line, on_inputs: Callable[[dict[str, Value]], None]) -> None:
        self.line = line
        self._on_inputs = on_inputs
        self._outputs: list[str] = []
        self._inputs: list[list[str]] = []
        self._every_cycles = 1
        self._cycles = 0
        self._started = False

    def take(self) -> None:
        """Process received packets. A client that violates the protocol is disconnected."""
        try:
            for kind, payload in wire.take_packets(self.line.inbox):
                self._take_packet(kind, payload)
        except (ValueError, IndexError, struct.error):
            self.line.gone = True

    def cycle(self, values: Callable[[], Mapping[str, Value]]) -> None:
        """Once per controller cycle: send `values()` if a packet is due for this client."""
        self._cycles += 1
        if self._started and self._cycles % self._every_cycles == 0:
            self.line.send(wire.packet(wire.DATA, b"\x01" + wire.pack(self._outputs, values())))

    def _take_packet(self, kind: int, payload: bytes) -> None:
        if kind == wire.DATA:
            if not 1 <= payload[0] <= len(self._inputs):
                raise ValueError(f"there is no recipe {payload[0]}")
            self._on_inputs(wire.unpack(self._inputs[payload[0] - 1], payload[1:]))
        elif kind == wire.PROTOCOL_VERSION:
            self._answer(kind, bytes([payload == b"\x00\x02"]))
        elif kind == wire.CONTROLLER_VERSION:
            self._answer(kind, struct.pack(">4I", *_VERSION))
        elif kind == wire.SETUP_OUTPUTS:
            (frequency_hz,) = struct.unpack_from(">d", payload)
            if not 1.0 <= frequency_hz <= _FREQUENCY_HZ:
                raise ValueError(f"{frequency_hz} Hz")
            self._every_cycles = round(_FREQUENCY_HZ / frequency_hz)
            names = _names(payload[8:])
            answer = _recipe(1, names)
            self._outputs = names if answer[0] else []
            self._answer(kind, answer)
        elif kind == wire.SETUP_INPUTS:
            names = _names(payload)
            answer = _recipe(len(self._inputs) + 1, names)
            self._inputs.append(names if answer[0] else [])
            self._answer(kind, answer)
        elif kind in {wire.START, wire.PAUSE}:
            self._started = kind == wire.START
            self._answer(kind, b"\x01")
        else:
            raise ValueError(f"packet type {kind}")

    def _answer(self, kind: int, payload: bytes) -> None:
        self.line.send(wire.packet(kind, payload))


def _names(payload: bytes) -> list[str]:
    return payload.decode("ascii").rstrip(",").split(",")


def _recipe(number: int, names: list[str]) -> bytes:
    """Return recipe id and types. Id 0, which is invalid, means that a variable does not exist. Raises ValueError
    above 255."""
    types = [wire.variable_type(name) for name in names]
    return bytes([0 if wire.NOT_FOUND in types else number]) + ",".join(types).encode()
