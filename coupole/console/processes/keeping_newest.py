"""Folders of temporary files of a console, such as pictures: only the newest are kept."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path


def keep_newest(folder: Path, count: int) -> None:
    """Remove all files and folders from a folder except the `count` that were written last."""
    times_and_paths = []
    for path in folder.iterdir() if folder.is_dir() else ():
        with contextlib.suppress(OSError):  # another thread has removed it meanwhile
            times_and_paths.append((path.stat().st_mtime_ns, path))
    for _, path in sorted(times_and_paths)[: max(0, len(times_and_paths) - count)]:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                path.unlink()
