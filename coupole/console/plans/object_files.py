"""Objects that a console knows: their ledgers, their photographs, and the plans and runs that name them."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path

from coupole.console.plans.plan_files import PlanFiles
from coupole.console.runs.run_files import RunFiles, RunRow
from coupole.errors import CoupoleError, InputError, StorageError
from coupole.plan import yamlfile
from coupole.plan.base_model import NAME_PATTERN
from coupole.plan.cell import Cell
from coupole.storage.durable import make_folder, write_synced
from coupole.storage.ledger import ledger_of, similar_ids
from coupole.storage.ledger_lines import History

_PHOTOGRAPH_PX = 1600


@dataclass(frozen=True)
class NamedBy:
    """A plan that names an object."""

    plan: str
    mesh: bool
    budget_lux_h: float | None


class ObjectFiles:
    """Objects by their ids: accession numbers."""

    def __init__(self, cell: Cell, plans: PlanFiles, runs: RunFiles, folder: Path) -> None:
        """`folder`: for photographs."""
        self._cell, self._plans, self._runs, self._folder = cell, plans, runs, folder

    def ids(self) -> list[str]:
        """Return the ids of all objects that a plan, a run or a ledger names."""
        ledgers = [*self._cell.ledger_folder.glob("*.jsonl"), *self._cell.former_ledger_folder.glob("*.jsonl")]
        object_ids = {path.stem for path in ledgers}
        object_ids |= {row.object for row in self._runs.rows() if row.object}
        object_ids |= set(self._plans_by_object())
        return sorted(object_ids)

    def plans_of(self, object_id: str) -> list[NamedBy]:
        return self._plans_by_object().get(object_id, [])

    def runs_of(self, object_id: str) -> list[RunRow]:
        """Return the runs of an object, the newest first."""
        return [row for row in self._runs.rows() if row.object == object_id]

    def history(self, object_id: str) -> History:
        """Return all light on an object. Raises InputError, StorageError."""
        return ledger_of(self._cell, object_id).read_history()

    def similar(self, object_id: str) -> list[str]:
        """Return other ids that are nearly the same."""
        return similar_ids(self._cell.ledger_folder, object_id)

    def enter_light(self, object_id: str, dose_lux_h: float, note: str) -> None:
        """Enter light that was given elsewhere. Raises InputError, StorageError."""
        if not note.strip() or not 0 < dose_lux_h < 1e9:
            raise InputError("expected lux hours, above 0, and a note about the light")
        ledger_of(self._cell, object_id).enter(dose_lux_h, note.strip())

    def set_budget(self, object_id: str, dose_lux_h: float, name: str, reason: str) -> None:
        """Set the total light that an object may receive. Raises InputError, StorageError."""
        ledger_of(self._cell, object_id).set_budget(dose_lux_h, name, reason)

    def photograph(self, object_id: str) -> Path | None:
        path = self._photograph_path(object_id)
        return path if path.is_file() else None

    def keep_photograph(self, object_id: str, data: bytes) -> None:
        """Store a photograph and replace the former one. Raises InputError if it is not a picture."""
        from PIL import Image, ImageOps, UnidentifiedImageError

        try:
            with Image.open(io.BytesIO(data)) as image:
                picture = ImageOps.exif_transpose(image).convert("RGB")
        except (UnidentifiedImageError, OSError, ValueError, Image.DecompressionBombError) as error:
            raise InputError("expected a picture: JPEG, PNG or TIFF") from error
        picture.thumbnail((_PHOTOGRAPH_PX, _PHOTOGRAPH_PX))
        out = io.BytesIO()
        picture.save(out, "JPEG", quality=88)
        path = self._photograph_path(object_id)
        try:
            make_folder(path.parent)
            write_synced(path, out.getvalue())
        except OSError as error:
            raise StorageError(f"{path}: {error.strerror}") from error

    def _photograph_path(self, object_id: str) -> Path:
        if not re.fullmatch(NAME_PATTERN, object_id):
            raise InputError(f"object: expected an id as in a plan; found {object_id!r}")
        return self._folder / f"{object_id}.jpg"

    def _plans_by_object(self) -> dict[str, list[NamedBy]]:
        plans_by_object: dict[str, list[NamedBy]] = {}
        for name in self._plans.names():
            try:
                object_keys = yamlfile.parse(self._plans.path(name), self._plans.read_text(name)).data.get(
                    "object"
                )
            except CoupoleError:
                continue
            if isinstance(object_keys, dict) and isinstance(object_keys.get("id"), str):
                budget = object_keys.get("dose_budget_lux_h")
                named_by = NamedBy(
                    name, bool(object_keys.get("mesh")), budget if isinstance(budget, int | float) else None
                )
                plans_by_object.setdefault(object_keys["id"], []).append(named_by)
        return plans_by_object
