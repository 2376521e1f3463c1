"""The command `coupole demo`: from a plan to a page to relight, on the simulated cell, in any folder."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.acquisition.sessions_without_run import SessionWithoutRun

RUNS, RESULT, PAGE = "runs", "reflectance", "page.html"
"""Contents of the demo's folder."""
_BESIDE_THE_PAGE = "page.data"


@dataclass(frozen=True)
class Demo:
    """Results of the demo, by their paths."""

    run: str
    result: str
    page: str


def demo(
    folder: Annotated[Path, typer.Argument(help="Folder to make, or the folder of an interrupted demo.")] = Path(
        "coupole-demo"
    ),
    short: Annotated[
        bool, typer.Option("--short", help="One view under 54 LEDs, in place of three under 1080.")
    ] = (False),
    open_page: Annotated[bool, typer.Option("--open", help="Open the page in a browser.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure a relief on the simulated cell, find its reflectance, and make a page to relight it.

    No device is needed. An interrupted demo continues when it is called again.
    """
    from coupole.acquisition.sessions_without_run import ACQUIRE, SessionWithoutRun
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        plan_name = "demo-short" if short else "demo"
        _refuse_foreign(folder, plan_name)
        with _alone_in(folder), SessionWithoutRun(ACQUIRE, None) as starting:
            made = _make(folder, plan_name, console, starting)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    console.print(f"page {made.page}")
    if as_json:
        print(json.dumps({**asdict(made), "simulated": True}))
    if open_page:
        typer.launch(made.page)


def _refuse_foreign(folder: Path, plan_name: str) -> None:
    """Raise InputError if the folder contains anything that a demo of this plan does not make."""
    if folder.is_file():
        raise InputError(f"{folder}: is a file; name a folder for the demo")
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    if foreign := names - {RUNS, RESULT, PAGE, _BESIDE_THE_PAGE}:
        raise InputError(f"{folder}: is not empty ({sorted(foreign)[0]}); name a folder that the demo may make")
    for run in (folder / RUNS).glob("*"):
        if not run.name.endswith(f"Z-{plan_name}"):
            raise InputError(f"{folder}: holds another run ({run.name}); name another folder for this demo")


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Make the folder, and hold it against other demos. Raises InputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        folder_fd = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"{folder}: cannot be used: {error.strerror}") from error
    try:
        try:
            fcntl.flock(folder_fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"{folder}: another demo is being made there; wait for its end, or name another folder"
            ) from error
        yield
    finally:
        os.close(folder_fd)


def _make(folder: Path, plan_name: str, console: Console, starting: SessionWithoutRun) -> Demo:
    """Take the steps that are still missing."""
    console.print(f"1 of 3: the plan {plan_name} is acquired on the simulated cell")
    run = _acquire(folder / RUNS, plan_name, console, starting)
    starting.end()
    console.print("2 of 3: the reflectance of the relief is found from the frames")
    result = _find_reflectance(run, folder / RESULT, console)
    console.print("3 of 3: a page shows it under any light")
    page = _write_page(result, folder / PAGE, console)
    return Demo(*(str(path.resolve()) for path in (run, result, page)))


def _acquire(parent: Path, plan_name: str, console: Console, starting: SessionWithoutRun) -> Path:
    """Return the complete run of the plan; acquire or resume it first if it is not complete."""
    from coupole.acquisition.session import SessionRequest, acquire_plan
    from coupole.plan.shipped_files import shipped_folder
    from coupole.preflight.job import read_job
    from coupole.storage.run_status import is_complete, newest_run

    # the shipped plan, even if a file of the same name is in the working folder
    job = read_job(shipped_folder() / "plans" / f"{plan_name}.yaml")
    run = newest_run(parent, plan_name, job.document.path, console.print)
    if run is not None and is_complete(run):
        return run
    figures: dict[str, Any] = {}
    starting.know(job.document.path, job.cell.document.path)
    request = SessionRequest(parent, run, confirm=False, when_served=starting.begin_run)
    acquire_plan(job, console, request, figures)
    return Path(figures["run"])


def _find_reflectance(run: Path, out: Path, console: Console) -> Path:
    """Make the result of the run, or continue it; a complete result is kept."""
    from coupole.reflectance.run_result import REPORT
    from coupole.scripting.analyses import fit_reflectance
    from coupole.viewing.terminal import step_bars

    if (out / REPORT).exists():
        return out
    with step_bars(console) as say:
        fit_reflectance(run, out, progress=say)
    return out


def _write_page(result: Path, page: Path, console: Console) -> Path:
    """Write the page of the result, unless it exists; return its path."""
    if page.exists():
        return page
    from coupole.exchange.look.look_of_runs import look_of_result
    from coupole.exchange.look.look_page import write_page
    from coupole.viewing.terminal import step_bars

    with step_bars(console) as say:
        write_page(look_of_result(result, say), "demo", page)
    return page
