"""Who did what at the console: `audit.jsonl`, a line for each request that changes something, also if it was
refused."""

from __future__ import annotations

import json
from pathlib import Path

from coupole.storage.durable import make_folder
from coupole.storage.line_file import LineFile, utc_now


class Audit:
    """The log of one cell's console. Raises StorageError: what cannot be logged is not done."""

    def __init__(self, path: Path) -> None:
        make_folder(path.parent)
        self._file = LineFile(path)

    def note(self, name: str, action: str, outcome: str, **what: str) -> None:
        """`name` did `action`; on the disk when this returns."""
        line = {"t": utc_now(), "name": name, "action": action, "outcome": outcome, **what}
        self._file.append([json.dumps(line, ensure_ascii=False) + "\n"])

    def close(self) -> None:
        self._file.close()
