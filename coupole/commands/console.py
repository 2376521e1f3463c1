"""The operator's console: serve it, and its queue from the command line."""

from __future__ import annotations

import json
import socket
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption
from coupole.commands.completion import plans as some_plans
from coupole.commands.completion import runs
from coupole.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

RigPath = Annotated[Path, typer.Argument(help="The rig (YAML).", show_default=False)]


def serve(
    rig: RigPath,
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; an address that other machines reach needs TLS.")
    ] = ("127.0.0.1"),
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port; 0 for any free one.")] = 8640,
    name: Annotated[
        list[str] | None,
        typer.Option("--name", help="Another name under which browsers know this machine.", show_default=False),
    ] = None,
    plans: Annotated[
        Path | None,
        typer.Option(
            "--plans", help="Folder of plans; by default `plans` beside the rig's folder, or the rig's folder."
        ),
    ] = None,
    tls_certificate: Annotated[Path | None, typer.Option("--tls-certificate", help="PEM file.")] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", help="PEM file.")] = None,
    test_notifications: Annotated[
        bool,
        typer.Option("--test-notifications", help="Send a message through each channel that is set up, and end."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Own a cell's queue and serve its console, until Ctrl-C. Runs that are being acquired go on without it.

    The first start prints a token, with which the engineer signs in once, to make accounts.
    """
    from coupole.console.service import serve as serve_cell
    from coupole.plan.cell import read_cell
    from coupole.viewing.terminal import make_console

    if test_notifications:
        _test_notifications(rig, as_json=as_json)
        return
    if (tls_certificate is None) != (tls_key is None):
        raise InputError("--tls-certificate and --tls-key go together")
    tls = (tls_certificate, tls_key) if tls_certificate and tls_key else None
    console = make_console(quiet=as_json)

    def tell(service_facts: dict[str, Any]) -> None:
        if as_json:
            print(json.dumps(service_facts), flush=True)
        console.print(f"console {service_facts['url']}", markup=False)
        if service_facts["token"]:
            console.print(f"sign in once as engineer with the token {service_facts['token']}", markup=False)

    cell = read_cell(rig)
    serve_cell(
        cell,
        host=host,
        port=port,
        names=[*(name or []), socket.gethostname()],
        plans=plans or _plans_beside(cell.document.path),
        tls=tls,
        tell=tell,
    )


def _plans_beside(rig: Path) -> Path:
    """Return the folder `plans` beside the rig's folder, or the rig's own folder. For a rig in an installed
    package, return the working folder."""
    from coupole.plan.shipped_files import place_to_write

    rig_folder = rig.resolve().parent
    beside = rig_folder.parent / "plans"
    folder = beside if beside.is_dir() else rig_folder
    return folder if place_to_write(folder) == folder else Path.cwd()


def _test_notifications(rig: Path, *, as_json: bool) -> None:
    """Send a test message by each way of notification. Raises InputError if none is set up, or if a message could
    not be sent."""
    from coupole.console.upkeep.notifications import NAME, console_folder, read_settings
    from coupole.console.upkeep.notifier import send_test
    from coupole.plan.cell import read_cell
    from coupole.viewing.terminal import make_console

    cell, console = read_cell(rig), make_console(quiet=as_json)
    folder = console_folder(cell)
    settings = read_settings(folder)
    if settings is None:
        raise InputError(
            f"{folder / NAME}: no such file, so nobody is notified; docs/reference/console.md describes its "
            "content"
        )
    troubles_by_way = send_test(settings, cell.rig.name)
    for way, trouble in troubles_by_way.items():
        console.print(f"{way}: {trouble or 'sent'}", markup=False)
    if as_json:
        print(json.dumps(troubles_by_way))
    if troubles := [f"{way}: {trouble}" for way, trouble in troubles_by_way.items() if trouble]:
        raise InputError("not sent: " + "; ".join(troubles))


def queue(
    rig: RigPath,
    plan: Annotated[
        list[Path] | None,
        typer.Argument(help="Plans to enter, in this order.", show_default=False, autocompletion=some_plans),
    ] = None,
    resume: Annotated[
        list[Path] | None,
        typer.Option("--resume", help="Resume this run after the plans; repeat for more.", autocompletion=runs),
    ] = None,
    hold: Annotated[
        str, typer.Option("--hold", help="After these plans, wait for a person to do this.", show_default=False)
    ] = "",
    before: Annotated[
        str, typer.Option("--before", help="Put the new or moved entry before this one.", show_default=False)
    ] = "",
    move: Annotated[
        str, typer.Option("--move", help="Move this entry to the end, or --before another.", show_default=False)
    ] = "",
    take_out: Annotated[str, typer.Option("--take-out", help="Remove this entry.", show_default=False)] = "",
    go_on: Annotated[bool, typer.Option("--go-on", help="Continue after a hold or a fault.")] = False,
    take_control: Annotated[
        bool, typer.Option("--take-control", help="First take control from the person who has it.")
    ] = False,
    give_control: Annotated[bool, typer.Option("--give-control", help="Give up control last.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Enter plans in the queue of a cell whose console is served on this machine; without plans, show the queue.

    Each plan is checked by preflight when it is entered, together with the plans that run and wait before it.
    """
    from coupole.console.command_line.client import PREFLIGHT_S, call
    from coupole.plan.cell import read_cell
    from coupole.viewing.terminal import make_console

    cell, console = read_cell(rig), make_console(quiet=as_json)
    if take_control:
        call(cell, "POST", "/api/v1/control/take")
    if take_out:
        call(cell, "DELETE", f"/api/v1/queue/{take_out}")
    if move:
        call(cell, "POST", f"/api/v1/queue/{move}/move", {"before": before})
    for request in _queue_requests(plan or [], resume or [], hold):
        with console.status("preflight ..."):
            call(cell, "POST", "/api/v1/queue", {**request, "before": before}, patience_s=PREFLIGHT_S)
    if go_on:
        call(cell, "POST", "/api/v1/queue/go-on")
    if give_control:
        call(cell, "POST", "/api/v1/control/give", {})
    state = call(cell, "GET", "/api/v1/state")
    _show_queue(console, state)
    if as_json:
        print(json.dumps(state))


def _queue_requests(plans: list[Path], resumed_runs: list[Path], hold: str) -> list[dict[str, str]]:
    """List the entries to be made, in order."""
    requests = [{"plan": str(path.resolve())} for path in plans] + [
        {"resume": str(path.resolve())} for path in resumed_runs
    ]
    return [*requests, *([{"hold": hold}] if hold else [])]


def _show_queue(console: RichConsole, state: dict[str, Any]) -> None:
    why = state["halted"] or (f"lent to {state['lent_to']}" if state["lent_to"] else "")
    console.print(f"{state['rig']}: {state['state']}" + (f": {why}" if why else ""), markup=False)
    for entry in state["queue"]:
        words = f"hold: {entry['hold']}" if entry["hold"] else entry["plan"]
        words = words or f"resume {entry['resume']}"
        note = f" ({entry['said']})" if entry["said"] else ""
        console.print(f"  {entry['id']}  {entry['state']:8}  {words}{note}{_outlook(entry)}", markup=False)


def _outlook(entry: dict[str, Any]) -> str:
    """Return when an entry is expected to run and what it needs; empty if it has ended."""
    from coupole.viewing.terminal import bytes_text, duration_text

    begin, end = (
        f"{datetime.fromisoformat(entry[key]).astimezone():%a %H:%M}" if entry[key] else ""
        for key in ("expected_begin", "expected_end")
    )
    text = f"  {begin} to {end or 'not known'}" if begin else ""
    if (needs := entry["needs"]) is not None and entry["state"] in ("waiting", "running"):
        size = f"{duration_text(needs['duration_s'])}, {bytes_text(needs['bytes'])}"
        text += f"  {size}, {needs['dose_lux_h']:.3f} lux.h"
    return text
