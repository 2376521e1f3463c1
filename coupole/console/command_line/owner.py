"""Search for the process that has a cell's console, whether or not it listens.

The query takes no lock itself, so it never hinders a console that begins.
"""

from __future__ import annotations

from pathlib import Path

from coupole.plan.cell import Cell
from coupole.storage.stopped_process import holder_of


def console_lock(cell: Cell) -> Path:
    """The file that a cell's console has locked, with its process in it."""
    return cell.state_folder / "console" / "lock"


def owner_of(cell: Cell) -> int | None:
    """The process of a cell's console; None if none has it, or that cannot be told."""
    lock = console_lock(cell)
    holder = holder_of(lock)
    try:
        lock_text = lock.read_text(encoding="ascii") if holder else ""
    except OSError:
        return None
    return holder if f'"pid": {holder}}}' in lock_text else None
