"""The side of whoever asks a bench."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from coupole.acquisition.cell_bench.bench_requests import VERSION
from coupole.acquisition.runtime_folder import named_after
from coupole.acquisition.user_socket import exchange
from coupole.errors import InputError
from coupole.plan.cell import Cell

_PATIENCE_S = 120.0
"""A path among many bodies, or a long exposure, takes a while."""


def bench_socket(cell: Cell) -> Path:
    """Where the bench of a cell answers, if there is one."""
    return named_after(cell.state_folder, "bench")


def ask_bench(cell: Cell, command: str, **fields: Any) -> dict[str, Any]:
    """The bench's answer; one that was not obeyed has an `error`. Raises InputError: there is no bench."""
    try:
        return exchange(bench_socket(cell), {"version": VERSION, "command": command, **fields}, _PATIENCE_S)
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise InputError(
            f"{cell.document.path}: no bench of this user holds this cell on this machine (`coupole bench`)"
        ) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{cell.document.path}: its bench does not answer: {error}") from error


def obeyed(answer: dict[str, Any]) -> dict[str, Any]:
    """The same answer. Raises InputError, with the exit code of the error that it says, if it was not obeyed."""
    if "error" in answer:
        error = InputError(answer["error"])
        error.exit_code = answer["exit_code"]
        raise error
    return answer
