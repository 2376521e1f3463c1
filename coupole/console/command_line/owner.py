"""Search for the process that has a cell's console, also if it does not listen.

The search takes no lock, so it never hinders a console that is starting.
"""

from __future__ import annotations

from pathlib import Path

from coupole.plan.cell import Cell
from coupole.storage.stopped_process import holder_of


def console_lock(cell: Cell) -> Path:
    """Return the file that a cell's console locks; it contains the process id."""
    return cell.state_folder / "console" / "lock"


def owner_of(cell: Cell) -> int | None:
    """Return the process id of a cell's console; None if there is no console, or if this cannot be determined."""
    lock = console_lock(cell)
    holder = holder_of(lock)
    try:
        lock_text = lock.read_text(encoding="ascii") if holder else ""
    except OSError:
        return None
    return holder if f'"pid": {holder}}}' in lock_text else None
