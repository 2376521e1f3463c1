"""What the driver and the process that owns ur-rtde (`ur_link`) tell each other: one JSON object a datagram.

The driver asks, the process answers every question with its `State`; the process's last word, before it ends
by itself, is a `State` too, or a `Failure` where it could not begin.
"""

from __future__ import annotations

import json
import socket
from dataclasses import asdict, dataclass
from typing import Any, Literal

DATAGRAM_BYTES = 65536

Six = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Config:
    """What the process needs to know; see the fields of the same names in `drivers.ur.driver.Settings`."""

    host: str
    frequency_hz: float
    link_timeout_s: float
    watchdog_s: float
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
    """A question, or a command with its number."""

    verb: Literal["state", "move", "stop", "leave"]
    number: int = 0
    target_deg: Six | None = None


@dataclass(frozen=True)
class State:
    """What the controller last told."""

    command: int
    """Number of the last command obeyed."""
    joints_deg: Six
    wanted_deg: Six
    """Where the controller wants the joints to be now."""
    tcp_pose_m_rad: Six
    """base from tool centre point: x, y, z and a rotation vector."""
    tcp_offset_m_rad: Six
    """flange from tool centre point, read at opening."""
    speed_fraction: float
    """The speed slider at the pendant, 0 to 1."""
    still_samples: int
    """Samples in a row in which the arm stood still, at its target if it has one."""
    samples: int
    max_gap_s: float
    max_call_s: float
    """Longest that a call of the library took."""
    model: str
    serial: str
    firmware: str
    fault: str = ""
    """Name and reason of the latched fault; empty when there is none."""
    lost: bool = False
    """The fault is a lost link; the process has ended."""


@dataclass(frozen=True)
class Failure:
    """Why the process could not begin."""

    kind: Literal["refused", "fault", "lost"]
    expected: str
    happened: str
    remedy: str


def send(link: socket.socket, message: Ask | State | Failure) -> None:
    link.send(json.dumps({"is": type(message).__name__, **asdict(message)}).encode())


def receive(link: socket.socket) -> Ask | State | Failure | None:
    """None when the other end is gone."""
    data = link.recv(DATAGRAM_BYTES)
    if not data:
        return None
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in json.loads(data).items()}
    kinds: dict[str, type[Ask | State | Failure]] = {kind.__name__: kind for kind in (Ask, State, Failure)}
    return kinds[fields.pop("is")](**fields)
