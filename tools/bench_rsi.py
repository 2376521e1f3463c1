"""Latency of the RSI process at 4 ms, idle and beside two busy processes, against a minimal program in C.

This process acts as the controller: it sends a packet every 4 ms and measures the time until the answer. An answer
that takes longer than the cycle is late. Both responders, and this process with higher priority, run under
SCHED_FIFO if permitted; each figure states it.
"""

from __future__ import annotations

import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from coupole.plan.arm_description import shipped_arm
from drivers.kuka.rsi.jitter import StandInController, above_the_loop, answering_session, free_port
from drivers.kuka.rsi.settings import Settings

CYCLE_S = 0.004
BLOCK_CYCLES, BLOCKS = 250, 8
"""Cycles of a block, and number of blocks in a round; the responders alternate after each block of a second."""
SMALLEST_CYCLES = 50
_SOURCE = Path(__file__).with_name("bench_rsi_responder.c")


@contextmanager
def our_responder() -> Iterator[tuple[StandInController, bool]]:
    """The driver's process with a session, and True if it runs under SCHED_FIFO."""
    with answering_session(
        Settings(arm_model=shipped_arm("kr10_r1100_sixx").arm, listen="127.0.0.1:0")
    ) as responder:
        yield responder


@contextmanager
def c_responder(folder: Path) -> Iterator[tuple[StandInController, bool] | None]:
    """Return the compiled program in C; None without a compiler."""
    compiler, port = shutil.which("cc"), free_port()
    if compiler is None:
        yield None
        return
    program = folder / "responder"
    subprocess.run([compiler, "-O2", "-Wall", "-Werror", "-o", str(program), str(_SOURCE)], check=True)
    with subprocess.Popen([str(program), str(port)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        realtime = process.stdout.readline() == b"1\n"
        with closing(StandInController(port, CYCLE_S)) as controller:
            try:
                yield controller, realtime
            finally:
                process.kill()


@contextmanager
def neighbours(count: int) -> Iterator[None]:
    """Run processes that keep a core busy."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def figures(rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    """Yield latencies in us and fractions of late answers, each with its peer."""
    cycles, blocks = (SMALLEST_CYCLES, 1) if smallest else (BLOCK_CYCLES, BLOCKS)
    with tempfile.TemporaryDirectory() as folder, above_the_loop():  # busy processes have normal priority
        for load, count in (("idle", 0), ("two_busy_neighbours", 2)):
            with our_responder() as our_side, c_responder(Path(folder)) as peer_side, neighbours(count):
                responders = [our_side] if peer_side is None else [our_side, peer_side]
                for _ in range(rounds * blocks):
                    for controller, _ in responders:
                        controller.ask(cycles)
                yield from load_figures(load, *responders)


def load_figures(
    load: str,
    coupole_session: tuple[StandInController, bool],
    peer_session: tuple[StandInController, bool] | None = None,
) -> Iterator[dict[str, Any]]:
    """Yield the figures for one load. Without a peer they are compared with the cycle."""
    peer = "c_responder" if peer_session else "cycle"
    more: dict[str, Any] = {"answers": len(coupole_session[0].latencies_us), "sched_fifo": coupole_session[1]}
    if peer_session:
        more["peer_sched_fifo"] = peer_session[1]
    for name, share in (("p50", 0.5), ("p99", 0.99), ("p99_9", 0.999)):
        value = quantile_us(coupole_session[0], share)
        peer_value = quantile_us(peer_session[0], share) if peer_session else CYCLE_S * 1e6
        yield {
            "name": f"rsi_answer_{name}_{load}",
            "value": value,
            "unit": "us",
            "peer": peer,
            "ratio": peer_value / value,
            "peer_value": round(peer_value, 1),
            **more,
        }
    late = [late_share(controller) for controller, _ in filter(None, (coupole_session, peer_session))]
    yield {
        "name": f"rsi_late_share_{load}",
        "value": late[0],
        "unit": "1",
        "peer": f"{peer}, shares in time",
        "ratio": (1.0 - late[0]) / (1.0 - late[-1]) if peer_session else 1.0 - late[0],
        "peer_value": late[-1] if peer_session else 0.0,
        **more,
    }


def quantile_us(controller: StandInController, share: float) -> float:
    """Return a quantile of the latency; late answers count as one cycle."""
    return float(np.quantile(np.minimum(controller.latencies_us, CYCLE_S * 1e6), share))


def late_share(controller: StandInController) -> float:
    return statistics.fmean(np.isinf(controller.latencies_us))
