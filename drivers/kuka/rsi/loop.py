"""The process that answers a KUKA controller's RSI packets.

    python -m drivers.kuka.rsi.loop SOCKET_FD BLOCK_FD PARENT_PID CONFIG_JSON

It imports little and has no other task, because it must answer within the cycle; see `rsi_session`.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import socket
import struct
import sys
import time

from drivers.kuka.rsi import shared_state
from drivers.kuka.rsi.pose import Geometry
from drivers.kuka.rsi.rsi_session import Config, RsiSession

_TICK_S = 0.05
"""Interval at which the loop checks its parent process, and the link while no packet comes."""
_ORPHAN_S = 0.8
"""Longest time for which the loop continues after its parent's death: the time to brake."""
_REALTIME_PRIORITY = 20


def serve(link: socket.socket, shared: shared_state.Block, parent_pid: int, config: Config) -> None:
    """Answer packets until the command LEAVE or the parent's death; before returning, bring the arm to rest."""
    # SO_RCVTIMEO costs nothing per packet; a Python socket time-out costs a poll() before every call.
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@qq", 0, int(_TICK_S * 1e6)))
    realtime = _become_realtime()
    session = RsiSession(config, time.monotonic_ns())
    shared.write_state(session.state(realtime))
    _drop_backlog(link)
    leaving, orphan_ns, look_ns = False, 0, 0
    controller = None
    while not (leaving and session.motion.phase == shared_state.STANDING):
        try:
            data, address = link.recvfrom(4096)
            idle = False
        except BlockingIOError:
            idle = True
        now_ns = time.monotonic_ns()
        if shared.command_number() != session.command:
            command = shared.read_command()
            session.obey(command)
            leaving |= command.verb == shared_state.LEAVE
        late, answer = session.late, None
        if not idle and controller not in (None, address):
            session.foreign += 1  # another controller's axes must not be taken for this arm's
        elif not idle:
            answer = session.answer(data, now_ns)
        if answer is None:
            session.check_link(now_ns)
        else:
            controller = address
            with contextlib.suppress(OSError):  # a controller that has gone is detected by its silence
                link.sendto(answer, address)
        if session.late > late:
            _drop_backlog(link)  # answers to packets that are queued here would be late too
        shared.write_state(session.state(realtime))
        if now_ns > look_ns:
            look_ns = now_ns + int(_TICK_S * 1e9)
            if os.getppid() != parent_pid and not leaving:
                leaving, orphan_ns = True, now_ns
                session.motion.stop()
        if orphan_ns and now_ns - orphan_ns > _ORPHAN_S * 1e9:
            break


def _become_realtime() -> int:
    """1 if the process may run under SCHED_FIFO; 0 if not, and it then runs with normal priority."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_REALTIME_PRIORITY))
    except OSError:
        return 0
    return 1


def _drop_backlog(link: socket.socket) -> None:
    """Discard queued packets; their cycles are over."""
    with contextlib.suppress(BlockingIOError):
        while True:
            link.recv(4096, socket.MSG_DONTWAIT)


if __name__ == "__main__":
    # Ctrl-C is for the parent program, which then stops this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.disable()
    socket_fd, block_fd, parent_pid = map(int, sys.argv[1:4])
    settings = json.loads(sys.argv[4])
    settings["geometry"] = Geometry(*settings["geometry"])
    serve(socket.socket(fileno=socket_fd), shared_state.Block(block_fd), parent_pid, Config(**settings))
