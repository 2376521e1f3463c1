"""Folders of files that a console makes for a while, such as pictures: the newest are kept."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path


def keep_newest(folder: Path, count: int) -> None:
    """Take all files and folders out of a folder but the `count` that were written last."""
    times_and_paths = []
    for path in folder.iterdir() if folder.is_dir() else ():
        with contextlib.suppress(OSError):  # another took it away while we looked
            times_and_paths.append((path.stat().st_mtime_ns, path))
    for _, path in sorted(times_and_paths)[: max(0, len(times_and_paths) - count)]:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                path.unlink()
