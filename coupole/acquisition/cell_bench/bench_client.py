"""The client of a bench."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from coupole.acquisition.cell_bench.bench_requests import VERSION
from coupole.acquisition.cell_marks import OPEN_ELSEWHERE, is_in_use
from coupole.acquisition.runtime_folder import named_after
from coupole.acquisition.user_socket import PATIENCE_S, exchange, told_if_given_up
from coupole.errors import InputError
from coupole.plan.cell import Cell

_LONG_PATIENCE_S = 120.0
"""Longest wait for an answer: a path among many bodies, or a long exposure, takes time."""
_AT_ONCE = {"state", "stop", "jog", "drive"}
"""Commands that are answered before the work that they begin or end is done."""
_GIVEN_UP = "stopped waiting for an answer: the bench will not move the arm or light an LED for this request later"
_STOP_GIVEN_UP = "stopped waiting for an answer: the bench obeys the stop as soon as it runs again"


def bench_socket(cell: Cell) -> Path:
    """Return the path of the socket at which the bench of a cell answers, if there is one."""
    return named_after(cell.state_folder, "bench")


def ask_bench(
    cell: Cell, command: str, *, say: Callable[[str], object] = lambda _: None, **fields: Any
) -> dict[str, Any]:
    """Return the bench's answer. The answer has an `error` if the command was not obeyed. `say` gets a message
    within 2 s if the bench does not answer. It gets another message if the caller stops waiting, about what
    happens to the command. Raises InputError if there is no bench, or if it is silent."""
    patience_s = PATIENCE_S if command in _AT_ONCE else _LONG_PATIENCE_S
    rig, request = cell.document.path, {"version": VERSION, "command": command, **fields}
    try:
        with told_if_given_up(_STOP_GIVEN_UP if command == "stop" else _GIVEN_UP, say):
            return exchange(
                bench_socket(cell),
                request,
                patience_s,
                lambda why: say(f"{rig}: no answer of its bench yet: {why}"),
            )
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise InputError(f"{rig}: {_why_no_bench(cell)}") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{rig}: its bench does not answer: {error}") from error


def _why_no_bench(cell: Cell) -> str:
    if is_in_use(cell):
        return f"{OPEN_ELSEWHERE}, and that process is not a bench, so it cannot be asked; end it first"
    return "no bench of this user holds this cell on this machine (`coupole bench`)"


def checked_answer(answer: dict[str, Any]) -> dict[str, Any]:
    """Return the same answer. Raises InputError if the command was not obeyed, with the exit code of the error
    that the answer names."""
    if "error" in answer:
        error = InputError(answer["error"])
        error.exit_code = answer["exit_code"]
        raise error
    return answer
