"""Marks of cells whose devices a process has open, in the user's runtime folder.

A mark is a lock of an open file (`F_OFD_SETLK` of Linux). It ends with its process, however the process ends. A
process that only asks queries the lock (`F_OFD_GETLK`) and never takes it, so a session can always mark its cell.

There is one mark for each place of the cell's arm (`coupole.plan.controller_places`). So rigs that name the same
controller exclude each other. Sessions with simulated worlds of their own share no device, and do not exclude each
other.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from coupole.acquisition.runtime_folder import named_after
from coupole.errors import InputError, StorageError, reason
from coupole.plan.cell import Cell
from coupole.plan.controller_places import places_of_arm
from coupole.plan.rig_devices import in_world

OPEN_ELSEWHERE = (
    "another process has this cell's devices open (acquire, live, meter, bench, calibrate, commission)"
)
_KIND = "in-use"
_LOCK = "hhqqi4x"
"""`struct flock` of 64-bit Linux: type, whence, start, length (0: the whole file), process (0)."""
_GRACE_S, _NAP_S = 2.0, 0.01
"""Time within which a process that has just ended gives up its mark."""


@contextmanager
def in_use(cell: Cell) -> Iterator[None]:
    """Mark the cell as in use: while the context lasts, `is_in_use` is true of it.

    Raises InputError if another session has the devices of a cell that only one session can have. Raises
    StorageError if the cell cannot be marked, because others would not know of this session. A session with a
    world of its own needs no mark.
    """
    alone = _alone(cell)
    with contextlib.ExitStack() as stack:
        for place in places_of_arm(cell):
            try:
                file = stack.enter_context(named_after(place, _KIND).open("a+b"))
                _lock(file.fileno(), alone=alone)
            except BlockingIOError as error:
                raise InputError(f"{cell.document.path}: {OPEN_ELSEWHERE}; end it first") from error
            except (OSError, InputError) as error:
                if alone:
                    raise StorageError(f"{place}: cannot mark the cell as in use: {reason(error)}") from error
        yield


def is_in_use(cell: Cell) -> bool:
    """Tell whether a process of this user on this machine has the devices of the cell open."""
    return any(map(_is_locked, places_of_arm(cell)))


def _alone(cell: Cell) -> bool:
    """Tell whether all sessions have the same devices."""
    world = cell.rig.world
    return not in_world(cell.rig, dry_run=False) or (world is not None and world.join is not None)


def _lock(fd: int, *, alone: bool) -> None:
    """Raises BlockingIOError if another process has the lock."""
    kind = fcntl.F_WRLCK if alone else fcntl.F_RDLCK
    end_s = time.monotonic() + _GRACE_S
    while True:
        try:
            fcntl.fcntl(fd, fcntl.F_OFD_SETLK, struct.pack(_LOCK, kind, os.SEEK_SET, 0, 0, 0))
        except (BlockingIOError, PermissionError):  # EAGAIN or EACCES, as fcntl(2) has it
            if time.monotonic() > end_s:
                raise BlockingIOError from None
            time.sleep(_NAP_S)
        else:
            return


def _is_locked(place: Path) -> bool:
    try:
        with named_after(place, _KIND).open("rb") as file:
            query = struct.pack(_LOCK, fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
            reply = fcntl.fcntl(file, fcntl.F_OFD_GETLK, query)
    except OSError:  # nobody has ever opened them
        return False
    return bool(struct.unpack(_LOCK, reply)[0] != fcntl.F_UNLCK)
