"""The folder of a running world: clock, sockets; in memory where the machine has such a place.

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
    """A folder of one's own in `scratch`, removed at the end; those of killed worlds are removed first."""
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
    """One world at a time makes its folder, so that none is taken for abandoned before it holds its lock."""
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
