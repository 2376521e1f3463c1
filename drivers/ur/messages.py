"""Messages between the driver and the process that runs ur-rtde (`drivers.ur.worker`): one JSON object per
datagram.

The driver sends an `Ask`, and the process answers each with its `State`. If the process ends by itself, its last
message is a `State` too, or a `Failure` if it could not begin.
"""

from __future__ import annotations

import json
import socket
from dataclasses import asdict, dataclass
from typing import Any, Literal

DATAGRAM_BYTES = 65536

EMERGENCY_STOP_BITS, PROTECTIVE_STOP_BIT, SAFEGUARD_STOP_BIT = 0x0E0, 0x004, 0x010
"""Bits of RTDE's safety_status_bits."""
BACKDRIVE, RUNNING = 6, 7
"""Values of RTDE's robot_mode in which the brakes are released."""
ROBOT_MODES = {
    -1: "no controller",
    0: "disconnected",
    1: "confirm safety",
    2: "booting",
    3: "power off",
    4: "power on",
    5: "idle",
    BACKDRIVE: "backdrive",
    RUNNING: "running",
    8: "updating firmware",
}

Six = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Config:
    """Settings of the process; see the fields of the same names in `drivers.ur.driver.Settings`."""

    host: str
    frequency_hz: float
    link_timeout_s: float
    watchdog_s: float
    attention_s: float
    speed_deg_s: float
    acceleration_deg_s2: float
    stop_deg_s2: float
    settle_deg: float
    settle_deg_s: float
    settle_samples: int
    follow_deg: float
    follow_samples: int


@dataclass(frozen=True)
class Ask:
    """A query, or a command with its number."""

    verb: Literal["state", "move", "stop", "leave"]
    number: int = 0
    target_deg: Six | None = None
    speed: float = 1.0
    """Share of the configured speed."""
    looks: bool = False
    """True if the supervisor of the motion asks. The motion then continues."""


@dataclass(frozen=True)
class State:
    """State of the controller in its latest sample."""

    command: int
    """Number of the last command taken."""
    joints_deg: Six
    wanted_deg: Six
    """The controller's present set point of the joints."""
    tcp_pose_m_rad: Six
    """Pose of the tool centre point in the base frame: x, y, z and a rotation vector."""
    tcp_offset_m_rad: Six
    """Pose of the tool centre point in the flange frame, read at opening."""
    speed_fraction: float
    """The speed slider at the pendant, 0 to 1."""
    still_samples: int
    """Number of consecutive samples in which the arm was at rest, and at its target if it has one."""
    samples: int
    max_gap_s: float
    max_call_s: float
    """Longest duration of a call of the library."""
    model: str
    serial: str
    firmware: str
    robot_mode: int = -1
    """RTDE's robot_mode."""
    safety_bits: int = 0
    """RTDE's safety_status_bits."""
    fault: str = ""
    """Name and reason of the latched fault; empty when there is none."""
    lapses: int = 0
    """Number of motions that ended because nobody watched them (`coupole.supervision`)."""
    lost: bool = False
    """True if the fault is a lost link; the process has ended."""


@dataclass(frozen=True)
class Failure:
    """Reason why the process could not begin."""

    kind: Literal["refused", "fault", "lost"]
    expected: str
    happened: str
    remedy: str


def send(link: socket.socket, message: Ask | State | Failure) -> None:
    link.send(json.dumps({"is": type(message).__name__, **asdict(message)}).encode())


def receive(link: socket.socket) -> Ask | State | Failure | None:
    """The next message; None if the other end is closed."""
    data = link.recv(DATAGRAM_BYTES)
    if not data:
        return None
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in json.loads(data).items()}
    kinds: dict[str, type[Ask | State | Failure]] = {kind.__name__: kind for kind in (Ask, State, Failure)}
    return kinds[fields.pop("is")](**fields)
