"""Facts about machine and rig for the console: disk space, values of the rig that are not measured yet, the
log."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from coupole.console.runs.run_files import RunRow
from coupole.errors import CoupoleError, InputError
from coupole.intake.plain_data import json_of
from coupole.plan import yamlfile
from coupole.plan.cell import Cell

_MEASURE = re.compile(r"\s*#\s*measure\b:?\s*(.*)", re.IGNORECASE)
_LOG_BYTES = 2_000_000
NOTIFICATIONS = "notifications.yaml"


@dataclass(frozen=True)
class Disk:
    """Disk with the runs; all sizes in bytes."""

    total: int
    free: int
    runs: int
    """Size of the cell's runs."""
    reserve: int
    """Space that a run leaves free."""
    frame: int
    """Size of a frame of this rig."""

    @property
    def frames_left(self) -> int:
        """Number of frames of this rig that fit on the disk, uncompressed."""
        return max(0, self.free - self.reserve) // self.frame


@dataclass(frozen=True)
class ToMeasure:
    """A key of the rig whose comment says that its value must be measured."""

    line: int
    key: str
    why: str


def disk_of(cell: Cell, rows: Sequence[RunRow]) -> Disk:
    """Return the facts of the disk with the cell's storage folder and these runs."""
    folder = cell.storage_folder
    while not folder.exists():
        folder = folder.parent
    usage = shutil.disk_usage(folder)
    reserve = cell.rig.storage.reserve_bytes
    return Disk(usage.total, usage.free, sum(row.bytes for row in rows), reserve, cell.rig.frame_bytes)


def to_measure(rig: Path) -> list[ToMeasure]:
    """Return the keys of a rig's file below comments `# Measure: ...`."""
    lines = rig.read_text(encoding="utf-8").splitlines()
    keys = []
    for number, line in enumerate(lines, 1):
        if why := _MEASURE.fullmatch(line):
            key = next((text.split(":")[0].strip(" -{") for text in lines[number:] if _is_entry(text)), "")
            keys.append(ToMeasure(number, key, why[1]))
    return keys


def _is_entry(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def log_lines(path: Path) -> list[dict[str, Any]]:
    """Return the newest lines of the console's log, the newest first."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _LOG_BYTES))
            lines = file.read().split(b"\n")
    except OSError:
        return []
    entries = []
    for line in reversed(lines):
        try:
            entries.append(dict(json_of(line, str(path), allow_nan=True)))
        except (InputError, ValueError, TypeError):
            continue
    return entries


def notifications(folder: Path) -> dict[str, str]:
    """Return the receivers and the events of `notifications.yaml` in the console's folder, without passwords;
    empty if there is no such file.
    """
    path = folder / NOTIFICATIONS
    if not path.is_file():
        return {}
    try:
        data: dict[str, Any] = yamlfile.read_document(path).data
        email, hooks = data.get("email") or {}, data.get("webhooks") or ()
        return {
            "of": ", ".join(map(str, data.get("events") or ())) or "everything",
            "by e-mail to": ", ".join(map(str, email.get("to") or ())) or "nobody",
            "to addresses at": ", ".join(urlsplit(str(hook["url"])).hostname or "" for hook in hooks) or "none",
            "on this desktop": "yes" if data.get("desktop") else "no",
        }
    except (CoupoleError, AttributeError, KeyError, TypeError) as error:
        return {"trouble": f"{path}: cannot be read: {error}"}
