"""The command line: its commands, and the handling of their errors."""

from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
import json
import platform
import sys
import traceback
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, cast

import typer
from typer.core import TyperCommand, TyperGroup

import coupole
from coupole.acquisition.signals import (
    SignalReceived,
    exit_from_now,
    ignore_from_now,
    raise_outside_sessions,
    signal_behind,
    unheard_end,
)
from coupole.bounded import leave
from coupole.commands.common import fail
from coupole.commands.examples import add_examples
from coupole.commands.extras import lacking_extras, missing_extra
from coupole.errors import CoupoleError, InputError, Interrupted, StorageError
from coupole.viewing import text_outlet

AT_A_CELL = {
    "acquire",
    "demo",
    "meter",
    "live",
    "devices",
    "bench",
    "arm",
    "commission",
    "confirm",
    "calibrate",
    "sim",
}
AT_A_CELL |= {"serve", "pause", "go-on", "stop"}
"""Commands that hold a cell, or that speak to a process that holds one. None of them waits until its output is
read.
"""

GROUPS = {
    "Plan and acquire": {
        "plan": "planning.plan_app",
        "schema": "planning.schema",
        "check": "planning.check",
        "view": "planning.view",
        "simulate": "planning.simulate",
        "meter": "running.meter",
        "acquire": "running.acquire",
        "demo": "demo.demo",
        "example": "example.example",
    },
    "Cell": {
        "devices": "running.devices",
        "doctor": "doctor.doctor",
        "live": "running.live",
        "arm": "benching.arm",
        "bench": "benching.bench",
        "commission": "commissioning.commission",
        "confirm": "running.confirm",
        "sim": "running.sim",
        "serve": "console.serve",
        "queue": "console.queue",
        "dose": "dose_ledger.dose",
    },
    "Calibrate": {
        "calibrate": "calibrate.calibrate_app",
        "budget": "uncertainty.budget",
        "certificate": "certificate.certificate",
    },
    "Results": {
        "reflectance": "reflectance.reflectance_app",
        "compare": "compare_states.compare",
        "register": "register_scans.register",
        "scan": "keeping.scan",
    },
    "Look and share": {
        "show": "show.show",
        "export": "exporting.export",
        "render": "render_scene.render",
        "restore": "restore.restore_app",
    },
    "Bench: spectra and photographs": {
        "identify": "identify.identify",
        "layer": "layer.layer",
        "recipe": "recipe.recipe",
        "bracket": "bracketing.bracket",
        "sphere-brdf": "bracketing.sphere_brdf",
        "makie": "makie_photograph.makie",
    },
    "Runs": {
        "status": "keeping.status",
        "pause": "run_controls.pause",
        "go-on": "run_controls.go_on",
        "stop": "stopping.stop",
        "report": "keeping.report",
        "verify": "keeping.verify",
        "archive": "keeping.archive",
    },
}
"""Module in `coupole.commands` and function, or group of steps, of each command. The headings and their order are
those of `--help`."""

COMMANDS = {name: place for group in GROUPS.values() for name, place in group.items()}
_HEADINGS = {name: heading for heading, group in GROUPS.items() for name in group}


class _OnDemand(Mapping[str, Any]):
    """The mapping `COMMANDS` for typer: a module is imported, and its signatures are read, only when its command
    is used."""

    def __len__(self) -> int:
        return len(COMMANDS)

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __contains__(self, name: object) -> bool:
        return name in COMMANDS

    def __getitem__(self, name: str) -> Any:
        return _command(name)


def _entry(name: str) -> Any:
    """Return a command's function, or the Typer of a group of commands."""
    module, function = COMMANDS[name].split(".")
    return getattr(importlib.import_module(f"coupole.commands.{module}"), function)


def _summary(name: str) -> TyperCommand:
    """Return a command for the list of all commands: with its help text, but without its options, because reading
    these takes longest."""
    entry = _entry(name)
    text = entry.info.help if isinstance(entry, typer.Typer) else inspect.getdoc(entry)
    return TyperCommand(name, help=text, rich_help_panel=_HEADINGS[name])


@functools.cache
def _command(name: str) -> Any:
    entry = _entry(name)
    alone = typer.Typer(callback=lambda: None)
    if isinstance(entry, typer.Typer):
        alone.add_typer(entry, name=name)
    else:
        alone.command(name)(entry)
    command = typer.main.get_group(alone).commands[name]
    add_examples(command, name)
    return command


