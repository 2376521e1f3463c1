"""Reads and checks plans and runs, and enters them in the queue.

A separate process makes the preflight (`entry_preflight`). During an acquisition it does not measure the disk's
speed, because the measurement takes the whole speed of the disk.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from anyio import CapacityLimiter

from coupole.console.cell.acquisitions import Acquisitions
from coupole.console.plans.entry_preflight import EntryPreflight
from coupole.console.plans.outlook import at_work_of, too_little_disk, too_much_light
from coupole.console.plans.plan_queue import Entry, Needs, PlanQueue
from coupole.console.routes.messages import NewEntry
from coupole.errors import InputError, PreflightRefused, Problem
from coupole.plan.base_model import possible_path
from coupole.plan.cell import Cell, read_cell
from coupole.plan.reading import PlanFiles, read_plan
from coupole.plan.yamlfile import read_document
from coupole.preflight.files import Files
from coupole.storage.ledger import ledger_of
from coupole.storage.run import Run


class EntryRefused(InputError):
    """The entry may not be run; `exit_code` is the exit code of `coupole check`."""

    def __init__(self, problems: Sequence[Problem], exit_code: int = PreflightRefused.exit_code) -> None:
        super().__init__(problems)
        self.exit_code = exit_code


class Entering:
    """Decides what may enter one cell's queue."""

    def __init__(self, cell: Cell, plans: Path, queue: PlanQueue, acquisitions: Acquisitions) -> None:
        self._cell, self._plans, self._queue, self._acquisitions = cell, plans, queue, acquisitions
        self._rig = cell.document.path.resolve()
        self.preflight = EntryPreflight()
        self.one_at_a_time = CapacityLimiter(1)
        """Lets one thread at a time call `enter` and `move`, because each must count the entries made before."""

    def close(self) -> None:
        """End the present preflight."""
        self.preflight.close()

    def enter(
        self, request: NewEntry, by: str, *, by_command_line: bool, may_still: Callable[[], None] = lambda: None
    ) -> Entry:
        """Enter a plan, a run or a hold; return the new entry.

        The command line may name files anywhere; other clients only plans and runs in this cell's folders.
        `may_still` is called after the preflight; it raises if the person is no longer allowed. Raises InputError
        with all problems if the entry cannot be run; StorageError.
        """
        if bool(request.plan or request.resume) == bool(request.hold):
            raise InputError("expected either `plan` or `hold`, or `resume`")
        if request.hold:
            if request.now:
                raise InputError("`now`: a hold cannot be begun")
            return self._queue.add(by, before=request.before, hold=request.hold)
        for_command_line = request.output or request.with_mesh or request.result
        if not by_command_line and (for_command_line or (request.plan and request.resume)):
            raise InputError(
                "`output`, `with_mesh`, `result`, and `plan` together with `resume`, are only for the command line"
            )
        run = self._run(request.resume, anywhere=by_command_line) if request.resume else None
        plan = self._plan(request.plan, anywhere=by_command_line) if request.plan else None
        fields: dict[str, Any] = {
            "plan": str(plan.document.path.resolve()) if plan else "",
            "resume": str(run.folder) if run else "",
            "output": str(Path(request.output).resolve()) if request.output else "",
            "with_mesh": request.with_mesh,
            "reflectance": request.reflectance,
            "result": str(Path(request.result).resolve()) if request.result else "",
        }
        if request.now:
            return self._acquisitions.begin_at_once(by, **fields)
        files = plan or (read_plan(run.plan_path) if run else None)
        assert files is not None
        if files.plan.why_with_result and not (request.reflectance or (run and run.asked_result)):
            raise InputError([files.document.problem(("discard",), files.plan.why_with_result)])
        fields["needs"] = self._needs(files, fields, by)
        self._refuse(Entry(id="new", by=by, entered="", **fields), request.before)
        may_still()
        return self._queue.add(by, before=request.before, **fields)

    def move(self, number: str, before: str) -> None:
        """Move a waiting entry. Raises InputError if the entry does not wait, or if the new order exceeds an
        object's budget; StorageError."""
        reordered_entries = self._queue.order_after(number, before)
        if more := self._more_light(reordered_entries):
            raise EntryRefused(
                [_problem(entry.words, more[entry.id]) for entry in reordered_entries if entry.id in more]
            )
        self._queue.move(number, before)

    def _plan(self, name: str, *, anywhere: bool) -> PlanFiles:
        path = _place("plan", self._plans, name, anywhere=anywhere)
        if "views" not in read_document(path).data:
            raise InputError(f"{path}: expected a plan, with `views`")
        files = read_plan(path, self._rig if anywhere else None)
        if files.cell.document.path.resolve() != self._rig:
            raise InputError(f"{path}: its rig is {files.cell.document.path}; this console's is {self._rig}")
        return files

    def _run(self, name: str, *, anywhere: bool) -> Run:
        path = _place("resume", self._cell.storage_folder, name, anywhere=anywhere)
        run = Run(path)
        begun_on = read_cell(run.rig_path)
        if begun_on.state_folder.resolve() != self._cell.state_folder.resolve():
            raise InputError(f"{path}: this run was begun in another cell, {begun_on.rig.name}")
        return run

    # -- preflight --------------------------------------------------------------------------------------------

    def _needs(self, files: PlanFiles, fields: dict[str, Any], by: str) -> Needs:
        """Make the preflight, and return the needs of the entry. Raises EntryRefused with all refusals."""
        run = Path(fields["resume"]) if fields["resume"] else None
        plan, rig = (Path(fields["plan"]), self._rig) if fields["plan"] else (files.document.path, None)
        entry_files = Files(plan, rig, run, Path(fields["output"]) if fields["output"] else None)
        begun_s = time.monotonic()
        verdict = self.preflight.of(entry_files, by, beside_a_run=self._acquisitions.state is not None)
        if verdict.problems:
            raise EntryRefused(verdict.problems, verdict.exit_code)
        document = verdict.document
        thing = files.plan.object
        return Needs(
            duration_s=document["duration_s"],
            preparation_s=time.monotonic() - begun_s,
            dose_lux_h=document["dose_lux_h"],
            bytes=document["bytes"],
            frames=document["frames"],
            object=thing.id if thing else None,
            dose_budget_lux_h=thing.dose_budget_lux_h if thing else None,
            folder=fields["resume"] or fields["output"] or str(self._cell.storage_folder.resolve()),
            warnings=tuple(document["warnings"]),
        )

    # -- with what runs and waits before ------------------------------------------------------------------------

    def _refuse(self, new: Entry, before: str) -> None:
        name = new.plan or new.resume
        waiting = list(self._queue.waiting)
        place = waiting.index(self._queue.waiting_entry(before)) if before else len(waiting)
        entries = [*waiting[:place], new, *waiting[place:]]
        problems = [_problem(name, refusal) for refusal in self._more_light(entries).values()]
        rig = self._cell.rig
        problems += [
            _problem(name, refusal)
            for refusal in too_little_disk(
                entries,
                at_work_of(self._acquisitions.state, rig.frame_bytes),
                free_bytes=lambda folder: shutil.disk_usage(folder).free,
                reserve_bytes=rig.storage.reserve_bytes,
            )
        ]
        if problems:
            raise EntryRefused(problems)

    def _more_light(self, entries: tuple[Entry, ...] | list[Entry]) -> dict[str, str]:
        """Return the refusals for too much light that these entries have in this order, but not in the present
        queue."""
        at_work = at_work_of(self._acquisitions.state, self._cell.rig.frame_bytes)

        def received_lux_h(name: str) -> float:
            return ledger_of(self._cell, name).read_history().total_lux_h

        def budget_lux_h(name: str) -> float | None:
            return ledger_of(self._cell, name).read_history().budget_lux_h

        now = too_much_light(self._queue.waiting, received_lux_h, at_work, budget_lux_h)
        refusals = too_much_light(entries, received_lux_h, at_work, budget_lux_h)
        return {number: refusal for number, refusal in refusals.items() if number not in now}


def _place(key: str, folder: Path, name: str, *, anywhere: bool) -> Path:
    """Return the path of a file. Raises InputError if it is not a possible path, or not below the folder."""
    try:
        path = (folder / possible_path(Path(name))).resolve()
    except ValueError as error:
        raise InputError(f"{key}: expected {error}") from error
    if not anywhere and not path.is_relative_to(folder.resolve()):
        raise InputError(f"{key}: expected a place below {folder}; found {name!r}")
    return path


def _problem(file_name: str, refusal: str) -> Problem:
    return Problem(file_name, 0, 0, "", refusal)
