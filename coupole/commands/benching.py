"""Commands that hold a cell's devices without a run: bench, arm."""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, DeviceError, InputError, Interrupted

if TYPE_CHECKING:
    from coupole.acquisition.observer import Control
    from coupole.plan.cell import Cell

_LOOK_EVERY_S = 0.1
Asked = Callable[..., dict[str, Any]]


def bench(
    rig: Annotated[Path, typer.Argument(help="The rig (YAML).", show_default=False)],
    object_of: Annotated[
        Path | None,
        typer.Option(
            "--object", help="The plan whose object lies on the support; without this option the support is empty."
        ),
    ] = None,
    leave_after_s: Annotated[
        float, typer.Option("--leave-after-s", min=1, help="End after this time without a request.")
    ] = 600.0,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before a real cell is held.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Hold a cell's devices while no run is acquired, so that a console can read, move and photograph.

    The arm moves to a view, or by hand. Clients of the same user send requests to a Unix socket, whose path
    `--json` prints at the beginning. The command ends by Ctrl-C or when a client asks for it, and makes the cell
    safe.
    """
    from coupole.acquisition.cell_bench.bench_service import serve_bench
    from coupole.console.command_line.client import borrowed_cell
    from coupole.plan.cell import Cell, read_cell
    from coupole.preflight.job import read_job
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        job_or_cell = read_job(object_of, rig) if object_of else read_cell(rig)
        with borrowed_cell(job_or_cell if isinstance(job_or_cell, Cell) else job_or_cell.cell, "bench"):
            serve_bench(job_or_cell, console, confirm=not yes, leave_after_s=leave_after_s, as_json=as_json)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise


def arm(
    rig: Annotated[Path, typer.Argument(help="The rig (YAML).", show_default=False)],
    to: Annotated[
        Literal["home", "park", "view"], typer.Argument(help="Target of the motion.", show_default=False)
    ],
    plan: Annotated[Path | None, typer.Argument(help="The plan, for a view.", show_default=False)] = None,
    view: Annotated[str | None, typer.Argument(help="Name of the view.", show_default=False)] = None,
    object_of: Annotated[
        Path | None, typer.Option("--object", help="The plan whose object lies on the support (default: PLAN).")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before the arm moves.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Drive the arm to home, park or a plan's view on a collision-free path, which is shown first.

    Without a plan the support is assumed to be empty. If a bench holds the cell, the command uses it; otherwise it
    opens and closes the devices. If a console is served, the command needs control of the cell either way.
    """
    from coupole.acquisition.cell_bench.bench_client import ask_bench
    from coupole.acquisition.cell_bench.bench_service import bench_of
    from coupole.acquisition.cell_marks import is_in_use
    from coupole.acquisition.observer import Control
    from coupole.console.command_line.client import borrowed_cell
    from coupole.plan.cell import read_cell
    from coupole.preflight.job import read_job
    from coupole.viewing.terminal import make_console

    if (to == "view") != (plan is not None and view is not None):
        raise InputError("expected home, park, or view with a plan and the name of one of its views")
    goal: Any = {"view": view, "plan": str(plan.resolve())} if plan else to
    console, control = make_console(quiet=as_json), Control()
    try:
        cell = read_cell(rig)
        action = f"arm to {view or to}"
        if is_in_use(cell):
            ask_open_bench = functools.partial(ask_bench, cell, say=_say)
            answer = _drive(cell, action, ask_open_bench, goal, control, yes=yes)
        else:
            lies = object_of or plan
            job_or_cell = read_job(lies, rig) if lies else cell
            with borrowed_cell(cell, "arm"), bench_of(job_or_cell, console, control, confirm=False) as service:
                answer = _drive(cell, action, service.ask, goal, control, yes=yes)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    console.print(f"the arm is at {answer['to']}", markup=False)
    if as_json:
        print(json.dumps(answer))


def _asker(cell: Cell, action: str, ask: Asked) -> Asked:
    """Return a function that asks the bench. Each request that shows or begins the motion first asks the cell's
    console for permission, because control may change while a person answers a question. A refusal is an
    answer."""
    from coupole.console.command_line.client import ask_permission

    def send_request(command: str, **fields: Any) -> dict[str, Any]:
        if command in ("plan_path", "drive"):
            try:
                ask_permission(cell, action)
            except InputError as refusal:
                return {"error": str(refusal), "exit_code": refusal.exit_code}
        return ask(command, **fields)

    return send_request


def _say(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


def _drive(cell: Cell, action: str, ask_bench: Asked, goal: Any, control: Control, *, yes: bool) -> dict[str, Any]:
    """Plan a path, show it, ask, and drive the arm. Return the figures of the motion when the arm has arrived. A
    drive that is refused ends nothing: another motion may be under way. Raises Interrupted when another person
    takes control at the console, which stops the arm."""
    from coupole.acquisition.cell_bench.bench_client import checked_answer
    from coupole.console.command_line.keeping_control import kept_control
    from coupole.viewing.questions import ask

    send_request = _asker(cell, action, ask_bench)
    path = checked_answer(send_request("plan_path", to=goal))
    steps = len(path["waypoints_deg"]) - 1
    print(f"{path['to']}: {path['duration_s']:.1f} s, {steps} straight motion(s)", file=sys.stderr)
    agrees = yes or ask("Drive the arm along this path?", control.stop.is_set)
    control.await_word()  # the answer may have been given while this process did not run
    control.go_on()
    if not agrees:
        raise Interrupted("the arm was not driven: answer the question, or give `--yes`")
    with kept_control(cell, action) as kept_permission:
        is_refused = False
        try:
            answer = send_request("drive", path=path["path"])
            is_refused = "error" in answer
            work = checked_answer(answer)
            while work["state"] == "running":
                control.go_on()
                kept_permission.await_loss(_LOOK_EVERY_S)
                work = checked_answer(send_request("state"))["work"]
        except BaseException:
            if not is_refused:
                _stop(send_request, kept_permission.lost_because)
            raise
    if work["state"] != "done":
        control.go_on()  # this raises if the session was asked to stop, which also ends the motion
        raise DeviceError(
            "robot", expected=f"the arm to arrive at {work['to']}", happened=work["why"], remedy="See its state."
        )
    return {**work, "duration_s": path["duration_s"], "waypoints_deg": path["waypoints_deg"]}


def _stop(send_request: Asked, why: str) -> None:
    try:
        send_request("stop", why=why)
    except InputError as silent:
        _say(str(silent))
