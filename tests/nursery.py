"""Gives birth to simulated worlds and commands: a process that has imported all that they want, and forks.

A world of its own for each of hundreds of tests is a second of imports each, a command two or three; a fork of one
that has them is none. What is forked runs `sim.world.world.main` as `python -m sim.world.world` does, or
`coupole.commands.cli.main`, in a session of its own, with the same pipes. A
command's own worlds are forked here, too.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import importlib
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from compiled_once import compile_each_kernel_once
from fork_account import ForkAccount
from numba.core.dispatcher import Dispatcher
from numba.np.ufunc import parallel
from places import REPO

FDS = 4
OURS = ("coupole.", "drivers.", "sim.")
OTHERS = ("PIL.", "cffi", "h5py.", "py_opw_kinematics", "rich.", "scipy.", "serial", "trimesh.", "typer.")
IMPORTED_BY_NEED = (*OURS, *OTHERS)
"""What the next forks find imported, once one of them has."""
MOST_BYTES = 1 << 16
WORLDS_IMPORT = ("sim.world.world", "trimesh")
"""trimesh where there is a mesh: a third of a second."""
COMMANDS_IMPORT = (
    "coupole.commands.cli",
    "coupole.commands.keeping",
    "coupole.commands.running",
    "coupole.acquisition.session",
    "coupole.preflight.job",
    "py_opw_kinematics",
    "drivers.kuka.rsi",
    "drivers.ledbox",
)
"""What `acquire` wants, which most commands of the tests are."""


class Nursery:
    """A process that forks worlds and commands; ends with the one that opened it. `line` leads to it already."""

    def __init__(self, line: socket.socket | None = None) -> None:
        self._line = line
        self._asking = threading.Lock()
        self.account: Path | None = None
        """A folder for what each fork used (tests/time_account.py)."""

    def _open(self) -> socket.socket:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            account = [str(self.account)] if self.account else []
            self._process = subprocess.Popen(
                [sys.executable, __file__, *account], stdin=theirs, start_new_session=True, cwd=REPO
            )
        return ours

    def ask(self, wanted: tuple[Any, ...], fds: list[int]) -> int:
        """The pid of what is forked with these standard streams and pipe for its exit code."""
        with self._asking:
            self._line = self._line or self._open()
            socket.send_fds(self._line, [pickle.dumps(wanted)], fds)
            return int.from_bytes(self._line.recv(8), "little")

    def start(self) -> Born:
        """A new world that waits for its configuration."""
        return Born(self, [], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def command(self, arguments: list[str], **streams: Any) -> Born:
        """`coupole` with these arguments, here and with this environment."""
        return Born(self, ["coupole", *arguments], **streams)

    def function(self, name: str, arguments: list[str], **streams: Any) -> Born:
        """A function of the tests, `module:function`, with these arguments."""
        return Born(self, [name, *arguments], **streams)


class Born(subprocess.Popen[str]):
    """A process that the nursery forked: no child of this one, which hears of its end through a pipe."""

    def __init__(self, nursery: Nursery, arguments: list[str], **streams: Any) -> None:
        self._nursery = nursery
        super().__init__(arguments, **streams)

    def _execute_child(self, args: list[str], *options: Any) -> None:  # type: ignore[override]
        cwd, ends = options[4], options[9:15]
        streams = [ends[index] if ends[index] != -1 else number for number, index in enumerate((0, 3, 5))]
        self._code, code = os.pipe()
        self.pid = self._nursery.ask((args, str(cwd or Path.cwd()), dict(os.environ)), [*streams, code])
        self._child_created = True
        os.close(code)
        self._close_pipe_fds(*ends)  # type: ignore[attr-defined]

    def __del__(self, *_: Any, **__: Any) -> None:
        """No warning for who has ended by itself, or was killed."""
        if self._child_created and self.returncode is None:
            self._internal_poll()
        super().__del__()  # type: ignore[misc]

    def _try_wait(self, wait_flags: int) -> tuple[int, int]:
        """As `os.waitpid`; of whoever could not tell its exit code, that it was killed."""
        if wait_flags & os.WNOHANG and not select.select([self._code], [], [], 0)[0]:
            return 0, 0
        told = os.read(self._code, 1)
        os.close(self._code)
        return self.pid, told[0] << 8 if told else signal.SIGKILL

    def _internal_poll(self, *_: Any, **__: Any) -> int | None:
        with self._waitpid_lock:  # type: ignore[attr-defined]
            if self.returncode is None and (found := self._try_wait(os.WNOHANG))[0]:
                self._handle_exitstatus(found[1])  # type: ignore[attr-defined]
        return self.returncode


NURSERY = Nursery()
"""That of the tests' process."""


