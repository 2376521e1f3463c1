"""Log of requests at the console and their authors: `audit.jsonl`, a line for each request that would change
something, with its answer; also if it was refused.
"""

from __future__ import annotations

import json
import threading
from pathlib import Path

from coupole.errors import StorageError
from coupole.storage.durable import make_folder
from coupole.storage.line_file import LineFile, utc_now


class Audit:
    """The log of one cell's console. Raises StorageError when it is opened; later `trouble` says that it could not
    be written, as a stop must not wait for a disk."""

    def __init__(self, path: Path) -> None:
        make_folder(path.parent)
        self._file, self._lock = LineFile(path), threading.Lock()
        self.trouble = ""

    def note(self, name: str, action: str, status: int, address: str, about: str = "") -> None:
        """`name` (empty: nobody who is signed in) at `address` asked for something, and got this HTTP status;
        `about`: what of it the path does not say."""
        line = {"t": utc_now(), "name": name, "asked": action, "status": status, "from": address}
        if about:
            line["about"] = about
        try:
            with self._lock:
                self._file.append([json.dumps(line, ensure_ascii=False) + "\n"])
            self.trouble = ""
        except StorageError as error:
            self.trouble = f"the log cannot be written: {error}"

    def close(self) -> None:
        self._file.close()
