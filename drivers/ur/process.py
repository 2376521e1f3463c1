"""The driver's side of the process that runs ur-rtde (`drivers.ur.worker`): starts, queries and ends it."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import time
from dataclasses import asdict

from coupole.errors import DeviceError, DeviceFault, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.ur import messages
from drivers.ur.messages import Ask, Config, Failure, State

_LEAVE_S = 4.0
"""The process needs less time to bring the arm to rest and to end."""
_WATCHDOG_MARGIN_S = 0.3
"""Margin for the controller's watchdog: a sign of life reaches the watchdog later than it was sent."""
_FAILURES: dict[str, type[DeviceError]] = {"refused": DeviceRefused, "fault": DeviceFault, "lost": DeviceLost}


class UrProcess:
    """Every wait is limited. A process that does not answer in time is killed, and the robot counts as lost."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._lost = ""
        """Reason why no answer can come any more; empty while answers can come."""
        self._began = self._rested = False
        self._errors_fd = os.memfd_create("coupole-ur")
        self._link, its_link = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with its_link:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "drivers.ur.worker", str(its_link.fileno()), json.dumps(asdict(config))],
                pass_fds=(its_link.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # the library prints there
                stderr=self._errors_fd,
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        return self._process.pid

    def first_state(self, timeout_s: float) -> State:
        """Return the state after opening. Raises DeviceTimeout if it does not come, or the reason why it cannot
        come."""
        self._link.settimeout(timeout_s)
        state = self._take(DeviceTimeout)
        self._began = True
        self._link.settimeout(self._config.link_timeout_s + 1.0)
        return state

    def ask(self, ask: Ask) -> State:
        """Return the answer. Raises DeviceLost if there is no answer, or if it reports a lost link; the arm is
        then at rest."""
        if not self._lost:
            with contextlib.suppress(OSError):  # the process has ended: its last message may still be readable
                messages.send(self._link, ask)
        state = self._take(DeviceLost)
        if state.lost:
            self._lost = state.fault
            self._end()
            raise_fault(state)
        return state

    def close(self) -> None:
        """Tell the process to bring the arm to rest and end; kill it if it does not. Safe to call again."""
        if self._process.poll() is None:
            with contextlib.suppress(OSError):
                messages.send(self._link, Ask("leave"))
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout=_LEAVE_S)
        self._end()
        if self._link.fileno() >= 0:
            self._lost = self._lost or "the driver was closed"
            self._link.close()
            os.close(self._errors_fd)

    def _take(self, when_silent: type[DeviceError]) -> State:
        """The process's next message."""
        message = None
        if not self._lost:
            try:
                message = self._receive()
            except TimeoutError:
                self._lost = f"ur-rtde hung for {self._link.gettimeout():.1f} s"
            except OSError as error:
                self._lost = str(error)
        if isinstance(message, State):
            return message
        self._end()
        if isinstance(message, Failure):
            kind = _FAILURES[message.kind]
            raise kind("robot", expected=message.expected, happened=message.happened, remedy=message.remedy)
        self._lost = self._lost or f"the process of ur-rtde ended: {self._last_error()}"
        raise when_silent(
            "robot",
            expected=f"answers of the controller at {self._config.host}",
            happened=self._lost,
            remedy="Check the cable and the controller, then open the robot again",
        )

    def _receive(self) -> Ask | State | Failure | None:
        try:
            return messages.receive(self._link)
        except ConnectionResetError:  # it ended before it read our Ask; its last message follows that error
            return messages.receive(self._link)

    def _end(self) -> None:
        """End the process. If it did not bring the arm to rest, the controller's watchdog does this, and this
        method waits for it."""
        self._process.kill()
        code = self._process.wait()
        if self._began and code != 0 and not self._rested:
            brake_s = self._config.speed_deg_s / self._config.stop_deg_s2
            time.sleep(self._config.watchdog_s + brake_s + _WATCHDOG_MARGIN_S)
            self._rested = True

    def _last_error(self) -> str:
        error_output = os.pread(self._errors_fd, os.fstat(self._errors_fd).st_size, 0)
        lines = error_output.decode(errors="replace").strip().splitlines()
        return f"exit code {self._process.returncode}" + (f", {lines[-1]}" if lines else "")


def raise_fault(state: State) -> None:
    """Raise DeviceFault or DeviceLost if the state has a latched fault."""
    if not state.fault:
        return
    kind = DeviceLost if state.lost else DeviceFault
    raise kind(
        "robot",
        expected="an arm under the control of the driver's program",
        happened=state.fault,
        remedy="Check the cell, acknowledge at the pendant, then reopen the robot",
    )
