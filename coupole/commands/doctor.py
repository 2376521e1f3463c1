"""`coupole doctor`: what this machine lacks for a cell, and which cycle of the arm's controller it can answer. No
device is opened."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption
from coupole.errors import PreflightRefused
from coupole.plan.shipped_files import SIMULATED_CELL

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.devices import HostNeed
    from coupole.plan.cell import Cell

SLOWER_MS = 12
"""The slower of RSI's two cycles, ms (#IPO)."""
NOT_TIMED = "the arm's driver does not answer its controller in cycles, so there is nothing to measure"


def doctor(
    rig: Annotated[
        Path | None,
        typer.Option("--rig", help="The rig (YAML); by default the simulated cell.", show_default=False),
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.5, max=86400, help="Duration of the measurement.")
    ] = 60.0,
    as_json: JsonOption = False,
) -> None:
    """List what this machine lacks for a rig, and measure whether it answers the arm's controller in time.

    The list has libraries, rights, ports and folders, with a remedy for each that is missing. No device is opened.
    If the controller of the arm must be answered in every cycle, the command simulates this controller, and the
    process that answers it runs as in a session. During the measurement, let the machine do the work of a run.
    Exit code 3: something is missing, or the machine cannot hold the rig's cycle.
    """
    from coupole.commands.extras import lacking_extras
    from coupole.plan.cell import read_cell
    from coupole.preflight.machine import machine_needs
    from coupole.viewing.terminal import make_console

    cell = read_cell(rig or SIMULATED_CELL)
    console = make_console(quiet=as_json)
    needs, lacking = machine_needs(cell), lacking_extras()
    for part, need in needs:
        console.print(line_of(part, need), highlight=False)
    for extra, libraries in lacking.items():
        console.print(f"  extra {extra} is not installed: {', '.join(libraries)}", highlight=False)
    jitters = _measure(cell, seconds, console)
    for jitter in jitters:
        console.print(words_of(jitter))
    advice = advice_of(jitters, cell.document.path) if jitters else NOT_TIMED
    if as_json:
        documents = [{**jitter._asdict(), "holds": jitter.holds} for jitter in jitters]
        about_answers = {"holds": jitters[0].holds if jitters else None, "measured": documents, "advice": advice}
        told_needs = [{"part": part, **asdict(need)} for part, need in needs]
        print(json.dumps({**about_answers, "needs": told_needs, "lacking_extras": lacking}))
    unmet = [need for _, need in needs if need.is_vital and not need.is_met]
    refusals = [f"{need.name}: {need.state}. {need.remedy}" for need in unmet]
    if jitters and not jitters[0].holds:
        refusals.append(advice)
    if refusals:
        raise PreflightRefused(refusals)
    console.print(advice)


def _measure(cell: Cell, seconds: float, console: Console) -> list[Any]:
    """Measure the answers in the rig's cycle. If they are too late, measure them in the slower cycle, too. Return
    nothing if the driver does not answer in cycles."""
    from rich.progress import Progress, TimeRemainingColumn

    from coupole.plan.registry import ANSWER_JITTER, load_class
    from coupole.plan.rig_devices import robot_settings_here

    driver = cell.rig.robot.driver
    if driver not in ANSWER_JITTER:
        return []
    measure, settings = load_class(ANSWER_JITTER[driver]), robot_settings_here(cell.rig)
    jitters: list[Any] = []
    with Progress(*Progress.get_default_columns()[:3], TimeRemainingColumn(), console=console) as bars:
        for cycle_ms in (settings.cycle_ms, SLOWER_MS):
            if not jitters or (cycle_ms != settings.cycle_ms and not jitters[0].holds):
                bar = bars.add_task(f"answers in a cycle of {cycle_ms} ms", total=seconds)
                cycle_settings = settings.model_copy(update={"cycle_ms": cycle_ms})
                jitters.append(measure(cycle_settings, seconds, lambda s, bar=bar: bars.update(bar, completed=s)))
    return jitters


def line_of(part: str, need: HostNeed) -> str:
    """Return one line about a need, with the remedy if the need is not met."""
    mark = "[green]ok  [/]" if need.is_met else "[red]lack[/]" if need.is_vital else "[yellow]weak[/]"
    remedy = "" if need.is_met else f". {need.remedy}"
    return f"{mark} {part}: {need.name}: {need.state}{remedy}"


def words_of(jitter: Any) -> str:
    """Return one line with the figures of one cycle."""
    return (
        f"{jitter.cycle_ms} ms: {jitter.answers} answers, "
        f"{'real-time' if jitter.realtime else 'normal'} priority; p50 {jitter.p50_us / 1e3:.2f} ms, "
        f"p99 {jitter.p99_us / 1e3:.2f} ms, p99.99 {jitter.p99_99_us / 1e3:.2f} ms, "
        f"longest {jitter.max_us / 1e3:.2f} ms, late {100 * jitter.late_share:.3g} %"
    )


def advice_of(jitters: list[Any], rig: Path) -> str:
    """Return the advice to the user. `jitters` were measured in the rig's cycle and, if it was not held, in the
    slower one."""
    first, last = jitters[0], jitters[-1]
    if first.holds:
        return f"{rig}: this machine holds a cycle of {first.cycle_ms} ms, as far as was measured"
    why = f"{rig}: this machine cannot hold a cycle of {first.cycle_ms} ms: {100 * first.late_share:.3g} % of its "
    why += "answers were late. " if not first.realtime else "answers were late: "
    if not first.realtime:
        why += "Give it the right to real-time priority (docs/how-to/kuka-controller.md) and measure again. Or "
    if last.holds:
        return why + f"set `cycle_ms: {last.cycle_ms}` among the robot's settings, with #IPO in the RSI program"
    return (
        why + "end this machine's other work; until then use EthernetKRL (`drivers.kuka.eki:KukaEki`), "
        "which is not timed"
    )
