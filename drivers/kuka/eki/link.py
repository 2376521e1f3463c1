"""The TCP connection to EthernetKRL, and the thread that reads it at once, so that statuses do not queue up."""

from __future__ import annotations

import contextlib
import math
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Literal, TypeVar

from coupole.errors import DeviceLost
from coupole.supervision import LOOK_S, Silence
from drivers.kuka.eki.watch import Watch
from drivers.kuka.eki.wire import Command, StatusReader, command_xml

Outcome = TypeVar("Outcome")

_LOOK_S = 0.05
"""Interval at which silence is checked, and at which connecting is retried."""
_UNREAD_BYTES = 16384
"""Receive buffer. It holds at most half a second of unread statuses, so that none is read late. If a controller
sends faster than this (a simulated world that runs faster than real time), TCP flow control slows it down."""


def connect(
    address: str, controller_is: Literal["server", "client"], controller: str, timeout_s: float
) -> tuple[socket.socket, int]:
    """Return an open connection, and the number of refused strangers. It retries for `timeout_s` of machine time.

    If the controller is the client and `controller` is not empty, only clients at this address are accepted.
    Raises OSError.
    """
    host, port = address.rsplit(":", 1)
    give_up = time.monotonic() + timeout_s
    strangers: list[str] = []
    if controller_is == "client":
        with socket.create_server((host, int(port)), backlog=1) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _UNREAD_BYTES)  # inherited by the link
            while True:
                listener.settimeout(max(_LOOK_S, give_up - time.monotonic()))
                try:
                    if strangers and time.monotonic() > give_up:  # strangers may connect without pause
                        raise TimeoutError
                    link, (caller, _) = listener.accept()
                except TimeoutError:
                    if not strangers:
                        raise
                    raise TimeoutError(
                        f"{len(strangers)} connections from other addresses than {controller} were turned away, "
                        f"the last of {strangers[-1]}"
                    ) from None
                if controller in ("", caller):
                    break
                link.close()
                strangers.append(caller)
    else:
        while True:
            link = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _UNREAD_BYTES)  # must be set before connecting
            link.settimeout(timeout_s)
            try:
                link.connect((host, int(port)))
                break
            except OSError as error:
                link.close()
                if not isinstance(error, ConnectionRefusedError) or time.monotonic() > give_up:
                    raise
                time.sleep(_LOOK_S)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return link, len(strangers)


class Link:
    """Sends commands, and passes every status received to `watch`."""

    def __init__(self, link: socket.socket, watch: Watch, timeout_s: float) -> None:
        self.reader = StatusReader()
        self._link, self._watch, self._timeout_s = link, watch, timeout_s
        self._link.settimeout(timeout_s)
        self.changed = threading.Condition()
        """Condition to be held while the watch is read or changed."""
        self._closing = False
        self._thread = threading.Thread(target=self._read_statuses, name="kuka-eki", daemon=True)
        self._thread.start()

    def send(self, command: Command) -> None:
        """Send a complete command; if that fails, latch that the link is lost."""
        try:
            self._link.sendall(command_xml(command))
        except OSError as error:
            self._lose(f"link lost: a command could not be sent ({error})")

    def beat(self, command: Command) -> None:
        """Send a command only if it can be sent at once, because the supervisor of the arm must not wait."""
        if select.select([], [self._link], [], 0)[1]:
            self.send(command)

    def wait_for(self, outcome: Callable[[], Outcome], patience_s: float | None = None) -> Outcome:
        """Call `outcome` after every status and every `LOOK_S`, until it returns a true value; return this value.

        After `patience_s` of machine time it returns the value that `outcome` then gives. Without `patience_s`,
        only a lost link ends the wait for a silent controller. A lost link latches a fault, so `outcome` must
        check the watch's fault.
        """
        give_up_s = math.inf if patience_s is None else time.monotonic() + patience_s
        with self.changed:
            while not (reached_outcome := outcome()) and (left_s := give_up_s - time.monotonic()) > 0.0:
                self.changed.wait(min(LOOK_S, left_s))
            return reached_outcome

    def close(self) -> None:
        """End the connection and the thread. Safe to call again."""
        self._closing = True
        with contextlib.suppress(OSError):
            self._link.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._link.close()

    def _read_statuses(self) -> None:
        silence, message_count = Silence(), 1
        while not self._closing:
            try:
                ready = select.select([self._link], [], [], _LOOK_S)[0]
                if (silent_s := silence.after(message_count)) > self._timeout_s:
                    self._lose(f"link lost: no status for {silent_s:.2f} s")
                    return
                if not ready:  # or this process was frozen: `select` then reports nothing without looking again
                    continue
                data = self._link.recv(65536)
            except OSError as error:
                self._lose(f"link lost: {error}")
                return
            if not data:
                self._lose("link lost: the connection was closed")
                return
            message_count += 1
            with self.changed:
                for status in self.reader.feed(data):
                    self._watch.take(status)
                self.changed.notify_all()
        self._lose("link lost: the driver was closed")

    def _lose(self, text: str) -> None:
        with self.changed:
            self._watch.fail(DeviceLost, text)
            self.changed.notify_all()
