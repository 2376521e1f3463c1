"""`coupole doctor`: what this machine can promise a cell, measured. No device is opened and nothing moves."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from coupole.commands.common import JsonOption
from coupole.errors import InputError, PreflightRefused
from coupole.plan.shipped_files import SIMULATED_CELL

SLOWER_MS = 12
"""RSI's other cycle (#IPO)."""


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
    """Measure whether this machine answers the arm's controller in time, in each cycle of the rig.

    The process that answers runs as in a session, with a controller that this command plays; have the machine do
    meanwhile what it does in a run. Exit code 3: it cannot hold the rig's cycle.
    """
    from rich.progress import Progress, TimeRemainingColumn

    from coupole.plan.cell import read_cell
    from coupole.plan.registry import ANSWER_JITTER, load_class
    from coupole.plan.rig_devices import robot_settings_here
    from coupole.viewing.terminal import make_console

    cell = read_cell(rig or SIMULATED_CELL)
    driver = cell.rig.robot.driver
    if driver not in ANSWER_JITTER:
        raise InputError(
            f"{cell.document.path}: `{driver}` does not answer its controller in every cycle: there is nothing to "
            "measure"
        )
    measure, settings = load_class(ANSWER_JITTER[driver]), robot_settings_here(cell.rig)
    console = make_console(quiet=as_json)
    jitters: list[Any] = []
    with Progress(*Progress.get_default_columns()[:3], TimeRemainingColumn(), console=console) as bars:
        for cycle_ms in (settings.cycle_ms, SLOWER_MS):
            if not jitters or (cycle_ms != settings.cycle_ms and not jitters[0].holds):
                bar = bars.add_task(f"answers in a cycle of {cycle_ms} ms", total=seconds)
                cycle_settings = settings.model_copy(update={"cycle_ms": cycle_ms})
                jitters.append(measure(cycle_settings, seconds, lambda s, bar=bar: bars.update(bar, completed=s)))
    for jitter in jitters:
        console.print(words_of(jitter))
    advice = advice_of(jitters, cell.document.path)
    if as_json:
        documents = [{**jitter._asdict(), "holds": jitter.holds} for jitter in jitters]
        print(json.dumps({"holds": jitters[0].holds, "measured": documents, "advice": advice}))
    if not jitters[0].holds:
        raise PreflightRefused([advice])
    console.print(advice)


def words_of(jitter: Any) -> str:
    """The figures of one cycle, for people."""
    return (
        f"{jitter.cycle_ms} ms: {jitter.answers} answers, "
        f"{'real-time' if jitter.realtime else 'normal'} priority; p50 {jitter.p50_us / 1e3:.2f} ms, "
        f"p99 {jitter.p99_us / 1e3:.2f} ms, p99.99 {jitter.p99_99_us / 1e3:.2f} ms, "
        f"longest {jitter.max_us / 1e3:.2f} ms, late {100 * jitter.late_share:.3g} %"
    )


def advice_of(jitters: list[Any], rig: Path) -> str:
    """Say what to do; `jitters` are of the rig's cycle, and of the longer one where that was not held."""
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
        why + "end other work on it; until then use EthernetKRL (`drivers.kuka.eki:KukaEki`), which is not timed"
    )
