"""The result of the views so far, in the folder of a result that is made beside an acquisition.

::

    RESULT/so-far           link to the newest of them, until the result is whole
    RESULT/beside/RUN-2-of-3-views/

Each is a whole result, which any command opens. It is put in its place when it is whole; the one before it stays
for those who read it, the one before that is removed.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coupole.storage.durable import make_folder
from coupole.storage.processing import FOLDER, RESULT

LINK, REPORT = "so-far", "report.html"
KEY = "so_far"
"""Key of the settings and of result.json: views of the result, and of the run's plan."""
_KEPT = 2


def folder_of(result: Path, run: str, views: int, of: int) -> Path:
    """Folder in which the result of some views of a run is made."""
    return result / FOLDER / f"{run}-{views}-of-{of}-views"


def put_in_place(result: Path, new_folder: Path) -> None:
    """Let the link lead to a result of the views so far that was just made; remove what nobody reads any more.
    Raises OSError."""
    make_folder(result)
    link = result / f"{LINK}.part"
    link.unlink(missing_ok=True)
    link.symlink_to(new_folder.relative_to(result))
    link.replace(result / LINK)
    older = sorted(new_folder.parent.glob("*-views/"), key=lambda folder: folder.stat().st_mtime_ns)
    for folder in [folder for folder in older if folder != new_folder][: 1 - _KEPT]:
        shutil.rmtree(folder, ignore_errors=True)


def remove(result: Path) -> None:
    """Remove the link, when the result is whole or is made anew."""
    with contextlib.suppress(FileNotFoundError):
        (result / LINK).unlink()


def as_it_is_now(result: Path) -> Path:
    """Return the folder that a reader opens, which no later view replaces: that of the views so far while the
    result itself is not whole; else the same."""
    link = result if result.is_symlink() and result.name == LINK else result / LINK
    if (result / RESULT).exists() and link != result:
        return result
    return link.resolve() if link.is_symlink() and link.exists() else result


def figures(about: Mapping[str, Any]) -> dict[str, Any]:
    """Return what `--json` says of it: empty for a result that is whole."""
    return {KEY: about[KEY]} if KEY in about else {}


def words(about: Mapping[str, Any]) -> str:
    """Say from how many views of how many a result is; empty for one that is whole."""
    if KEY not in about:
        return ""
    views, of = about[KEY]["views"], about[KEY]["of"]
    return f"made from {views} of {of} views so far: the run goes on, and values will change"
