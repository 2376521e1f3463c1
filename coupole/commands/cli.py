"""The command line: which commands there are, and what becomes of their errors."""

from __future__ import annotations

import contextlib
import sys
import traceback

import typer

from coupole.acquisition.signals import SignalReceived, raise_outside_sessions
from coupole.commands import exporting, keeping, planning, running
from coupole.commands.calibrate import calibrate_app
from coupole.commands.commissioning import commission
from coupole.commands.dose_ledger import dose
from coupole.commands.reflectance import reflectance_app
from coupole.commands.render_scene import render
from coupole.commands.show import show
from coupole.commands.uncertainty import budget
from coupole.errors import CoupoleError, InputError, Interrupted

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
    running.meter,
    running.live,
    running.devices,
    running.confirm,
    commission,
    running.sim,
    keeping.status,
    keeping.report,
    keeping.verify,
    keeping.archive,
    exporting.export,
    keeping.scan,
    dose,
    render,
    show,
    budget,
    planning.schema,
):
    app.command()(command)
plan_app.command("new")(planning.plan_new)
app.add_typer(plan_app, name="plan")
app.add_typer(calibrate_app, name="calibrate")
app.add_typer(reflectance_app, name="reflectance")


def main() -> None:
    """Entry point: runs a command and turns Coupole's errors into messages and exit codes."""
    raise_outside_sessions()
    try:
        code = app(standalone_mode=False)
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
    sys.exit(code or 0)


def _say(error: CoupoleError) -> None:
    kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"{kind}{error}", file=sys.stderr)


if __name__ == "__main__":
    main()
