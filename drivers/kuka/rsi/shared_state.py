"""The memory shared by `KukaRsi` and the process that answers the controller.

There are two records, each with one writer: `Command` from the driver, `State` from the loop. A sequence number
before the record is odd while the record is being written (a seqlock). So neither side ever waits for the other.
Angles are degrees, times nanoseconds of the machine's monotonic clock.
"""

from __future__ import annotations

import mmap
import struct
import time
from typing import Any, NamedTuple

BLOCK_BYTES = 4096
_COMMAND_AT, _LOOKED_AT, _RAN_AT, _STATE_AT = 0, 512, 576, 1024
_SEQUENCE = struct.Struct("=Q")
_COMMAND = struct.Struct("=QQ7d")
_STATE = struct.Struct("=17Q24d32s32s32s200s")
_WORDS = 17
"""Integers of a state."""
_TORN_S = 1.0

HOLD, MOVE, STOP, LEAVE = range(4)
"""Verbs of a command: nothing yet, move to the target, come to rest, come to rest and end the process."""
STANDING, MOVING, STOPPING = range(3)
"""Phase of the commanded axes."""
NO_FAULT, LINK_LOST, LATE, NOT_FOLLOWING, RESTARTED, NO_TRAJECTORY, WRONG_CYCLE, OUT_OF_BOUNDS = range(8)
"""Faults, latched."""

Six = tuple[float, ...]
_ZEROS: Six = (0.0,) * 6


class Command(NamedTuple):
    number: int = 0
    """Increases by one with every command."""
    verb: int = HOLD
    target_deg: Six = _ZEROS
    speed: float = 1.0
    """Share of the axes' highest speeds."""


class State(NamedTuple):
    packets: int = 0
    """Packets of the session, each counted once."""
    answers: int = 0
    malformed: int = 0
    """Packets that could not be read, and were not answered."""
    refused: int = 0
    """Packets left unanswered because they belong to an RSI session that another program began."""
    foreign: int = 0
    """Packets from other senders than the session's, or than the controller set in the rig. They are ignored."""
    astray: int = 0
    """Packets from the controller's address that do not continue the session. They are not answered."""
    late: int = 0
    """Total increase of the controller's delay counter, which counts answers that came too late or not at all."""
    delay: int = 0
    """The controller's delay counter in the last packet."""
    max_gap_ns: int = 0
    """Longest time between two packets."""
    cycle_ns: int = 0
    """The controller's cycle, as measured or as declared by a simulated world; 0 before it is known."""
    program_ended: int = 0
    """1 if the controller ended its program on the stop element of an answer."""
    realtime: int = 0
    """1 if the loop runs under SCHED_FIFO."""
    command: int = 0
    """Number of the last command taken."""
    phase: int = STANDING
    settled_cycles: int = 0
    """Packets in a row in which the measured axes were at the commanded ones, within tolerance."""
    fault: int = NO_FAULT
    lapses: int = 0
    """Motions that ended because nobody looked at them (`coupole.supervision`)."""
    measured_deg: Six = _ZEROS
    velocity_deg_s: Six = _ZEROS
    """Velocity of the measured axes, over the last cycle."""
    commanded_deg: Six = _ZEROS
    start_deg: Six = _ZEROS
    """Axes at the start of the session, from which the correction limits count."""
    controller: bytes = b""
    """The `Type` attribute of the controller's packets."""
    sender: bytes = b""
    """Address of the session's controller."""
    other_sender: bytes = b""
    """Address of the last foreign packet."""
    fault_text: bytes = b""


class Block:
    """One side's view of the shared memory; `fd` is a memfd of BLOCK_BYTES."""

    def __init__(self, fd: int) -> None:
        self._memory = mmap.mmap(fd, BLOCK_BYTES)

    def write_command(self, command: Command) -> None:
        self._write(_COMMAND_AT, _COMMAND.pack(command.number, command.verb, *command.target_deg, command.speed))

    def read_command(self) -> Command:
        number, verb, *target, speed = self._read_record(_COMMAND_AT, _COMMAND)
        return Command(number, verb, tuple(target), speed)

    def command_number(self) -> int:
        """Return only the number, which is fast: it has 8 aligned bytes, so it is never torn."""
        number: int = _SEQUENCE.unpack_from(self._memory, _COMMAND_AT + _SEQUENCE.size)[0]
        return number

    def write_looked(self, ns: int) -> None:
        """Write the driver's beat: the time when the supervisor of the motion last looked. It has 8 aligned bytes,
        written at once."""
        self._memory[_LOOKED_AT : _LOOKED_AT + _SEQUENCE.size] = _SEQUENCE.pack(ns)

    def looked_ns(self) -> int:
        return self._read_word(_LOOKED_AT)

    def write_ran(self, ns: int) -> None:
        """Write the loop's beat: the time when the loop last ran. The loop runs at least every 50 ms, even if no
        packets come."""
        self._memory[_RAN_AT : _RAN_AT + _SEQUENCE.size] = _SEQUENCE.pack(ns)

    def ran_ns(self) -> int:
        return self._read_word(_RAN_AT)

    def write_state(self, state: State) -> None:
        self._write(
            _STATE_AT,
            _STATE.pack(
                *state[:_WORDS],
                *state.measured_deg,
                *state.velocity_deg_s,
                *state.commanded_deg,
                *state.start_deg,
                state.controller[:32],
                state.sender,
                state.other_sender,
                state.fault_text[:200],
            ),
        )

    def read_state(self) -> State:
        fields = self._read_record(_STATE_AT, _STATE)
        joints_end = _WORDS + 24
        joints = (fields[at : at + 6] for at in range(_WORDS, joints_end, 6))
        texts = (text.rstrip(b"\0") for text in fields[joints_end:])
        return State._make((*fields[:_WORDS], *joints, *texts))

    def close(self) -> None:
        self._memory.close()

    def _read_word(self, at: int) -> int:
        word: int = _SEQUENCE.unpack_from(self._memory, at)[0]
        return word

    def _write(self, at: int, record: bytes) -> None:
        (sequence,) = _SEQUENCE.unpack_from(self._memory, at)
        _SEQUENCE.pack_into(self._memory, at, sequence | 1)
        self._memory[at + _SEQUENCE.size : at + _SEQUENCE.size + len(record)] = record
        _SEQUENCE.pack_into(self._memory, at, (sequence | 1) + 1)

    def _read_record(self, at: int, layout: struct.Struct) -> tuple[Any, ...]:
        """Raises TimeoutError if the writer died in the middle of a record."""
        give_up = time.monotonic() + _TORN_S
        while time.monotonic() < give_up:
            (before,) = _SEQUENCE.unpack_from(self._memory, at)
            fields = layout.unpack_from(self._memory, at + _SEQUENCE.size)
            (after,) = _SEQUENCE.unpack_from(self._memory, at)
            if before == after and before % 2 == 0:
                return fields
            time.sleep(0)
        raise TimeoutError("the shared record stays half written: its writer has died")
