"""The result of the views so far, in the folder of a result that is made beside an acquisition.

::

    RESULT/so-far           link to the newest of them, until the result is whole
    RESULT/beside/RUN-2-of-3-views-1a2b3c4d/

Each of these folders is a complete result, which any command opens. It is put in its place when it is complete.
The one before it stays, because somebody may be reading it; older ones are removed.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

from coupole.errors import InputError
from coupole.storage.processing import FOLDER, RESULT

LINK, REPORT = "so-far", "report.html"
KEY = "so_far"
"""Key of the settings and of result.json: views of the result, and of the run's plan."""
_KEPT, _FOLDERS = 2, "*-of-*-views-*/"


def new_folder(result: Path, run: str, views: int, of: int) -> Path:
    """Return a new folder for the result of some views of a run. It is another folder each time, because the link
    may lead to an earlier result of the same views."""
    return result / FOLDER / f"{run}-{views}-of-{of}-views-{uuid4().hex[:8]}"


def remove_halves(result: Path) -> None:
    """Remove results that a killed process left incomplete."""
    for folder in (result / FOLDER).glob(_FOLDERS):
        if not (folder / RESULT).exists():
            shutil.rmtree(folder, ignore_errors=True)


def put_in_place(result: Path, new_folder: Path) -> None:
    """Let the link lead to the new result of the views so far. Remove results that nobody reads any more. Raises
    OSError."""
    link = result / f"{LINK}.part"
    link.unlink(missing_ok=True)
    link.symlink_to(new_folder.relative_to(result))
    link.replace(result / LINK)
    older = sorted(new_folder.parent.glob(_FOLDERS), key=lambda folder: folder.stat().st_mtime_ns)
    older = [folder for folder in older if folder != new_folder]
    for folder in older[: max(0, len(older) - (_KEPT - 1))]:
        shutil.rmtree(folder, ignore_errors=True)


def remove(result: Path) -> None:
    """Remove the link when the result is complete."""
    with contextlib.suppress(FileNotFoundError):
        (result / LINK).unlink()


def as_it_is_now(result: Path) -> Path:
    """Return the folder that a reader opens; no later view replaces it. It is the result of the views so far until
    the result itself is complete, then the result itself."""
    link = result if result.is_symlink() and result.name == LINK else result / LINK
    if (result / RESULT).exists() and link != result:
        return result
    return link.resolve() if link.is_symlink() and link.exists() else result


@contextmanager
def reading(result: Path) -> Iterator[Path]:
    """Give the folder that a reader opens (`as_it_is_now`). An error is raised as InputError if a result of more
    views has replaced the folder meanwhile."""
    folder = as_it_is_now(result)
    try:
        yield folder
    except Exception as error:
        if _is_replaced(folder):
            raise InputError(
                f"{folder}: a result of more views has replaced it meanwhile; give the command again"
            ) from error
        raise


def _is_replaced(folder: Path) -> bool:
    return folder.match(f"{FOLDER}/{_FOLDERS}") and (folder.parent.parent / LINK).resolve() != folder


def figures(about: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures for `--json`; empty for a complete result."""
    return {KEY: about[KEY]} if KEY in about else {}


def words(about: Mapping[str, Any]) -> str:
    """Say how many of the views a result has; empty for a complete result."""
    if KEY not in about:
        return ""
    views, of = about[KEY]["views"], about[KEY]["of"]
    return f"made from {views} of {of} views so far: the run goes on, and values will change"
