"""Runs a command and tells what it imported until when: `python tests/watched_imports.py FILE ARGUMENT ...`.

FILE gets a JSON object: the names in `sys.modules` when the devices were open (`opened`), when they were safe
(`safe`), when a running acquisition was asked for something (`asked`), and at the end (`end`). `kernels` has our
compiled functions, with the types of their arguments, at the same times.
"""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

FILE, *ARGUMENTS = sys.argv[1:]
sys.path[:0] = [str(Path(__file__).resolve().parent.parent)]

from coupole.commands import cli  # noqa: E402  # found by the path above

seen: dict[str, Any] = {"kernels": {}}
leave = cli.leave


def noted(name: str, function: Callable[..., Any], *, before: bool) -> Callable[..., Any]:
    """The function, with a look at all modules before or after its first call."""

    @functools.wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        if before:
            look(name)
        result = function(*args, **kwargs)
        if not before:
            look(name)
        return result

    return called


def look(name: str) -> None:
    if name not in seen:
        seen[name], seen["kernels"][name] = sorted(sys.modules), sorted(kernels())


def kernels() -> set[str]:
    """Our functions that numba has compiled or loaded, with the types that they take."""
    if "numba" not in sys.modules:
        return set()
    dispatcher = sys.modules["numba.core.dispatcher"].Dispatcher
    return {
        f"{module}.{name}{signature}"
        for module, content in list(sys.modules.items())
        if module.startswith(("coupole.", "drivers."))
        for name, kernel in list(vars(content).items())
        if isinstance(kernel, dispatcher)
        for signature in kernel.signatures
    }


def left(code: int) -> NoReturn:
    look("end")
    Path(FILE).write_text(json.dumps(seen))
    leave(code)


cli.leave = left
if ARGUMENTS[0] == "acquire":
    from coupole.acquisition.opened_cell import OpenedCell

    OpenedCell.__init__ = noted("opened", OpenedCell.__init__, before=False)  # type: ignore[method-assign]
    OpenedCell.make_safe = noted("safe", OpenedCell.make_safe, before=False)  # type: ignore[method-assign]
if ARGUMENTS[0] == "stop":
    from coupole.acquisition import run_control

    run_control.ask = noted("asked", run_control.ask, before=True)
sys.argv = ["coupole", *ARGUMENTS]
cli.main()
