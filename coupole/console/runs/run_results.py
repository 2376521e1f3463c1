"""Where the console puts what is made of a run: outside of its folder, below the cell's storage folder."""

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
    """What `coupole show` makes."""
    return results_folder(cell, run) / "look.html"


def stands_alone(page: Path) -> bool:
    """Whether a page to look at has all its data in itself."""
    return page.is_file() and not page.with_suffix(".data").exists()
