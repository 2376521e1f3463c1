"""The dose ledger of each object: `<storage>/ledger/<object id>.jsonl`.

Only real light counts: simulated and dry runs do not write here.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from coupole.errors import StorageError
from coupole.storage.line_file import LineFile, utc_now


def ledger_path(storage_folder: Path, object_id: str) -> Path:
    return storage_folder / "ledger" / f"{object_id}.jsonl"


def total_lux_h(storage_folder: Path, object_id: str) -> float:
    """Sum of all doses in the object's ledger, lux hours. An incomplete line (after a crash) is ignored."""
    path = ledger_path(storage_folder, object_id)
    try:
        lines = path.read_bytes().splitlines()
    except FileNotFoundError:
        return 0.0
    except OSError as error:
        raise StorageError(f"{path}: cannot read the ledger: {error.strerror}") from error
    total = 0.0
    for line in lines:
        with contextlib.suppress(json.JSONDecodeError, UnicodeDecodeError):
            entry = json.loads(line)
            if isinstance(entry, dict) and entry.get("event") == "dose":
                total += float(entry["dose_lux_h"])
    return total


def add(storage_folder: Path, object_id: str, *, run: str, dose_lux_h: float) -> None:
    """Append a dose; it is on disk when this returns."""
    path = ledger_path(storage_folder, object_id)
    path.parent.mkdir(parents=True, exist_ok=True)
    entry = {"event": "dose", "t": utc_now(), "run": run, "dose_lux_h": round(dose_lux_h, 6)}
    ledger = LineFile(path)
    try:
        ledger.append([json.dumps(entry, separators=(",", ":")) + "\n"])
    finally:
        ledger.close()
