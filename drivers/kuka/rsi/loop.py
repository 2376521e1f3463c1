"""The process that answers a KUKA controller's RSI packets.

    python -m drivers.kuka.rsi.loop SOCKET_FD BLOCK_FD PARENT_PID CONFIG_JSON

It imports little and has no other task, because it must answer within the cycle. `rsi_session` computes the
answers.
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

from coupole.wrist_lengths import WristLengths
from drivers.kuka.rsi import shared_state
from drivers.kuka.rsi.realtime import become_realtime
from drivers.kuka.rsi.rsi_session import Config, RsiSession

_TICK_S = 0.05
"""Interval at which the loop checks its parent process, and the link while no packet comes."""
_END_PROGRAM_S = 0.5
"""Once the axes are at rest, longest wait for the packet whose answer ends the program."""
_ENDED_S = 0.1
"""A controller that is silent for this long after that answer has ended its program."""
_MOST_STOP_ANSWERS = 50
"""A controller that goes on after so many answers has no stop element in its configuration."""


def serve(link: socket.socket, shared_block: shared_state.Block, parent_pid: int, config: Config) -> None:
    """Answer packets until the command LEAVE or the parent's death; before returning, bring the arm to rest and
    end the controller's program."""
    # SO_RCVTIMEO costs nothing per packet; a Python socket time-out costs a poll() before every call.
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@qq", 0, int(_TICK_S * 1e6)))
    realtime = int(become_realtime())
    session = RsiSession(config, time.monotonic_ns())
    shared_block.write_state(session.state(realtime))
    _drop_backlog(link)
    leaving, look_ns, looked_ns = Leaving(session, config), 0, 0
    controller = None
    while not leaving.done:
        try:
            data, address = link.recvfrom(4096)
            idle = False
        except BlockingIOError:
            idle = True
        now_ns = time.monotonic_ns()
        shared_block.write_ran(now_ns)
        if shared_block.command_number() != session.command:
            command = shared_block.read_command()
            session.obey(command)
            if command.verb == shared_state.LEAVE:
                leaving.begin()
        looked_ns = max(looked_ns, shared_block.looked_ns())  # never backwards, also if a beat is half written
        session.attend(now_ns - looked_ns)
        late, answer = session.late, None
        if not idle and (controller not in (None, address) or config.controller not in ("", address[0])):
            session.foreign += 1  # another controller's axes must not be taken for this arm's
            session.other_sender = _name(address)
        elif not idle:
            answer = session.answer(data, now_ns)
        if answer is None:
            session.check_link(now_ns)
        else:
            if controller is None:
                controller, session.sender = address, _name(address)
            with contextlib.suppress(OSError):  # a controller that has gone is detected by its silence
                link.sendto(answer, address)
        if session.late > late or session.behind:
            _drop_backlog(link)  # answers to packets that are queued here would be late too
        if now_ns > look_ns:
            look_ns = now_ns + int(_TICK_S * 1e9)
            if os.getppid() != parent_pid and not leaving.begun:
                session.leave()
                leaving.begin()
        leaving.look(now_ns)
        shared_block.write_state(session.state(realtime))


class Leaving:
    """The end of a session: the axes brake on their path, then the controller's program is ended. While packets
    come, braking takes the time that the limits need, however the parent ended. This time is counted in packets,
    because the controller's cycles are the time of the motion."""

    def __init__(self, session: RsiSession, config: Config) -> None:
        self.begun = self.done = False
        self._session, self._config = session, config
        longest_s = max(
            speed / acceleration + 2.0 * acceleration / jerk
            for speed, acceleration, jerk in zip(
                config.velocity_deg_s, config.acceleration_deg_s2, config.jerk_deg_s3, strict=True
            )
        )
        # If answers are late, the axes wait, so twice the time is allowed. After that the axes will not come to
        # rest here.
        self._most_packets = round(2.0 * longest_s / config.cycle_s) + _MOST_STOP_ANSWERS
        self._first_packet = self._packets = self._heard_ns = 0
        self._rested_ns: int | None = None

    def begin(self) -> None:
        self.begun, self._first_packet = True, self._session.packets

    def look(self, now_ns: int) -> None:
        """Check whether the end is reached. It is called after every packet, and from time to time without one."""
        session = self._session
        if session.packets != self._packets:
            self._packets, self._heard_ns = session.packets, now_ns
        if not self.begun:
            return
        if session.motion.phase != shared_state.STANDING:
            self.done = session.packets - self._first_packet > self._most_packets
            return
        if self._rested_ns is None:
            self._rested_ns = now_ns
        if session.fault != shared_state.NO_FAULT or not self._config.stop_tag:
            self.done = True
        elif not session.stop_answers:
            self.done = now_ns - max(self._rested_ns, self._heard_ns) > _END_PROGRAM_S * 1e9
        elif now_ns - self._heard_ns > _ENDED_S * 1e9:
            session.program_ended = 1
            self.done = True
        else:
            self.done = session.stop_answers > _MOST_STOP_ANSWERS


def _name(address: tuple[str, int]) -> bytes:
    return f"{address[0]}:{address[1]}".encode()


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
    settings["geometry"] = WristLengths(*settings["geometry"])
    serve(socket.socket(fileno=socket_fd), shared_state.Block(block_fd), parent_pid, Config(**settings))
