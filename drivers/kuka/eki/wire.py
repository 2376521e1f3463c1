"""The XML messages that `KukaEki` and the controller exchange over EthernetKRL (EKI), and their parser.

Every element has a path, as in EKI's configuration; `tools/make_kuka_files.py` writes the controller's files from
the same tables. Each message has all of its elements. EKI keeps one queue per element, so a message without one of
them would leave the queues out of step. Angles are degrees, lengths millimetres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple
from xml.etree import ElementTree

from coupole.supervision import ATTENTION_S

Six = tuple[float, float, float, float, float, float]

ROOT = "Coupole"
STOP, MOVE, ASK, BEAT = range(4)
"""Verbs of a command: brake to rest; move the axes point to point; only acknowledge; report that the supervisor of
the motion has looked at it."""
BEAT_MS = round(1e3 * ATTENTION_S)
"""A motion ends if there is no command for this time, in the controller's time (`coupole.supervision`)."""

_AXES = tuple((f"Axes/@A{axis}", "REAL") for axis in range(1, 7))
COMMAND_ELEMENTS: tuple[tuple[str, str], ...] = (
    ("Command/@Session", "INT"),
    ("Command/@Number", "INT"),
    ("Command/@Verb", "INT"),
    ("Command/@Velocity", "INT"),
    ("Command/@Acceleration", "INT"),
    *_AXES,
)
"""Elements from the host: path below the root, and type. Velocity and acceleration are percents of $VEL_AXIS and
$ACC_AXIS."""
STATUS_ELEMENTS: tuple[tuple[str, str], ...] = (
    ("Status/@Session", "INT"),
    ("Status/@Taken", "INT"),
    ("Status/@Done", "INT"),
    ("Status/@Moving", "INT"),
    ("Status/@Fault", "INT"),
    ("Status/@Time", "INT"),
    ("Status/@Override", "INT"),
    ("Status/@T1", "INT"),
    ("Status/@Lapsed", "INT"),
    ("Arm/@Model", "STRING"),
    ("Arm/@Serial", "INT"),
    *_AXES,
    ("Pose/@Valid", "INT"),
    *((f"Pose/@{name}", "REAL") for name in "XYZABC"),
)
"""Elements from the controller, which sends them at a steady rate; see `Status`."""

NO_FAULT, EMERGENCY_STOP, DRIVES_OFF, STOP_MESSAGE, PROGRAM_ENDED, TARGET_REFUSED = range(6)
FAULTS = {
    EMERGENCY_STOP: "emergency stop: the arm does not follow its program",
    DRIVES_OFF: "the drives are off: enabling switch, safety gate or operating mode",
    STOP_MESSAGE: "the controller is halted by a stop message",
    PROGRAM_ENDED: "the robot program is not running",
    TARGET_REFUSED: "target refused: out of the controller's own software limits",
}
"""Text of the controller's fault numbers."""

_OPEN, _CLOSE = f"<{ROOT}".encode(), f"</{ROOT}>".encode()
_LONGEST_BYTES = 16384
"""EKI's own limit for an uninterpreted message (BUFFSIZE)."""


class Command(NamedTuple):
    """One command. `number` increases with every command of a session, so that answers can be matched to it."""

    session: int
    number: int
    verb: int
    velocity_percent: int
    acceleration_percent: int
    joints_deg: tuple[float, ...]


@dataclass(frozen=True)
class Status:
    """State of the controller when it sent this message."""

    session: int
    """Session of the last command taken. The controller returns it, so that answers to another session are
    recognised."""
    taken: int
    """Number of the last command taken."""
    done: int
    """Number of the last STOP or MOVE that is finished."""
    moving: bool
    fault: int
    time_ms: int
    """The controller's own clock ($ROB_TIMER)."""
    override_percent: int
    t1: bool
    """True in the mode T1, in which the controller slows every motion down."""
    lapsed: int
    """Number of the last MOVE that ended because no command came; 0 if there was none."""
    model: str
    serial: int
    joints_deg: Six
    """Measured axes."""
    pose: Six | None
    """Measured flange in the base frame: X, Y, Z mm, A, B, C deg; None if the controller has no such pose."""


def command_xml(command: Command) -> bytes:
    """The message of a command."""
    axes = " ".join(f'A{axis}="{angle:.6f}"' for axis, angle in enumerate(command.joints_deg, start=1))
    return (
        f'<{ROOT}><Command Session="{command.session}" Number="{command.number}" Verb="{command.verb}" '
        f'Velocity="{command.velocity_percent}" Acceleration="{command.acceleration_percent}"/>'
        f"<Axes {axes}/></{ROOT}>"
    ).encode()


class StatusReader:
    """Finds statuses in a stream of bytes, which may arrive in pieces of any size."""

    def __init__(self) -> None:
        self.malformed = 0
        """Messages that could not be read as a status; they are skipped."""
        self._rest = b""

    def feed(self, data: bytes) -> list[Status]:
        """Return the statuses that these bytes complete, in order."""
        *messages, self._rest = (self._rest + data).split(_CLOSE)
        if len(self._rest) > _LONGEST_BYTES:
            self.malformed += 1
            self._rest = b""
        statuses = []
        for message in messages:
            start = message.rfind(_OPEN)  # anything before it is the remainder of a truncated message
            status = _read_status(message[start:] + _CLOSE) if start >= 0 else None
            if status is None:
                self.malformed += 1
            else:
                statuses.append(status)
        return statuses


def _read_status(message: bytes) -> Status | None:
    """Return the status in a message. None if the message is not XML, lacks an element, or has an element that is
    not a number.
    """
    try:
        values = {
            f"{child.tag}/@{name}": value
            for child in ElementTree.fromstring(message)
            for name, value in child.attrib.items()
        }
        joints_deg = _six(values, "Axes", [f"A{axis}" for axis in range(1, 7)])
        pose = _six(values, "Pose", list("XYZABC"))
        if not all(map(math.isfinite, (*joints_deg, *pose))):
            return None
        return Status(
            session=int(values["Status/@Session"]),
            taken=int(values["Status/@Taken"]),
            done=int(values["Status/@Done"]),
            moving=int(values["Status/@Moving"]) != 0,
            fault=int(values["Status/@Fault"]),
            time_ms=int(values["Status/@Time"]),
            override_percent=int(values["Status/@Override"]),
            t1=int(values["Status/@T1"]) != 0,
            lapsed=int(values["Status/@Lapsed"]),
            model=values["Arm/@Model"],
            serial=int(values["Arm/@Serial"]),
            joints_deg=joints_deg,
            pose=pose if int(values["Pose/@Valid"]) else None,
        )
    except (ElementTree.ParseError, KeyError, ValueError):
        return None


def _six(values: dict[str, str], tag: str, names: list[str]) -> Six:
    a, b, c, d, e, f = (float(values[f"{tag}/@{name}"]) for name in names)
    return a, b, c, d, e, f
