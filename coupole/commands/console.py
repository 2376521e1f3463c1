"""The operator's console: serve it, and its queue from the command line."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Annotated, Any

import typer

from coupole.commands.common import JsonOption
from coupole.commands.completion import plans as some_plans
from coupole.errors import InputError

RigPath = Annotated[Path, typer.Argument(help="The rig (YAML).", show_default=False)]


def serve(
    rig: RigPath,
    host: Annotated[str, typer.Option("--host", help="Address; of others than this machine only with TLS.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0: any.")] = 8640,
    name: Annotated[
        list[str] | None,
        typer.Option("--name", help="Another name under which browsers know this machine.", show_default=False),
    ] = None,
    plans: Annotated[
        Path | None,
        typer.Option("--plans", help="Folder of plans; without it `plans` beside the rig's folder, or the rig's."),
    ] = None,
    tls_certificate: Annotated[Path | None, typer.Option("--tls-certificate", help="PEM file.")] = None,
    tls_key: Annotated[Path | None, typer.Option("--tls-key", help="PEM file.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Own a cell's queue and serve its console, until Ctrl-C. Runs that are being acquired go on without it.

    At the first start a token is printed with which the engineer signs in, once, to make accounts.
    """
    try:
        from coupole.console.service import serve as serve_cell
    except ModuleNotFoundError as error:
        raise InputError(f"the console wants {error.name}: install coupole[console]") from error
    from coupole.plan.cell import read_cell
    from coupole.viewing.terminal import make_console

    if (tls_certificate is None) != (tls_key is None):
        raise InputError("--tls-certificate and --tls-key go together")
    tls = (tls_certificate, tls_key) if tls_certificate and tls_key else None
    console = make_console(quiet=as_json)

    def tell(found: dict[str, Any]) -> None:
        if as_json:
            print(json.dumps(found), flush=True)
        console.print(f"console {found['url']}", markup=False)
        if found["token"]:
            console.print(f"sign in once as engineer with the token {found['token']}", markup=False)

    beside = rig.resolve().parent.parent / "plans"
    folder = plans or (beside if beside.is_dir() else rig.resolve().parent)
    serve_cell(
        read_cell(rig),
        host=host,
        port=port,
        names=[*(name or []), socket.gethostname()],
        plans=folder,
        tls=tls,
        tell=tell,
    )


def queue(
    rig: RigPath,
    plan: Annotated[
        list[Path] | None,
        typer.Argument(help="Plans to enter, in this order.", show_default=False, autocompletion=some_plans),
    ] = None,
    hold: Annotated[
        str, typer.Option("--hold", help="After them wait for a person, who is to do this.", show_default=False)
    ] = "",
    take_out: Annotated[str, typer.Option("--take-out", help="Take out this entry.", show_default=False)] = "",
    go_on: Annotated[bool, typer.Option("--go-on", help="Go on after a hold or a fault.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Enter plans in the queue of a cell whose console is served on this machine; without plans show it."""
    from coupole.console.client import call
    from coupole.plan.cell import read_cell
    from coupole.viewing.terminal import make_console

    cell = read_cell(rig)
    if take_out:
        call(cell, "DELETE", f"/api/v1/queue/{take_out}")
    for one in plan or []:
        call(cell, "POST", "/api/v1/queue", {"plan": str(one.resolve())})
    if hold:
        call(cell, "POST", "/api/v1/queue", {"hold": hold})
    if go_on:
        call(cell, "POST", "/api/v1/queue/go-on")
    state = call(cell, "GET", "/api/v1/state")
    console = make_console(quiet=as_json)
    console.print(
        f"{state['rig']}: {state['state']}" + (f": {state['halted']}" if state["halted"] else ""), markup=False
    )
    for entry in state["queue"]:
        words = entry["plan"] or f"hold: {entry['hold']}"
        why = f" ({entry['said']})" if entry["said"] else ""
        console.print(f"  {entry['id']}  {entry['state']:8}  {words}{why}", markup=False)
    if as_json:
        print(json.dumps(state))
