"""The demo's plan in another folder, for tools that change it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML


def write_demo_plan(root: Path, folder: Path, **entries: Any) -> Path:
    """Write `demo.yaml` with changed entries to a folder; return its path. Files are named by absolute paths."""
    plans = root / "configs/plans"
    plan = YAML(typ="safe", pure=True).load(plans / "demo.yaml")

    def absolute(name: str) -> str:
        return str((plans / name).resolve())

    plan["rig"] = absolute(plan["rig"])
    plan["object"]["mesh"] = absolute(plan["object"]["mesh"])
    plan["calibrations"] = [absolute(name) for name in plan["calibrations"]]
    path = folder / "demo.yaml"
    path.write_text(json.dumps(plan | entries))
    return path
