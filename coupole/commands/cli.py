"""The command line: which commands there are, and what becomes of their errors."""

from __future__ import annotations

import contextlib
import functools
import sys
import traceback
from typing import Annotated, Any

import typer

import coupole
from coupole.acquisition.signals import SignalReceived, raise_outside_sessions, unheard_end
from coupole.bounded import leave
from coupole.commands import benching, console, exporting, keeping, planning, run_controls, running
from coupole.commands.bracketing import bracket, sphere_brdf
from coupole.commands.calibrate import calibrate_app
from coupole.commands.commissioning import commission
from coupole.commands.compare_states import compare
from coupole.commands.doctor import doctor
from coupole.commands.dose_ledger import dose
from coupole.commands.identify import identify
from coupole.commands.layer import layer
from coupole.commands.makie_photograph import makie
from coupole.commands.recipe import recipe
from coupole.commands.reflectance import reflectance_app
from coupole.commands.register_scans import register
from coupole.commands.render_scene import render
from coupole.commands.restore import restore_app
from coupole.commands.show import show
from coupole.commands.uncertainty import budget
from coupole.errors import CoupoleError, Interrupted
from coupole.viewing import text_outlet

AT_A_CELL = {"acquire", "meter", "live", "devices", "bench", "arm", "commission", "confirm", "calibrate", "sim"}
AT_A_CELL |= {"serve", "pause", "go-on", "stop"}
"""Commands that hold a cell, or speak to what does: none of them waits for a reader of its text."""

app = typer.Typer(
    name="coupole",
    help="Acquisition controller of La Coupole: a plan in, proven frames out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
plan_app = typer.Typer(help="Plan templates.", no_args_is_help=True)
for command in (
    planning.check,
    planning.view,
    planning.simulate,
    running.acquire,
    run_controls.pause,
    run_controls.stop,
    console.serve,
    console.queue,
    running.meter,
    running.live,
    running.devices,
    doctor,
    benching.bench,
    benching.arm,
    running.confirm,
    commission,
    running.sim,
    keeping.status,
    keeping.report,
    keeping.verify,
    keeping.archive,
    exporting.export,
    keeping.scan,
    identify,
    register,
    compare,
    dose,
    render,
    layer,
    bracket,
    sphere_brdf,
    makie,
    recipe,
    show,
    budget,
    planning.schema,
):
    app.command()(command)
app.command("go-on")(run_controls.go_on)
plan_app.command("new")(planning.plan_new)
app.add_typer(plan_app, name="plan")
app.add_typer(calibrate_app, name="calibrate")
app.add_typer(reflectance_app, name="reflectance")
app.add_typer(restore_app, name="restore")


def _print_version(asked: bool) -> None:
    if asked:
        print(f"coupole {coupole.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    _: Annotated[
        bool, typer.Option("--version", help="Print the version and end.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    if context.invoked_subcommand in AT_A_CELL:
        text_outlet.install()


@functools.cache
def _commands() -> Any:
    """What `app` describes, made once: each of some thirty signatures is read for it."""
    return typer.main.get_command(app)


def main() -> None:
    """Entry point: runs a command and turns Coupole's errors into messages and exit codes."""
    text_outlet.keep_standard_places()
    raise_outside_sessions()
    with unheard_end():
        code = _ended()
    leave(code)


def _ended() -> int:
    """Run the command; its exit code."""
    try:
        code = _commands()(standalone_mode=False)
    except CoupoleError as error:
        _say(error)
        code = error.exit_code
    except SignalReceived as received:
        interrupted = Interrupted("stopped", received.number)
        _say(interrupted)
        code = interrupted.exit_code
    except typer.Abort:
        code = Interrupted.exit_code
    except Exception as error:  # noqa: BLE001  click's usage errors, which know their own exit code, and defects
        if hasattr(error, "exit_code") and hasattr(error, "show"):
            error.show()
            code = error.exit_code
        else:
            with contextlib.suppress(OSError):
                traceback.print_exception(error)
                print("This is a defect of Coupole: please report it, with the lines above.", file=sys.stderr)
            code = 1
    with contextlib.suppress(SignalReceived):  # a signal more: nothing is waited for
        text_outlet.finish()
    return int(code or 0)


def _say(error: CoupoleError) -> None:
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"{error.heading}\n{error}".strip(), file=sys.stderr)


if __name__ == "__main__":
    main()
