"""Folders for what the console makes of a run: outside of the run's folder, below the cell's storage folder."""

from __future__ import annotations

from pathlib import Path

from coupole.plan.cell import Cell
from coupole.storage.run import Run

RESULTS = "results"


def results_folder(cell: Cell, run: Run) -> Path:
    """`STORAGE/results/RUN`."""
    return cell.storage_folder / RESULTS / run.folder.name


def export_folder(cell: Cell, run: Run, form: str) -> Path:
    return results_folder(cell, run) / f"export-{form}"


def reflectance_folder(cell: Cell, run: Run) -> Path:
    return results_folder(cell, run) / "reflectance"


def look_page(cell: Cell, run: Run) -> Path:
    """Return the path of the page that `coupole show` makes."""
    return results_folder(cell, run) / "look.html"


def stands_alone(page: Path) -> bool:
    """Tell whether a page to look at has all its data in itself."""
    return page.is_file() and not page.with_suffix(".data").exists()
