"""The wire format of UR's Real-Time Data Exchange (RTDE), protocol version 2: packets, and variables by name.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide": a packet is its size (uint16, including the
header), its type (uint8) and a payload, big-endian. Units on the wire are SI: metres, radians, seconds.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

PROTOCOL_VERSION = 86
CONTROLLER_VERSION = 118
SETUP_OUTPUTS = 79
SETUP_INPUTS = 73
START = 83
PAUSE = 80
DATA = 85

Value = float | tuple[float, ...]

_HEADER = struct.Struct(">HB")
_FORMATS = {
    "DOUBLE": "d",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "UINT8": "B",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
}
_TYPES = {
    "timestamp": "DOUBLE",
    "target_q": "VECTOR6D",
    "target_qd": "VECTOR6D",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "runtime_state": "UINT32",
    "speed_scaling": "DOUBLE",
    "target_speed_fraction": "DOUBLE",
    "external_force_torque": "VECTOR6D",
}
_REGISTERS = {
    "input_int_register_": "INT32",
    "output_int_register_": "INT32",
    "input_double_register_": "DOUBLE",
    "output_double_register_": "DOUBLE",
}
NOT_FOUND = "NOT_FOUND"


class Packet(NamedTuple):
    kind: int
    payload: bytes


def take_packets(inbox: bytearray) -> list[Packet]:
    """Remove and return the complete packets at the start of `inbox`. Raises ValueError for an impossible size."""
    packets = []
    while len(inbox) >= _HEADER.size:
        size, kind = _HEADER.unpack_from(inbox)
        if size < _HEADER.size:
            raise ValueError(f"an RTDE packet cannot be {size} bytes long")
        if len(inbox) < size:
            break
        packets.append(Packet(kind, bytes(inbox[_HEADER.size : size])))
        del inbox[:size]
    return packets


def packet(kind: int, payload: bytes) -> bytes:
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


def variable_type(name: str) -> str:
    """RTDE type of a variable or register; NOT_FOUND for one that this controller does not have."""
    for prefix, register_type in _REGISTERS.items():
        number = name.removeprefix(prefix)
        if number != name and number.isdigit() and int(number) < 48:
            return register_type
    return _TYPES.get(name, NOT_FOUND)


def pack(names: Sequence[str], values: Mapping[str, Value]) -> bytes:
    """Return the bytes of a recipe's variables. A variable without a value, such as a register that was never
    written, is 0."""
    return b"".join(_pack_one(name, values[name]) if name in values else _zero(name) for name in names)


def unpack(names: Sequence[str], payload: bytes) -> dict[str, Value]:
    """Raises ValueError if the payload's length differs from the recipe's."""
    formats = [_FORMATS[variable_type(name)] for name in names]
    whole = struct.Struct(">" + "".join(formats))
    if whole.size != len(payload):
        raise ValueError(f"a recipe of {whole.size} bytes came with {len(payload)}")
    values: dict[str, Value] = {}
    offset = 0
    for name, field_format in zip(names, formats, strict=True):
        fields = struct.unpack_from(">" + field_format, payload, offset)
        offset += struct.calcsize(">" + field_format)
        values[name] = fields[0] if len(fields) == 1 else fields
    return values


def _zero(name: str) -> bytes:
    return bytes(struct.calcsize(">" + _FORMATS[variable_type(name)]))


def _pack_one(name: str, value: Value) -> bytes:
    field_format = _FORMATS[variable_type(name)]
    if isinstance(value, tuple):
        return struct.pack(">" + field_format, *value)
    return struct.pack(">" + field_format, value if field_format == "d" else int(value))
