"""The folder of plans: names, texts, new plans."""

from __future__ import annotations

import os
import re
import secrets
import threading
from pathlib import Path

from coupole.console.plans.retaking import name_of_retake, retaking_plan
from coupole.console.processes.keeping_newest import keep_newest
from coupole.errors import InputError, StorageError
from coupole.plan import yamlfile
from coupole.plan.base_model import NAME_PATTERN
from coupole.plan.templates import TEMPLATES
from coupole.storage.durable import write_synced
from coupole.storage.run import Run

_DEEPEST = 3
_LONGEST = 1_000_000
_DRAWINGS_KEPT = 50


class PlanFiles:
    """Plans below a folder, by their paths relative to it."""

    def __init__(self, folder: Path, rig: Path, drawings: Path) -> None:
        """`rig` is written into new plans. `drawings` is the folder for pictures of plans, of which the newest are
        kept."""
        self.folder, self._rig, self.drawings = folder.resolve(), rig.resolve(), drawings
        self._lock = threading.Lock()
        keep_newest(drawings, _DRAWINGS_KEPT)

    def new_drawing(self) -> Path:
        """Return a new folder for pictures of a plan; it does not exist yet."""
        keep_newest(self.drawings, _DRAWINGS_KEPT - 1)
        return self.drawings / secrets.token_hex(8)

    def names(self) -> list[str]:
        """Return the names of all plans, sorted. A plan is a file with `views`."""
        names = []
        for path in self.folder.rglob("*.yaml"):
            inside = path.relative_to(self.folder)
            if len(inside.parts) <= _DEEPEST and not any(part.startswith(".") for part in inside.parts):
                try:
                    if re.search(r'^\s*"?views"?\s*:', path.read_text(encoding="utf-8"), re.MULTILINE):
                        names.append(str(inside))
                except (OSError, UnicodeDecodeError):
                    continue
        return sorted(names)

    def path(self, name: str) -> Path:
        """Return the file of a plan. Raises InputError if it is not below the folder."""
        path = (self.folder / name).resolve()
        if not name or not path.is_relative_to(self.folder) or path.suffix != ".yaml":
            raise InputError(f"plan: expected a .yaml file below {self.folder}; found {name!r}")
        return path

    def read_text(self, name: str) -> str:
        """Return the text of a plan. Raises InputError."""
        return yamlfile.text_of(self.path(name))

    def create(self, name: str, template: str) -> str:
        """Make a new plan with its file; return its name. Raises InputError for an invalid name, and if the plan
        exists."""
        if not re.fullmatch(NAME_PATTERN, name):
            raise InputError(
                f"{name!r}: expected letters, digits, dots, hyphens and underscores, a letter or digit first"
            )
        path = self.path(f"{name}.yaml")
        rig = _from(self.folder, self._rig)
        text = _ROUND if template == "round" else TEMPLATES.get(template)
        if text is None:
            raise InputError(f"template: expected round, {', '.join(TEMPLATES)}; found {template!r}")
        with self._lock:
            if path.exists():
                raise InputError(f"{path.name}: exists already; choose another name")
            self._write(path, text.format(name=name, rig=rig))
        return path.name

    def retake(self, run: Run, view: str) -> str:
        """Make a plan that takes one view of a run again; return its name. Raises InputError, StorageError."""
        with self._lock:
            names_in_use = {Path(name).stem for name in self.names()}
            path = self.path(f"{name_of_retake(run, view, names_in_use)}.yaml")
            self._write(path, retaking_plan(run, view, path.stem, self._rig))
        return path.name

    def write(self, name: str, text: str, before: str) -> str:
        """Replace the text of a plan, which was `before`; return its name. Raises InputError if another person has
        changed it."""
        if len(text) > _LONGEST:
            raise InputError(f"{name}: expected at most {_LONGEST} characters")
        path = self.path(name)
        with self._lock:
            if not path.is_file() or yamlfile.text_of(path) != before:
                raise InputError(f"{name}: another person has changed this plan meanwhile; open it again")
            self._write(path, text)
        return name

    def _write(self, path: Path, text: str) -> None:
        try:
            write_synced(path, text)
        except OSError as error:
            raise StorageError(f"{path}: {error.strerror}") from error


def _from(folder: Path, path: Path) -> str:
    """Return a path in the form in which a file of this folder names it."""
    return os.path.relpath(path, folder)


_ROUND = """\
schema_version: 1
name: {name}
rig: {rig}
object:
  id: {name}
  dose_budget_lux_h: 50
views:
  - kind: grid
    name: round
    target_mm: [0, 0, 30]
    distance_mm: 335
    azimuths_deg: [-90, -45, 0, 45, 90, 135, -180, -135]
    elevations_deg: [35, 55, 75]
lights: {{kind: all}}
exposure: {{kind: fixed, exposure_us: 8000}}
darks_per_view: 2
"""