class _Commands(TyperGroup):
    """The whole command line."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = cast("Any", _OnDemand())

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        self.commands = {name: _summary(name) for name in COMMANDS}
        super().format_help(ctx, formatter)


app = typer.Typer(
    name="coupole",
    cls=_Commands,
    help="Acquisition controller of La Coupole: a plan in, proven frames out.",
    no_args_is_help=True,
    invoke_without_command=True,
    pretty_exceptions_enable=False,
)


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and end.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="With --version: one JSON line, with Python, system and missing extras.")
    ] = False,
) -> None:
    if version:
        print(json.dumps(_about_version()) if as_json else f"coupole {coupole.__version__}")
        raise typer.Exit
    if as_json or context.invoked_subcommand is None:
        context.fail("--json goes with --version here, or after a command's name")
    if context.invoked_subcommand in AT_A_CELL:
        text_outlet.install()


def _about_version() -> dict[str, Any]:
    """Return the facts about an installation that a bug report needs."""
    return {
        "coupole": coupole.__version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "lacking_extras": lacking_extras(),
    }


def main() -> None:
    """Entry point: runs a command and turns Coupole's errors into messages and exit codes."""
    text_outlet.keep_standard_places()
    if "--json" in sys.argv:
        text_outlet.notice_stdout()
    raise_outside_sessions()
    with unheard_end():
        code = _exit_code_of_command()
        if code:
            ignore_from_now()
        else:
            exit_from_now()
    leave(code)


def _exit_code_of_command() -> int:
    """Run the command; return its exit code."""
    try:
        code = app(standalone_mode=False)
    except CoupoleError as error:
        if isinstance(error, InputError) and (cause := signal_behind(error)):
            code = _code_of_signal(cause)
        else:
            _say(error)
            code = error.exit_code
    except SignalReceived as signal_error:
        code = _code_of_signal(signal_error)
    except typer.Abort:
        code = Interrupted.exit_code
    except ImportError as error:
        code = _code_of_missing(error)
    except Exception as error:  # noqa: BLE001  click's usage errors, which know their own exit code, and defects
        if hasattr(error, "exit_code") and hasattr(error, "show"):
            error.show()
            code = error.exit_code
        elif cause := signal_behind(error):
            code = _code_of_signal(cause)
        elif isinstance(error, OSError) and (why := text_outlet.full_stdout()):
            code = _not_taken(why)
        else:
            code = _code_of_defect(error)
    if why := text_outlet.full_stdout():
        code = _not_taken(why)
    with contextlib.suppress(SignalReceived):  # if another signal comes, nothing more is waited for
        text_outlet.finish()
    return int(code or 0)


def _code_of_signal(error: SignalReceived) -> int:
    """Print that a signal has stopped the command; return the exit code. With `--json` the document says it too,
    unless the command has printed one."""
    interruption = Interrupted("stopped", error.number)
    text_outlet.lead_blocked_nowhere(text_outlet.PATIENCE_S)
    if "--json" in sys.argv and not text_outlet.has_written_stdout():
        fail(interruption, as_json=True)
    _say(interruption)
    return interruption.exit_code


def _code_of_missing(error: ImportError) -> int:
    """Print which extra provides the missing library; return the exit code."""
    missing = missing_extra(error)
    if cause := signal_behind(error):
        return _code_of_signal(cause)
    if missing is None:
        return _code_of_defect(error)
    fail(missing, as_json="--json" in sys.argv)
    _say(missing)
    return missing.exit_code


def _code_of_defect(error: Exception) -> int:
    from coupole.commands.shortages import place_of, shortage_behind

    shortage = shortage_behind(error)
    if shortage is not None:
        fail(shortage, as_json="--json" in sys.argv)
        _say(shortage)
        print(f"(met at {place_of(error)}: {type(error).__name__}: {error})", file=sys.stderr)
        return shortage.exit_code
    with contextlib.suppress(OSError):
        traceback.print_exception(error)
        print("This is a defect of Coupole: please report it, with the lines above.", file=sys.stderr)
    return 1


def _not_taken(why: str) -> int:
    """Print that standard output has not received the whole document; return the exit code."""
    error = StorageError(f"standard output: {why}; the text printed there is not complete")
    _say(error)
    return error.exit_code


def _say(error: CoupoleError) -> None:
    with contextlib.suppress(OSError):  # the terminal may be gone
        print(f"{error.heading}\n{error}".strip(), file=sys.stderr)


if __name__ == "__main__":
    main()
