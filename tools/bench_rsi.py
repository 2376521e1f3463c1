"""Latency of the RSI process at 4 ms, idle and beside two busy processes, against a minimal program in C.

This process acts as the controller: it sends a packet every 4 ms and measures the time until the answer. An answer
that takes longer than the cycle is late. Both responders, and this process with higher priority, run under
SCHED_FIFO if permitted; each figure states it.
"""

from __future__ import annotations

import os
import re
import select
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

CYCLE_S = 0.004
_BLOCK_CYCLES, _BLOCKS = 250, 8
"""The responders alternate every second; number of seconds per round."""
_PRIORITY = 30
_SOURCE = Path(__file__).with_name("bench_rsi_responder.c")
_IPOC = re.compile(rb"<IPOC>(\d+)</IPOC>")
_AXES = b'<AIPos A1="0.0000" A2="-90.0000" A3="90.0000" A4="0.0000" A5="90.0000" A6="0.0000"/>'


class Controller:
    """The controller's end of one responder's wire."""

    def __init__(self, port: int) -> None:
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.connect(("127.0.0.1", port))
        self._link.setblocking(False)
        self._ipoc = 1000
        self._late = -1
        """The delay counter; -1 until the first answer begins a session."""
        self.latencies_us: list[float] = []

    def ask(self, cycles: int) -> None:
        """Send packets, one per cycle, and record the latency of each answer; infinity for a late one."""
        next_s = time.perf_counter()
        for _ in range(cycles):
            next_s += CYCLE_S
            time.sleep(max(0.0, next_s - time.perf_counter()))
            next_s = max(next_s, time.perf_counter())
            self._ipoc += 4
            told = _AXES, max(0, self._late), self._ipoc
            packet = b'<Rob Type="KUKA">%b<Delay D="%d"/><IPOC>%d</IPOC></Rob>' % told
            sent_s = time.perf_counter()
            self._link.send(packet)
            answered = self._await(sent_s + CYCLE_S)
            if self._late >= 0 or answered:
                self._late = max(0, self._late) + (not answered)
            self.latencies_us.append((time.perf_counter() - sent_s) * 1e6 if answered else float("inf"))

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


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def our_responder() -> Iterator[tuple[Controller, bool]]:
    """The driver's process with a session, and True if it runs under SCHED_FIFO."""
    from coupole.devices import SystemClock
    from coupole.plan.arm_description import shipped_arm
    from drivers.kuka.rsi.driver import KukaRsi, Settings

    port = free_port()
    settings = Settings(
        arm_model=shipped_arm("kr10_r1100_sixx").arm,
        listen=f"127.0.0.1:{port}",
        delay_limit=10**9,
        attention_s=0.1,
        link_timeout_s=1e6,
    )
    opened: list[KukaRsi] = []
    opening = threading.Thread(target=lambda: opened.append(KukaRsi(settings, SystemClock())))
    opening.start()
    with closing(Controller(port)) as controller:
        while opening.is_alive():
            controller.ask(10)
        controller.latencies_us.clear()
        with closing(opened[0]) as robot:
            yield controller, robot.statistics()["realtime"] > 0


@contextmanager
def c_responder(folder: Path) -> Iterator[tuple[Controller, bool] | None]:
    """The program in C, compiled here; None without compiler."""
    compiler, port = shutil.which("cc"), free_port()
    if compiler is None:
        yield None
        return
    program = folder / "responder"
    subprocess.run([compiler, "-O2", "-Wall", "-Werror", "-o", str(program), str(_SOURCE)], check=True)
    with subprocess.Popen([str(program), str(port)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        realtime = process.stdout.readline() == b"1\n"
        with closing(Controller(port)) as controller:
            try:
                yield controller, realtime
            finally:
                process.kill()


@contextmanager
def neighbours(count: int) -> Iterator[None]:
    """Processes that keep a core busy."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def figures(rounds: int) -> Iterator[dict[str, Any]]:
    """Latencies in us and fractions of late answers, each with its peer."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        try:  # for this process only; the busy neighbours have normal priority
            realtime = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, realtime, os.sched_param(_PRIORITY))
        except PermissionError:
            pass
        else:
            stack.callback(os.sched_setscheduler, 0, *before)
        for load, count in (("idle", 0), ("two_busy_neighbours", 2)):
            with our_responder() as ours, c_responder(Path(folder)) as theirs, neighbours(count):
                both = [ours] if theirs is None else [ours, theirs]
                for _ in range(rounds * _BLOCKS):
                    for controller, _ in both:
                        controller.ask(_BLOCK_CYCLES)
                yield from compared(load, *both)


def compared(
    load: str, ours: tuple[Controller, bool], theirs: tuple[Controller, bool] | None = None
) -> Iterator[dict[str, Any]]:
    """Figures for one load. Without a peer they are compared with the cycle."""
    peer = "c_responder" if theirs else "cycle"
    more: dict[str, Any] = {"answers": len(ours[0].latencies_us), "sched_fifo": ours[1]}
    if theirs:
        more["peer_sched_fifo"] = theirs[1]
    for name, share in (("p50", 0.5), ("p99", 0.99), ("p99_9", 0.999)):
        value = quantile_us(ours[0], share)
        peer_value = quantile_us(theirs[0], share) if theirs else CYCLE_S * 1e6
        yield {
            "name": f"rsi_answer_{name}_{load}",
            "value": value,
            "unit": "us",
            "peer": peer,
            "ratio": peer_value / value,
            "peer_value": round(peer_value, 1),
            **more,
        }
    late = [late_share(controller) for controller, _ in filter(None, (ours, theirs))]
    yield {
        "name": f"rsi_late_share_{load}",
        "value": late[0],
        "unit": "1",
        "peer": f"{peer}, shares in time",
        "ratio": (1.0 - late[0]) / (1.0 - late[-1]) if theirs else 1.0 - late[0],
        "peer_value": late[-1] if theirs else 0.0,
        **more,
    }


def quantile_us(controller: Controller, share: float) -> float:
    """A quantile of the latency; late answers count as one cycle."""
    return float(np.quantile(np.minimum(controller.latencies_us, CYCLE_S * 1e6), share))


def late_share(controller: Controller) -> float:
    return statistics.fmean(np.isinf(controller.latencies_us))
