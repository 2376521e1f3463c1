"""An RSI controller written from the facts of the wire alone, for tests of the driver.

It shares no line, no settings and no kinematics with the stand-in of `sim`. It has a cycle of its own, sends
before it is asked, and commands its axes what the answers say, without any limit: what a wrong answer would do to
an arm is seen in `peak_speed_deg_s`.

Two clocks, neither faster than the cycle: `lock_step` waits for the answer of each cycle, so that time is counted
in cycles and a busy machine changes nothing; otherwise the machine's clock paces the cycles, and an answer that is
not there when the cycle ends is a missed one. Until the first answer it repeats its first packet: a person would
start the program once the driver waits for it.
"""

import contextlib
import os
import re
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

AXES = 6

ORIGINS_MM = ((0, 0, 400), (25, 0, 0), (560, 0, 0), (0, 0, 35), (515, 0, 0), (80, 0, 0))
"""Where each joint of a KR10 R1100 sixx stands in the frame of the one before it."""

DIRECTIONS = ((0, 0, -1), (0, 1, 0), (0, 1, 0), (-1, 0, 0), (0, 1, 0), (-1, 0, 0))


@dataclass
class Cycle:
    """What one cycle of the controller did."""

    ipoc: int
    time_s: float
    commanded_deg: np.ndarray
    answered: bool
    delay: int


@dataclass
class BareRsiController:
    """One controller at one address, in a thread of its own from `start()` to `close()`."""

    target: tuple[str, int]
    cycle_s: float = 0.004
    ipoc_step: int = 4
    absolute: bool = True
    lock_step: bool = True
    lock_step_patience_s: float = 2.0
    start_axes_deg: Sequence[float] = (0.0, -90.0, 90.0, 0.0, 90.0, 0.0)
    delay_limit: int | None = None
    delay_is_cumulative: bool = True
    correction_tag: str = "AKorr"
    stop_tag: str | None = None
    host: str = "127.0.0.1"
    first_ipoc: int = 4208163634
    history: list[Cycle] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((self.host, 0))
        self.commanded_deg = np.array(self.start_axes_deg, float)
        self.start_deg = self.commanded_deg.copy()
        self.measured_deg = self.commanded_deg.copy()
        self.held_deg = np.zeros(AXES)
        self.delay = 0
        self.ipoc = self.first_ipoc
        self.faulted = False
        self.ended_by_stop = False
        self.sent: deque[bytes] = deque(maxlen=2000)
        self.answers = 0
        self.error: BaseException | None = None
        self._orders: deque[Callable[[], None]] = deque()
        self._said_delay: str | None = None
        self._silent = threading.Event()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    # what a test asks of it

    @property
    def address(self) -> tuple[str, int]:
        """Where its packets come from."""
        host, port = self.socket.getsockname()
        return host, port

    @property
    def cycles(self) -> int:
        """Cycles that have ended."""
        return len(self.history)

    @property
    def speeds_deg_s(self) -> np.ndarray:
        """Speed that each cycle commanded, by the controller's own cycle [cycles - 1, 6]."""
        commanded = np.array([self.start_axes_deg, *(cycle.commanded_deg for cycle in list(self.history))])
        return np.diff(commanded, axis=0) / self.cycle_s

    @property
    def peak_speed_deg_s(self) -> np.ndarray:
        """Greatest speed that was ever commanded of each axis [6]."""
        speeds = self.speeds_deg_s
        return np.abs(speeds).max(axis=0) if len(speeds) else np.zeros(AXES)

    @property
    def peak_acceleration_deg_s2(self) -> np.ndarray:
        """Greatest change of speed from one cycle to the next, over the cycle [6]."""
        speeds = np.vstack([np.zeros(AXES), self.speeds_deg_s])
        changes = np.diff(speeds, axis=0) / self.cycle_s
        return np.abs(changes).max(axis=0) if len(changes) else np.zeros(AXES)

    def start(self) -> "BareRsiController":
        self._thread.start()
        return self

    def close(self) -> None:
        """End the thread, and raise what went wrong in it."""
        self._over.set()
        if self._thread.ident is not None:
            self._thread.join(5)
        self.socket.close()
        if self.error is not None:
            raise self.error

    def __enter__(self) -> "BareRsiController":
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def at_next_cycle(self, order: Callable[[], None]) -> None:
        """Carry out `order` in the controller's thread, before its next packet."""
        self._orders.append(order)

    def double_next(self, times: int = 1) -> None:
        """Send the next packet more than once."""
        self.at_next_cycle(lambda: self._send(self._packet(), times))

    def repeat_old(self, cycles_ago: int) -> None:
        """Send once more what was sent that many cycles ago."""
        self.at_next_cycle(lambda: self._send(self.sent[-min(cycles_ago, len(self.sent))]))

    def send_once(self, packet: bytes) -> None:
        """Send these bytes from the controller's own address, beside its cycle."""
        self.at_next_cycle(lambda: self._send(packet))

    def restart_rsi(self, silent_cycles: int) -> None:
        """Start RSI anew where the arm is: corrections count from there, late answers from 0, the IPOC goes on."""
        self.at_next_cycle(lambda: self._restart(silent_cycles))

    def _restart(self, silent_cycles: int) -> None:
        time.sleep(silent_cycles * self.cycle_s)
        self.ipoc += silent_cycles * self.ipoc_step
        self.start_deg = self.commanded_deg
        self.held_deg = np.zeros(AXES)
        self.delay = 0

    def say_delay(self, delay: str | None) -> None:
        """Write this in `Delay`, in place of the count; None for the count again."""
        self._said_delay = delay

    def fall_silent(self) -> None:
        """Send nothing more, without a fault: the wire is cut."""
        self._silent.set()

    def speak_again(self) -> None:
        self._silent.clear()

    def hold_back_next(self, wait_s: float) -> None:
        """Let the machine's time pass before the next packet: it comes late."""
        self.at_next_cycle(lambda: time.sleep(wait_s))

    # the cycle

    def _run(self) -> None:
        with contextlib.suppress(OSError):  # a controller answers to no other work, if this user may have that
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        try:
            due_s = time.monotonic()
            while not self._over.is_set() and not self.faulted and not self.ended_by_stop:
                if self._silent.is_set():
                    time.sleep(0.002)
                    due_s = time.monotonic()
                    continue
                due_s += self.cycle_s
                self._cycle(due_s)
                if self.lock_step:
                    due_s = max(due_s, time.monotonic())
                    self._over.wait(due_s - time.monotonic())
        except OSError as trouble:
            if not self._over.is_set():
                self.error = trouble
        except BaseException as trouble:  # noqa: BLE001  told by close(), in the test's thread
            self.error = trouble

    def _cycle(self, due_s: float) -> None:
        while self._orders:
            self._orders.popleft()()
        packet = self._packet()
        self._send(packet)
        self.sent.append(packet)
        answer = self._answer(due_s)
        if answer is None and not self.history:
            return
        if answer is not None:
            self.held_deg = answer
            if not self.delay_is_cumulative:
                self.delay = 0
        else:
            self.delay += 1
        # HOLDON=1: without an answer the last value goes on being the correction
        origin_deg = self.start_deg if self.absolute else self.commanded_deg
        self.measured_deg = self.commanded_deg
        self.commanded_deg = origin_deg + self.held_deg
        self.history.append(
            Cycle(self.ipoc, len(self.history) * self.cycle_s, self.commanded_deg, answer is not None, self.delay)
        )
        self.ipoc += self.ipoc_step
        if self.delay_limit is not None and self.delay >= self.delay_limit:
            self.faulted = True

    def _answer(self, due_s: float) -> np.ndarray | None:
        """Take in what answers this cycle; on the machine's clock until the cycle ends."""
        patient = self.lock_step and self.history
        until_s = time.monotonic() + self.lock_step_patience_s if patient else due_s
        answer = None
        while (left_s := until_s - time.monotonic()) > 0 and not self._over.is_set():
            self.socket.settimeout(min(left_s, 0.05))
            try:
                data, _ = self.socket.recvfrom(4096)
            except (TimeoutError, ConnectionRefusedError):
                continue
            answer = self._taken(data) if answer is None else answer
            if self.ended_by_stop or self._silent.is_set() or (answer is not None and self.lock_step):
                break
        return answer

    def _taken(self, data: bytes) -> np.ndarray | None:
        self.answers += 1
        text = data.decode("ascii", "replace")
        ipoc = re.search(r"<IPOC>\s*(-?\d+)\s*</IPOC>", text)
        if ipoc is None or int(ipoc.group(1)) != self.ipoc:
            self.refused.append(text)
            return None
        if self.stop_tag is not None and re.search(rf"<{self.stop_tag}>\s*1\s*</{self.stop_tag}>", text):
            self.ended_by_stop = True
        korr = re.search(rf"<{self.correction_tag}\s([^>]*)/>", text)
        if korr is None:
            self.refused.append(text)
            return None
        given = dict(re.findall(r'(\w+)="([^"]*)"', korr.group(1)))
        return np.array([float(given.get(f"A{axis}", "0")) for axis in range(1, AXES + 1)])

    def _send(self, packet: bytes, times: int = 1) -> None:
        for _ in range(times):
            self.socket.sendto(packet, self.target)

    def _packet(self) -> bytes:
        return packet_of(self.measured_deg, self._said_delay or str(self.delay), self.ipoc, self.commanded_deg)


