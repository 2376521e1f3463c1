"""A result folder that is being made: begun once, then filled with one complete file after the other."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

from coupole.errors import InputError, reason
from coupole.intake.plain_data import read_json
from coupole.storage import processing
from coupole.storage.durable import make_folder, sync_folder

SETTINGS = "settings.json"


def begin(out: Path, settings: dict[str, Any]) -> None:
    """Make the folder, or continue in it; refuse one that was begun with other input or settings."""
    path = out / SETTINGS
    text = json.dumps(settings) + "\n"
    if path.exists():
        if path.read_text(encoding="utf-8") != text:
            raise InputError(
                f"{out} holds the result of other input, settings or version: name another folder with --out"
            )
    elif _has_other_content(out):
        raise InputError(f"{out} is not empty, and holds no result: name another folder with --out")
    else:
        make_folder(out)
        complete(path, lambda part: part.write_text(text, encoding="utf-8"))
    clear_remains(out)
    for name in ("samples", "fits"):
        make_folder(out / name)


def _has_other_content(out: Path) -> bool:
    """Tell whether a folder holds anything besides the remains of a killed writer and of processing beside a
    run."""
    if not out.exists() or (out / processing.FOLDER).is_dir():
        return False
    return any(content.suffix != ".part" for content in out.iterdir())


def read_settings(out: Path) -> dict[str, Any]:
    """Read the settings with which a result was begun. Raises InputError if there are none."""
    path = out / SETTINGS
    try:
        settings = read_json(path, allow_nan=True)
        if not isinstance(settings, dict) or "view_names" not in settings:
            raise ValueError("found others")
    except (OSError, InputError, ValueError) as error:
        raise InputError(f"{path}: expected the settings of a result of runs; {reason(error)}") from error
    if not {"subtracted", "refined"} <= set(settings):
        raise InputError(f"{path}: was begun by an earlier version; make the result again, with another --out")
    return settings


def clear_remains(out: Path) -> None:
    """Remove the remains of writers that were killed."""
    for part in out.rglob("*.part"):
        part.unlink(missing_ok=True)


def complete(path: Path, write: Callable[[Path], Any], *, unless: Path | None = None) -> None:
    """Call `write` for a file beside `path`, then move this file to `path`. The file is complete or missing, also
    after a crash. It is not moved if `unless` exists by then, because another process has made the file
    meanwhile."""
    with in_the_making(path, unless) as part:
        write(part)


@contextmanager
def in_the_making(path: Path, unless: Path | None = None) -> Iterator[Path]:
    """Yield the path of a part file, which replaces `path` when it is complete and no error occurred. Its name is
    used only once, so a writer that was taken for dead does not disturb another writer."""
    part = path.with_name(f"{path.name}.{uuid4().hex}.part")
    path.parent.mkdir(exist_ok=True)
    try:
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        if unless is None or not unless.exists():
            part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    sync_folder(path.parent)
