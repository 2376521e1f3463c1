"""Measures how soon this machine answers an RSI controller, with the driver's real process and a controller on
loopback.

This process acts as the controller: it sends a packet in every cycle and measures the time until the answer. The
arm rests meanwhile, so the answering process has a little less work than in a motion. The time at which the
machine lets the process run is decisive.
"""

from __future__ import annotations

import os
import re
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import NamedTuple

import numpy as np

from coupole.clock import SystemClock
from drivers.kuka.rsi.driver import KukaRsi
from drivers.kuka.rsi.settings import Settings

_ABOVE_THE_LOOP = 30
"""Priority of the measuring side. It is higher, so that the measuring side is not late itself."""
_IPOC = re.compile(rb"<IPOC>(\d+)</IPOC>")
_AXES = b'<AIPos A1="0.0000" A2="-90.0000" A3="90.0000" A4="0.0000" A5="90.0000" A6="0.0000"/>'
_TOLD_EVERY_S = 0.25


class Jitter(NamedTuple):
    """Latencies of answers in us. Late answers count as one cycle."""

    cycle_ms: int
    answers: int
    realtime: bool
    """True if the answering process ran under SCHED_FIFO."""
    p50_us: float
    p99_us: float
    p99_99_us: float
    max_us: float
    late_share: float

    @property
    def holds(self) -> bool:
        """True if no answer was late. No answer may be late, because the controller's counter allows only few late
        answers in a whole session."""
        return self.late_share == 0.0


class StandInController:
    """The controller's end of one responder's wire."""

    def __init__(self, port: int, cycle_s: float) -> None:
        self.latencies_us: list[float] = []
        """Latency of each packet; infinity if the answer was late."""
        self._cycle_s = cycle_s
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.connect(("127.0.0.1", port))
        self._link.setblocking(False)
        self._ipoc = 1000
        self._late = -1
        """The delay counter; -1 until the first answer begins a session."""

    def ask(self, cycles: int) -> None:
        """Send packets, one per cycle, and record the latency of each answer."""
        next_s = time.perf_counter()
        for _ in range(cycles):
            next_s += self._cycle_s
            time.sleep(max(0.0, next_s - time.perf_counter()))
            next_s = max(next_s, time.perf_counter())
            self._ipoc += round(1e3 * self._cycle_s)
            packet_fields = _AXES, max(0, self._late), self._ipoc
            packet = b'<Rob Type="KUKA">%b<Delay D="%d"/><IPOC>%d</IPOC></Rob>' % packet_fields
            sent_s = time.perf_counter()
            self._link.send(packet)
            has_answer = self._await(sent_s + self._cycle_s)
            if self._late >= 0 or has_answer:
                self._late = max(0, self._late) + (not has_answer)
            self.latencies_us.append((time.perf_counter() - sent_s) * 1e6 if has_answer else float("inf"))

    def _await(self, until_s: float) -> bool:
        while (left_s := until_s - time.perf_counter()) > 0:
            if select.select([self._link], [], [], left_s)[0]:
                try:
                    answer = _IPOC.search(self._link.recv(4096))
                except ConnectionRefusedError:
                    continue
                if answer and int(answer[1]) == self._ipoc:
                    return True
        return False

    def close(self) -> None:
        self._link.close()


@contextmanager
def answering_session(settings: Settings) -> Iterator[tuple[StandInController, bool]]:
    """Begin a session of the driver's process with a controller in this process. Yield the controller, and True if
    the driver's process runs under SCHED_FIFO. Address, controller and limits of lateness replace the values in
    the settings for this session.
    """
    port = free_port()
    here = {"listen": f"127.0.0.1:{port}", "controller": "", "delay_limit": 10**9, "link_timeout_s": 1e6}
    settings = settings.model_copy(update=here | {"unaccounted_s": 0.0, "connect_timeout_s": 20.0})
    robots: list[KukaRsi] = []
    trouble: list[BaseException] = []

    def open_driver() -> None:
        try:
            robots.append(KukaRsi(settings, SystemClock()))
        except BaseException as error:  # noqa: BLE001  raised below, in the caller's thread
            trouble.append(error)

    opening = threading.Thread(target=open_driver)
    opening.start()
    with closing(StandInController(port, settings.cycle_ms / 1e3)) as controller:
        while opening.is_alive():
            controller.ask(10)
        if trouble:
            raise trouble[0]
        controller.latencies_us.clear()
        with closing(robots[0]) as robot:
            yield controller, robot.statistics()["realtime"] > 0


@contextmanager
def above_the_loop() -> Iterator[None]:
    """Let the measuring thread run before all others, if this is permitted. Its children have normal priority."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_ABOVE_THE_LOOP))
    except PermissionError:
        yield
        return
    try:
        yield
    finally:
        os.sched_setscheduler(0, *before)


def measure_jitter(settings: Settings, seconds: float, tell: Callable[[float], object] = lambda _: None) -> Jitter:
    """Send packets for this time, in the settings' cycle. `tell` is called with the seconds that are done.

    Raises DeviceError if the answering process cannot be started.
    """
    cycle_s = settings.cycle_ms / 1e3
    cycles = max(1, round(seconds / cycle_s))
    chunk = max(1, round(_TOLD_EVERY_S / cycle_s))
    with answering_session(settings) as (controller, realtime):
        for cycle in range(0, cycles, chunk):
            with above_the_loop():
                controller.ask(min(chunk, cycles - cycle))
            tell(min(cycles, cycle + chunk) * cycle_s)
    return jitter_of(controller.latencies_us, settings.cycle_ms, realtime=realtime)


def jitter_of(latencies_us: list[float], cycle_ms: int, *, realtime: bool) -> Jitter:
    """Figures of these latencies; late ones are infinite."""
    waited_us = np.minimum(latencies_us, 1e3 * cycle_ms)
    p50, p99, p99_99 = (float(np.quantile(waited_us, share)) for share in (0.5, 0.99, 0.9999))
    late_share = float(np.mean(np.isinf(latencies_us)))
    return Jitter(cycle_ms, len(latencies_us), realtime, p50, p99, p99_99, float(waited_us.max()), late_share)


def free_port() -> int:
    """A UDP port that is free now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