def serve(line: socket.socket, account: ForkAccount | None = None) -> None:
    """Fork a world or a command for each message, until the line is closed."""
    compile_each_kernel_once()
    for module in WORLDS_IMPORT:
        importlib.import_module(module)
    signal.signal(signal.SIGCHLD, account.bury if account else signal.SIG_IGN)  # nobody waits for them here
    lessons, learnt = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    lines, modules = [line], 0
    while True:
        for asking in select.select(lines, [], [])[0]:
            message, fds = received(asking)
            if not message and asking is line:
                if account:
                    account.close()
                return
            if not message:
                lines.remove(asking)
                asking.close()
                continue
            arguments, folder, environment = pickle.loads(message)
            learn(lessons)
            for name in COMMANDS_IMPORT if arguments else ():
                importlib.import_module(name)
            if len(sys.modules) != modules:
                kernels, modules = kernels_of([*sys.modules]), len(sys.modules)
            gc.freeze()  # a fork that went through all of this would have to copy it
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            if pid := os.fork():
                if account:
                    account.forked(pid, asking, ours)
                with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                    asking.send(pid.to_bytes(8, "little"))
                for end in (*fds, theirs.detach()):
                    os.close(end)
                lines.append(ours)
                continue
            for other in (*lines, ours):
                other.close()
            ended = account.of_fork() if account else None
            live(arguments, folder, environment, fds, Nursery(theirs), kernels, learnt, ended)


def received(asking: socket.socket) -> tuple[bytes, list[int]]:
    """The next message and its pipes; nothing from who has ended, also before it read its answer."""
    try:
        message, fds, _, _ = socket.recv_fds(asking, MOST_BYTES, FDS)
    except ConnectionResetError:
        return b"", []
    return message, fds


def live(
    arguments: list[str],
    folder: str,
    environment: dict[str, str],
    fds: list[int],
    nursery: Nursery,
    kernels: list[Kernel],
    learnt: socket.socket,
    ended: Callable[[], None] | None,
) -> NoReturn:
    """In a fork: be the world, or the command with these arguments, and tell the exit code."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.setsid()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    start_threads()
    *streams, told = fds
    for theirs, number in zip(streams, range(3), strict=True):
        os.dup2(theirs, number)
        os.close(theirs)
    sys.stdin, sys.stdout = os.fdopen(0, closefd=False), os.fdopen(1, "w", closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, errors="backslashreplace", closefd=False)
    from sim.world import world

    known, imported = signatures(kernels), set(sys.modules)
    leave = os._exit

    def tell_and_leave(status: int) -> NoReturn:
        os.write(told, bytes([status]))
        leave(status)

    os._exit = tell_and_leave  # a program that leaves a hung call behind ends by it
    code = exit_code(commanded(arguments, nursery) if arguments else world.main)
    modules = {*sys.modules} - imported
    used = signatures([*kernels, *kernels_of(modules)]) - known
    if used or modules:
        learnt.send(pickle.dumps((sorted(filter(_by_need, modules)), used)))
    if ended:
        ended()
    tell_and_leave(code)


def commanded(arguments: list[str], nursery: Nursery) -> Callable[[], None]:
    """The command line, whose worlds are of this nursery; or a function."""
    from sim.world import client

    client._launch = nursery.start
    if arguments[0] != "coupole":
        module, _, name = arguments[0].partition(":")
        return partial(getattr(importlib.import_module(module), name), *arguments[1:])
    from coupole.commands import cli

    sys.argv = arguments
    return cli.main


def exit_code(run: Callable[[], int | None]) -> int:
    """Run it and do what an interpreter does at its end."""
    code = 1
    try:
        code = run() or 0
    except SystemExit as ended:
        code = int(ended.code or 0)
    except BaseException:  # noqa: BLE001  as an interpreter: tell, and end
        traceback.print_exc()
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    return code


Kernel = tuple[str, str, Dispatcher]
"""Module, name and function."""


def kernels_of(modules: Iterable[str]) -> list[Kernel]:
    """Our kernels in these modules. A fork asks for those of the modules that it imported alone: whoever goes
    through a module's names copies its pages."""
    return [
        (module, name, kernel)
        for module in modules
        if module.startswith(OURS)
        for name, kernel in vars(sys.modules[module]).items()
        if isinstance(kernel, Dispatcher)
    ]


def signatures(kernels: Iterable[Kernel]) -> set[tuple[str, str, Any]]:
    """Module, name and types of the arguments of all that is compiled of these kernels."""
    return {(module, name, types) for module, name, kernel in kernels for types in kernel.signatures}


def learn(lessons: socket.socket) -> None:
    """Import what forks imported, and compile (that is, load from numba's cache) what they used; nothing is run
    here."""
    while select.select([lessons], [], [], 0)[0]:
        modules, kernels = pickle.loads(lessons.recv(1 << 20))
        with no_threads():
            for module in modules:
                with contextlib.suppress(ImportError):
                    importlib.import_module(module)
            for module, name, signature in kernels:
                getattr(importlib.import_module(module), name).compile(signature)


def _by_need(module: str) -> bool:
    return module.startswith(IMPORTED_BY_NEED)


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
    sys.path[:0] = [str(REPO), str(REPO / "tests" / "faults"), str(REPO / "tests" / "runs")]
    serve(socket.socket(fileno=os.dup(0)), ForkAccount(Path(sys.argv[1])) if sys.argv[1:] else None)
