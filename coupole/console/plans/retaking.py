"""A plan that takes one view of a run again, with the settings of the run."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from coupole.errors import InputError
from coupole.plan.plan import Grid, Plan, View
from coupole.plan.reading import read_plan
from coupole.plan.rewriting import named_paths
from coupole.plan.schedule import views_of_grid
from coupole.storage.run import Run


def retaking_plan(run: Run, view: str, name: str, rig: Path) -> str:
    """Return the text of a plan called `name` with one view of a run, on this rig. Its other files are the copies
    in the run. Raises InputError if there is no such view, or if the run's plan cannot be read."""
    files = read_plan(run.plan_path)
    plan = files.plan
    view_keys = next(
        (candidate for candidate in map(_single, _single_views(plan)) if candidate["name"] == view), None
    )
    if view_keys is None:
        raise InputError(f"{view!r}: no view of {run.folder.name}")
    whole = plan.model_dump(mode="json", exclude_unset=True)
    for key_path, path in named_paths(plan):
        *parents, last = key_path
        part: Any = whole
        for key in parents:
            part = part[key]
        part[last] = str(files.document.resolve(path))
    whole |= {"name": name, "rig": str(rig.resolve()), "views": [view_keys]}
    return (
        f"# View {view} of {run.folder.name}, once more.\n"
        + json.dumps(whole, indent=1, ensure_ascii=False)
        + "\n"
    )


def name_of_retake(run: Run, view: str, taken_names: set[str]) -> str:
    """Return a name for the plan that is not used yet."""
    run_name = run.folder.name.partition("-")[2]
    stem = re.sub(r"[^\w.-]", "-", f"{run_name}-{view}")[:48]
    return next(name for k in range(1, len(taken_names) + 2) if (name := f"{stem}-again{k}") not in taken_names)


def _single_views(plan: Plan) -> list[View]:
    views: list[View] = []
    for view in plan.view_entries:
        views += views_of_grid(view) if isinstance(view, Grid) else [view]
    return views


def _single(view: View) -> dict[str, Any]:
    view_keys: dict[str, Any] = view.model_dump(mode="json", exclude_unset=True)
    return view_keys
