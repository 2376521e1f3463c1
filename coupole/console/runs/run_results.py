"""Folders for the results that the console makes from a run: outside the run's folder, in the cell's storage
folder."""

from __future__ import annotations

from pathlib import Path

from coupole.plan.cell import Cell
from coupole.storage.run import Run

RESULTS = "results"


def results_folder(cell: Cell, run: Run) -> Path:
    """Return `STORAGE/results/RUN`."""
    return cell.storage_folder / RESULTS / run.folder.name


def export_folder(cell: Cell, run: Run, form: str) -> Path:
    return results_folder(cell, run) / f"export-{form}"


def reflectance_folder(cell: Cell, run: Run) -> Path:
    return results_folder(cell, run) / "reflectance"


def look_page(cell: Cell, run: Run) -> Path:
    """Return the path of the page that `coupole show` makes from the run."""
    return results_folder(cell, run) / "look.html"


def stands_alone(page: Path) -> bool:
    """Tell whether a page contains all its data."""
    return page.is_file() and not page.with_suffix(".data").exists()
