"""The present state of the cell, as the console reports it."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from coupole.console.cell.acquisitions import Acquisitions
from coupole.console.cell.bench_keeper import Bench
from coupole.console.people.sessions import Control
from coupole.console.plans.outlook import expected_times
from coupole.console.plans.plan_queue import PlanQueue
from coupole.console.routes.messages import EntryNow, StateNow
from coupole.errors import CoupoleError
from coupole.plan import yamlfile
from coupole.plan.cell import Cell
from coupole.plan.rig_devices import in_world
from coupole.storage.arm_faults import faults_of
from coupole.storage.ledger import Ledger
from coupole.storage.ledger_lines import History
from coupole.storage.line_file import utc_now, utc_text
from coupole.storage.run import Run

_NEWEST_S = 0.1
_ENDED_TOLD = 20


class Newest:
    """A state that a separate thread renews; the number of readers does not matter."""

    def __init__(self, make: Callable[[], StateNow]) -> None:
        self._make, self._state = make, make()
        threading.Thread(target=self._renew, name="newest state", daemon=True).start()

    def __call__(self) -> StateNow:
        return self._state

    def _renew(self) -> None:
        while True:
            time.sleep(_NEWEST_S)
            try:
                self._state = self._make()
            except Exception as error:  # noqa: BLE001  the old one must not be taken for what is so
                self._state = self._state.model_copy(update={"trouble": str(error), "t": utc_now()})


def state_of(
    cell: Cell,
    queue: PlanQueue,
    acquisitions: Acquisitions,
    bench: Bench,
    control: Control,
    *,
    checking: str,
    trouble: str,
) -> StateNow:
    """Return the present state of the cell; `checking` describes the preflight that is being made."""
    at_work, entry = acquisitions.state or {}, queue.running
    if not at_work:
        _forget_runs()
    own_state = "halted" if queue.halt_reason else "idle"
    if entry is not None:
        own_state = "concluding" if entry.run else "starting"
    faults = faults_of(cell).standing()
    return StateNow(
        state=at_work.get("state", own_state),
        rig=cell.rig.name,
        simulated=in_world(cell.rig, dry_run=False),
        run=Path(at_work["run"]).name if at_work else None,
        view=at_work.get("view"),
        proven=at_work.get("proven", 0),
        frames=at_work.get("frames", 0),
        dose=at_work.get("dose_lux_h", 0.0),
        **(_object_of(cell, at_work["run"]) if at_work else _NO_OBJECT),
        left_s=at_work.get("left_s"),
        halted=queue.halt_reason,
        arm_fault=faults[-1].message if faults else "",
        devices=_devices(at_work["run"]) if at_work else bench.identities,
        lent_to=acquisitions.lending.lent_to,
        queue=_entries_now(queue, at_work.get("left_s")),
        checking=checking,
        in_control=control.now.name,
        asked_by=control.now.asked_by,
        trouble=trouble,
        t=utc_now(),
    )


def _entries_now(queue: PlanQueue, left_s: float | None) -> list[EntryNow]:
    times = expected_times(queue.entries, datetime.now(UTC), left_s=left_s, is_halted=bool(queue.halt_reason))
    ended_ids = [entry.id for entry in queue.entries if entry.ended]
    entries = []
    for entry in queue.entries:
        if entry.id in ended_ids[:-_ENDED_TOLD]:
            continue
        begin, end = (
            utc_text(_rounded_to_10_s(time)) if time else None for time in times.get(entry.id, (None, None))
        )
        entries.append(EntryNow(**dict(entry), expected_begin=begin, expected_end=end))
    return entries


def _rounded_to_10_s(time: datetime) -> datetime:
    """Round a time to 10 s, so that an expected time does not change at every update."""
    return datetime.fromtimestamp(round(time.timestamp(), -1), UTC)


def _devices(run: str) -> dict[str, Any]:
    """Return the identities of a run's devices; none if they cannot be read."""
    try:
        return _devices_when(run)
    except (CoupoleError, KeyError):
        return {}


@functools.lru_cache(4)
def _devices_when(run: str) -> dict[str, Any]:
    """Return the identities of a run's devices, which do not change during a session. Raises InputError,
    KeyError."""
    return dict(Run(Path(run)).about["devices"])


_NO_OBJECT = {"object": "", "dose_before": 0.0, "dose_budget": None}


def _object_of(cell: Cell, run: str) -> dict[str, Any]:
    """Return the object of a run that is being acquired, the light on it from other runs, and its budget. Light
    and budget are those of the ledger now. Without an object, or if it cannot be read, return empty values."""
    try:
        ledger, object_id, plans_budget = _ledger_when(cell.ledger_folder, cell.former_ledger_folder, run)
        history = ledger.newest() if ledger else History()
    except CoupoleError:
        return _NO_OBJECT
    name = Path(run).name
    before = sum(entry.dose_lux_h for entry in history.entries if entry.run != name)
    return {"object": object_id, "dose_before": before, "dose_budget": history.allowed_lux_h(plans_budget)}


@functools.lru_cache(4)
def _ledger_when(ledgers: Path, former: Path, run: str) -> tuple[Ledger | None, str, float | None]:
    """Return the ledger of a run's object, its id, and its budget by the plan; they do not change during a
    session. Raises InputError."""
    opened_run = Run(Path(run))
    object_id = opened_run.about.get("object") or ""
    budget = (yamlfile.read_document(opened_run.plan_path).data.get("object") or {}).get("dose_budget_lux_h")
    return Ledger(ledgers, object_id, former) if object_id else None, object_id, budget


def _forget_runs() -> None:
    """Read a run again if it is resumed later, because its object may have received other light meanwhile."""
    _devices_when.cache_clear()
    _ledger_when.cache_clear()
