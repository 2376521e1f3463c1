"""Log of the requests at the console and their senders: `audit.jsonl` has a line for each request that would
change something, with its answer, also if it was refused.
"""

from __future__ import annotations

import json
import threading
from pathlib import Path

from coupole.errors import StorageError
from coupole.storage.durable import make_folder
from coupole.storage.line_file import LineFile, utc_now


class Audit:
    """The log of one cell's console.

    Raises StorageError if it cannot be opened. Later, `trouble` reports that the log could not be written, because
    a stop must not wait for a disk.
    """

    def __init__(self, path: Path) -> None:
        make_folder(path.parent)
        self._file, self._lock = LineFile(path), threading.Lock()
        self.trouble = ""

    def note(self, name: str, action: str, status: int, address: str, about: str = "") -> None:
        """Log a request of `name` (empty if nobody is signed in) at `address`, with the HTTP status of its answer.
        `about` adds what the path does not say."""
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
