"""Gives birth to simulated worlds: a process that has imported all that a world wants, and forks.

A world of its own for each of hundreds of tests is a second of imports each; a fork of one that has them is none.
What is forked runs `sim.world.world.main` as `python -m sim.world.world` does, in a session of its own, with the
same pipes.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from typing import IO, Any

from numba.core.dispatcher import Dispatcher
from numba.np.ufunc import parallel
from places import REPO

FDS = 4


class Nursery:
    """A process that forks worlds; ends with this one."""

    def __init__(self) -> None:
        self._line: socket.socket | None = None

    def _open(self) -> socket.socket:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, __file__], stdin=theirs, start_new_session=True, cwd=REPO
            )
        return ours

    def start(self) -> Born:
        """A new world that waits for its configuration."""
        self._line = self._line or self._open()
        config, stdin = os.pipe()
        stdout, endpoints = os.pipe()
        code, status = os.pipe()
        socket.send_fds(self._line, [b"world"], [config, endpoints, 2, status])
        for theirs in (config, endpoints, status):
            os.close(theirs)
        pid = int.from_bytes(self._line.recv(8), "little")
        return Born(pid, os.fdopen(stdin, "w"), os.fdopen(stdout), code)


class Born:
    """What of `subprocess.Popen` a world's client uses."""

    def __init__(self, pid: int, stdin: IO[str], stdout: IO[str], code: int) -> None:
        self.pid, self.stdin, self.stdout, self._code = pid, stdin, stdout, code
        self.returncode: int | None = None

    def wait(self, timeout: float | None = None) -> int:
        """The exit code; -9 of one that could not tell it."""
        if self.returncode is None:
            if not select.select([self._code], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired("world", timeout or 0.0)
            self.returncode = (os.read(self._code, 1) or b"\xf7")[0]
            self.returncode -= 256 * (self.returncode > 127)
            os.close(self._code)
        return self.returncode

    def kill(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)


def serve(line: socket.socket) -> None:
    """Fork a world for each message, until the line is closed."""
    from sim.world import world

    importlib.import_module("trimesh")  # a third of a second, which a world with an object's mesh takes later

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for them here
    lessons, learnt = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    while True:
        message, fds, _, _ = socket.recv_fds(line, 16, FDS)
        if not message:
            return
        learn(lessons)
        if pid := os.fork():
            line.send(pid.to_bytes(8, "little"))
            for fd in fds:
                os.close(fd)
            continue
        line.close()
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setsid()
        start_threads()
        for theirs, number in zip(fds, range(3), strict=False):
            os.dup2(theirs, number)
        code = 1
        try:
            known = signatures()
            code = world.main()
            if new := signatures() - known:
                learnt.send(pickle.dumps(new))
        finally:
            os.write(fds[3], bytes([code]))
            os._exit(code)


def signatures() -> set[tuple[str, str, Any]]:
    """Module, name and types of the arguments of all kernels of the simulator that are compiled here."""
    return {
        (module, name, signature)
        for module, content in list(sys.modules.items())
        if module.startswith("sim.")
        for name, kernel in vars(content).items()
        if isinstance(kernel, Dispatcher)
        for signature in kernel.signatures
    }


def learn(lessons: socket.socket) -> None:
    """Compile (that is, load from numba's cache) what worlds used; nothing is run here."""
    while select.select([lessons], [], [], 0)[0]:
        with no_threads():
            for module, name, signature in pickle.loads(lessons.recv(1 << 20)):
                getattr(importlib.import_module(module), name).compile(signature)


LAUNCH = ctypes.CFUNCTYPE(None, ctypes.c_int)
_launch_none = LAUNCH(lambda count: None)


def threading_layers() -> dict[str, Any]:
    """Those of numba's libraries of threads that this machine can load, by the name that numba gives them."""
    found = {}
    for name, module in {"tbb": "tbbpool", "omp": "omppool", "workqueue": "workqueue"}.items():
        with contextlib.suppress(ImportError):
            found[name] = importlib.import_module(f"numba.np.ufunc.{module}")
    return found


@contextlib.contextmanager
def no_threads() -> Iterator[None]:
    """Kernels with threads are loaded here without any being started: they would not be there in a fork."""
    launches = {layer: layer.launch_threads for layer in threading_layers().values()}
    for layer in launches:
        layer.launch_threads = ctypes.cast(_launch_none, ctypes.c_void_p).value
    try:
        yield
    finally:
        for layer, launch in launches.items():
            layer.launch_threads = launch


def start_threads() -> None:
    """In a fork: the threads that `no_threads` held back."""
    if parallel._is_initialized:
        layer = threading_layers()[parallel._threading_layer]
        LAUNCH(layer.launch_threads)(parallel.NUM_THREADS)


if __name__ == "__main__":
    sys.path[:0] = [str(REPO)]
    serve(socket.socket(fileno=os.dup(0)))
