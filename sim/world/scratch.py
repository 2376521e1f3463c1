"""The folder of a running world, with clock and sockets. It is in memory if the machine has a place for this.

A world that is killed cannot remove its folder, so the next world removes the folders of worlds that are gone.
Each world holds a lock on its own folder as long as it lives.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

SCRATCH = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path(tempfile.gettempdir())
_PREFIX = "coupole-world-"
_LOCK = "lock"


@contextmanager
def world_folder(scratch: Path = SCRATCH) -> Iterator[Path]:
    """Give a folder for this world in `scratch`, which is removed at the end. Folders of killed worlds are removed
    first."""
    with _beginning(scratch):
        _remove_abandoned(scratch)
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=scratch))
        lock = (folder / _LOCK).open("w")
        fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        lock.close()


@contextmanager
def _beginning(scratch: Path) -> Iterator[None]:
    """Let one world at a time make its folder, so that no folder seems abandoned before its world holds the
    lock."""
    with (scratch / f"coupole-worlds-{os.getuid()}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _remove_abandoned(scratch: Path) -> None:
    for path in scratch.glob(f"{_PREFIX}*/{_LOCK}"):
        with contextlib.suppress(OSError), path.open("r+") as file:
            if _is_free(file):
                shutil.rmtree(path.parent, ignore_errors=True)


def _is_free(file: IO[str]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
