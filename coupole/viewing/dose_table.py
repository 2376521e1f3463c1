"""An object's ledger as a table and as JSON."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table

from coupole.appearance.spectra.damage import B_PER_NM
from coupole.storage.ledger import Ledger
from coupole.storage.ledger_lines import Entry, History

NOT_KNOWN = "not known"
NO_BUDGET = "  it has no light budget: `coupole dose {} --budget LUX_H --name NAME` gives it one"


def show_dose(console: Console, ledger: Ledger, history: History, similar_ids: list[str], *, is_new: bool) -> None:
    """Show the light of each run, the total, and remarks. `similar_ids` are objects with nearly the same id.
    `is_new` is true if nothing was entered before this command."""
    title = f"{ledger.object_id}: light received"
    table = Table("run", "first", "lux.h", "damage, mW.h/m2", "", box=None, title=title, title_justify="left")
    for run in history.runs:
        part = history.of_run(run)
        notes = [entry.note for entry in part.entries if entry.note]
        if part.unsettled_lux_h:
            notes.append(
                f"of which at most {part.unsettled_lux_h:.3f} are planned light: how that burst ended is not known"
            )
        table.add_row(run, part.entries[0].t, f"{part.total_lux_h:.3f}", _damage(part), "; ".join(notes))
    table.add_row("[bold]total[/]", "", f"[bold]{history.total_lux_h:.3f}[/]", _damage(history), "")
    console.print(table)
    for number, budget in enumerate(history.budgets):
        earlier = "" if number + 1 == len(history.budgets) else "earlier "
        because = f": {budget.reason}" if budget.reason else ""
        console.print(
            f"  {earlier}budget {budget.dose_lux_h:g} lux.h, by {budget.name}, {budget.t}{because}",
            markup=False,
            soft_wrap=True,
        )
    if history.budget_lux_h is None:
        console.print(NO_BUDGET.format(ledger.object_id), markup=False, soft_wrap=True)
    limit_lux_h = history.warn_above_lux_h
    if limit_lux_h is not None and history.total_lux_h > limit_lux_h:
        console.print(f"[yellow]note:[/] the total is above {limit_lux_h:g} lux.h")
    for similar_id in similar_ids:
        console.print(f"[yellow]note:[/] there is also a ledger of `{similar_id}`: is it the same object?")
    if history.unreadable:
        console.print(f"[yellow]note:[/] {history.unreadable_words}")
    console.print(f"  {ledger.path}", soft_wrap=True)
    if is_new:  # a person must know it, as a file may have been moved away
        state = "there is none yet" if history.is_empty else "it was begun now"
        console.print(
            f"[yellow]note:[/] no earlier ledger is in this folder: {state}. If the object ever received light, "
            "find its file before you go on: that light is not counted here",
            soft_wrap=True,
        )


def document(ledger: Ledger, history: History, similar_ids: list[str]) -> dict[str, Any]:
    """Return the document for `--json`."""
    return {
        "object": ledger.object_id,
        "ledger": str(ledger.path),
        **_sums(history),
        "budget_lux_h": history.budget_lux_h,
        "budgets": [
            budget.model_dump(include={"t", "dose_lux_h", "name", "reason"}) for budget in history.budgets
        ],
        "warn_above_lux_h": history.warn_above_lux_h,
        "above_warning": history.warn_above_lux_h is not None and history.total_lux_h > history.warn_above_lux_h,
        "similar_ids": similar_ids,
        "unreadable_lines": history.unreadable,
        "damage_b_per_nm": B_PER_NM,
        "runs": {run: _sums(history.of_run(run)) for run in history.runs},
        "entries": [_entry(entry) for entry in history.entries if entry.note],
    }


def _entry(entry: Entry) -> dict[str, Any]:
    return {
        "t": entry.t,
        "run": entry.run,
        "dose_lux_h": entry.dose_lux_h,
        "damage_wh_m2": entry.damage_wh_m2,
        "note": entry.note,
        "settled": entry.is_settled,
    }


def _sums(history: History) -> dict[str, float]:
    return {
        "dose_lux_h": history.total_lux_h,
        "unsettled_lux_h": history.unsettled_lux_h,
        "damage_wh_m2": history.damage_wh_m2,
        "of_unknown_spectrum_lux_h": history.of_unknown_spectrum_lux_h,
    }


def _damage(history: History) -> str:
    """Return the radiant exposure weighted by damage, and the light for which it is not known."""
    unknown_lux_h = history.of_unknown_spectrum_lux_h
    if unknown_lux_h and unknown_lux_h == history.total_lux_h:
        return NOT_KNOWN
    exposure = f"{1e3 * history.damage_wh_m2:.4f}"
    return f"{exposure}, and {unknown_lux_h:.3f} lux.h {NOT_KNOWN}" if unknown_lux_h else exposure
