"""Outlook of a queue: the begin and end of each entry, and whether light and disk suffice for all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from coupole.console.plans.plan_queue import Entry


@dataclass(frozen=True)
class AtWork:
    """Disk space and light that the present run still needs."""

    folder: str = ""
    bytes_left: int = 0
    light_after_lux_h: Mapping[str, float] = field(default_factory=dict)
    """Total light on each object, by id, when the run is complete."""


def expected_times(
    entries: Sequence[Entry], now: datetime, *, left_s: float | None, is_halted: bool
) -> dict[str, tuple[datetime | None, datetime | None]]:
    """Return the times, by id, at which each running or waiting entry is expected to begin and to end.

    A time is None if a person decides on it (a hold, a halted queue), or if it is not known. `left_s` is the time
    that the present run still needs.
    """
    times: dict[str, tuple[datetime | None, datetime | None]] = {}
    free_at: datetime | None = None if is_halted else now
    for entry in entries:
        if entry.state == "running":
            begun_at = datetime.fromisoformat(entry.begun)
            free_at = _end_of_running(entry, begun_at, now, left_s)
            times[entry.id] = begun_at, free_at
            free_at = None if is_halted else free_at
    for entry in entries:
        if entry.state == "waiting":
            begins = free_at
            ends = begins + timedelta(seconds=_whole_s(entry)) if begins and entry.needs else None
            times[entry.id] = begins, ends
            free_at = ends
    return times


def _end_of_running(entry: Entry, begun_at: datetime, now: datetime, left_s: float | None) -> datetime | None:
    if left_s is not None:
        return now + timedelta(seconds=left_s)
    return max(now, begun_at + timedelta(seconds=_whole_s(entry))) if entry.needs else None


def _whole_s(entry: Entry) -> float:
    return entry.needs.preparation_s + entry.needs.duration_s if entry.needs else 0.0


def too_much_light(
    entries: Sequence[Entry],
    received_lux_h: Callable[[str], float],
    at_work: AtWork,
    budget_lux_h: Callable[[str], float | None] = lambda _: None,
) -> dict[str, str]:
    """Return the refusals of waiting entries, by id: refusals of entries that exceed their object's budget after
    all entries before them.

    `received_lux_h` returns the light that an object has received by its ledger, `budget_lux_h` the light that it
    may receive. A plan's own budget can only be stricter.
    """
    light: dict[str, float] = {}
    refusals: dict[str, str] = {}
    for entry in entries:
        needs = entry.needs
        if entry.state != "waiting" or needs is None or needs.object is None:
            continue
        name = needs.object
        if name not in light:
            light[name] = max(received_lux_h(name), at_work.light_after_lux_h.get(name, 0.0))
        before, light[name] = light[name], light[name] + needs.dose_lux_h
        budgets_lux_h = [budget for budget in (needs.dose_budget_lux_h, budget_lux_h(name)) if budget is not None]
        if budgets_lux_h and light[name] > min(budgets_lux_h):
            refusals[entry.id] = (
                f"object {name}: {needs.dose_lux_h:.2f} lux.h after {before:.2f} lux.h, including the plans "
                f"that run and wait before it; its budget is {min(budgets_lux_h):g} lux.h"
            )
    return refusals


def too_little_disk(
    entries: Sequence[Entry],
    at_work: AtWork,
    *,
    free_bytes: Callable[[Path], int],
    reserve_bytes: int,
) -> list[str]:
    """Return the refusals for disks without space for all running and waiting entries; `reserve_bytes` must stay
    free."""
    needs_of_disk: dict[int, tuple[Path, int]] = {}
    folders: list[tuple[str, int]] = [(at_work.folder, at_work.bytes_left)] if at_work.folder else []
    folders += [(e.needs.folder, e.needs.bytes) for e in entries if e.state == "waiting" and e.needs]
    for folder, size in folders:
        existing = next(path for path in (Path(folder), *Path(folder).parents) if path.exists())
        disk = existing.stat().st_dev
        needs_of_disk[disk] = existing, needs_of_disk.get(disk, (existing, 0))[1] + size
    return [
        f"storage {folder}: the plans that run and wait need {size / 1e9:.2f} GB and {reserve_bytes / 1e9:.2f} GB "
        f"must stay free; {free_bytes(folder) / 1e9:.2f} GB are free"
        for folder, size in needs_of_disk.values()
        if size + reserve_bytes > free_bytes(folder)
    ]


def at_work_of(state: Mapping[str, Any] | None, frame_bytes: int) -> AtWork:
    """Return what a run still needs, from the state that its process reports; nothing if there is no state."""
    if state is None:
        return AtWork()
    frames_left = max(0, state.get("frames", 0) - state.get("proven", 0))
    return AtWork(state["run"], frames_left * frame_bytes, state["light_after_lux_h"])