def packet_of(
    measured_deg: np.ndarray, delay: str | int, ipoc: str | int, commanded_deg: np.ndarray | None = None
) -> bytes:
    """A packet of the controller with these axes [6], as its `SEND` elements put it."""
    commanded_deg = measured_deg if commanded_deg is None else commanded_deg
    x, y, z, a, b, c = flange_of(measured_deg)
    axes = " ".join(f'A{i}="{value:.4f}"' for i, value in enumerate(measured_deg, 1))
    setpoints = " ".join(f'A{i}="{value:.4f}"' for i, value in enumerate(commanded_deg, 1))
    return (
        f'<Rob Type="KUKA"><RIst X="{x:.4f}" Y="{y:.4f}" Z="{z:.4f}" A="{a:.4f}" B="{b:.4f}" C="{c:.4f}"/>'
        f"<AIPos {axes}/><ASPos {setpoints}/>"
        f'<Delay D="{delay}"/><IPOC>{ipoc}</IPOC></Rob>'
    ).encode()


def flange_of(axes_deg: np.ndarray) -> tuple[float, ...]:
    """X, Y, Z in mm and A, B, C in degrees of the flange, R = Rz(A) Ry(B) Rx(C)."""
    place = np.zeros(3)
    rotation = np.eye(3)
    for origin, direction, angle_deg in zip(ORIGINS_MM, DIRECTIONS, axes_deg, strict=True):
        place = place + rotation @ np.array(origin, float)
        rotation = rotation @ _turned(np.array(direction, float), np.radians(angle_deg))
    rotation = rotation @ _turned(np.array((0.0, 1.0, 0.0)), np.pi / 2)
    a = np.arctan2(rotation[1, 0], rotation[0, 0])
    b = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    c = np.arctan2(rotation[2, 1], rotation[2, 2])
    return (*map(float, place), *(float(np.degrees(angle)) for angle in (a, b, c)))


def _turned(direction: np.ndarray, angle: float) -> np.ndarray:
    """Rotation by Rodrigues' formula [3, 3]."""
    x, y, z = direction
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
