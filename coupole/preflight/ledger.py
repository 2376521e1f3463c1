"""Light that each object has received in its life here: `<storage>/ledger/<object id>.jsonl`.

Only real light counts: simulated and dry runs never write here.
"""

from __future__ import annotations

from pathlib import Path

from coupole.storage import journal
from coupole.storage.journal import Journal


def ledger_path(storage_folder: Path, object_id: str) -> Path:
    return storage_folder / "ledger" / f"{object_id}.jsonl"


def total_lux_h(storage_folder: Path, object_id: str) -> float:
    """Sum of all doses in the object's ledger, lux hours."""
    path = ledger_path(storage_folder, object_id)
    if not path.exists():
        return 0.0
    return sum(float(event["dose_lux_h"]) for event in journal.read(path) if event["event"] == "dose")


def add(storage_folder: Path, object_id: str, *, run: str, dose_lux_h: float) -> None:
    """Append a dose; it is on disk when this returns."""
    path = ledger_path(storage_folder, object_id)
    path.parent.mkdir(parents=True, exist_ok=True)
    ledger = Journal(path)
    try:
        ledger.write("dose", run=run, dose_lux_h=round(dose_lux_h, 6))
        ledger.commit()
    finally:
        ledger.close()
