"""`coupole serve`: the process that owns a cell's queue and serves its console."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import getpass
import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from coupole.console.cell.acquisitions import Acquisitions
from coupole.console.cell.bench_keeper import Bench
from coupole.console.cell.calibration_status import CalibrationStatus
from coupole.console.cell.state_now import Newest, state_of
from coupole.console.command_line.client import service_socket
from coupole.console.people.accounts import Account, Accounts, Role
from coupole.console.people.audit import Audit
from coupole.console.people.sessions import Control, Session, Sessions
from coupole.console.people.still_wanted import LoopWatch
from coupole.console.plans.drafts import Desk
from coupole.console.plans.entering import Entering
from coupole.console.plans.object_files import ObjectFiles
from coupole.console.plans.plan_files import PlanFiles
from coupole.console.plans.plan_queue import PlanQueue
from coupole.console.processes.tasks import Tasks
from coupole.console.routes.api import make_app
from coupole.console.routes.messages import StateNow
from coupole.console.routes.sockets import in_url, is_here, listen, origins_of, run_servers, tls_context
from coupole.console.runs.frame_sheets import FrameSheets
from coupole.console.runs.run_files import RunFiles
from coupole.console.runs.run_watch import RunWatch
from coupole.console.screens.all_screens import add_screens
from coupole.console.service_parts import Service
from coupole.console.upkeep.notifications import console_folder, read_settings
from coupole.console.upkeep.notifier import Notifier, Occurrences
from coupole.console.upkeep.support_bundle import SupportBundles
from coupole.errors import InputError, StorageError, reason
from coupole.plan.cell import Cell
from coupole.storage.durable import make_folder


def serve(
    cell: Cell,
    *,
    host: str,
    port: int,
    names: Sequence[str],
    plans: Path,
    tls: tuple[Path, Path] | None,
    tell: Callable[[dict[str, Any]], object],
) -> None:
    """Serve a cell's console until a signal ends it; acquisitions continue.

    `names` are other names under which browsers reach this machine. `tell` is called with `url`, `token` and `pid`
    when the service listens.

    Raises InputError if another service owns the cell, if the address does not exist, or if others can reach it
    and there is no TLS; StorageError.
    """
    if not is_here(host) and tls is None:
        raise InputError(
            f"--host {host}: other machines can reach this address: give --tls-certificate and --tls-key"
        )
    folder = console_folder(cell)
    try:
        make_folder(folder)
        folder.chmod(0o700)  # hashes of passwords, and the log of people's requests
    except OSError as error:
        raise StorageError(f"{folder}: the console's folder cannot be used: {reason(error)}") from error
    with _console_lock(folder):
        context, listening = tls_context(tls), listen(host, port)
        port = listening.getsockname()[1]
        url = f"{'https' if tls else 'http'}://{in_url(host)}:{port}"
        known_as = [host, *names, *(["localhost", "127.0.0.1"] if is_here(host) else [])]
        with _parts(cell, folder, plans, origins_of(url, known_as), f"coupole_session_{port}") as service:
            app = make_app(service)
            add_screens(app, service)
            address = {"url": url, "token": service.accounts.first_token, "pid": os.getpid()}
            asyncio.run(
                run_servers(
                    app, listening, service_socket(cell), context, lambda: tell(address), service.loop_watch.beat
                )
            )


@contextlib.contextmanager
def _parts(cell: Cell, folder: Path, plans: Path, origins: frozenset[str], cookie: str) -> Iterator[Service]:
    """Make all parts of the service, begin them, and end them in order; `folder` stores what must survive the
    service."""
    with contextlib.ExitStack() as parts:
        audit = parts.enter_context(contextlib.closing(Audit(folder / "audit.jsonl")))
        queue, settings, control = PlanQueue(folder / "queue.json"), read_settings(folder), Control()
        occurrences = Occurrences(cell, queue, settings.disk_low_gb if settings else 0.0)
        accounts = Accounts(folder / "accounts.json")
        notifier = parts.enter_context(Notifier(settings, occurrences, folder))
        acquisitions = parts.enter_context(Acquisitions(queue, cell, folder / "output"))
        runs = RunFiles(cell.storage_folder, folder / "verified")
        plan_files = PlanFiles(plans, cell.document.path, folder / "drawings")

        bench = parts.enter_context(Bench(cell, acquisitions, plan_files, folder / "bench", control=control))
        entering = parts.enter_context(contextlib.closing(Entering(cell, plans, queue, acquisitions)))

        def state() -> StateNow:
            trouble = "; ".join(filter(None, (audit.trouble, notifier.trouble)))
            checking = entering.preflight.words
            return state_of(cell, queue, acquisitions, bench, control, checking=checking, trouble=trouble)

        yield Service(
            cell=cell,
            folder=folder,
            plans=plans,
            accounts=accounts,
            sessions=Sessions(holds=accounts.holds),
            control=control,
            loop_watch=LoopWatch(),
            audit=audit,
            queue=queue,
            acquisitions=acquisitions,
            plan_files=plan_files,
            desk=parts.enter_context(contextlib.closing(Desk())),
            runs=runs,
            sheets=FrameSheets(runs, folder / "means"),
            watch=RunWatch(runs),
            bench=bench,
            calibrations=CalibrationStatus(cell, plans),
            bundles=SupportBundles(cell, plans, folder),
            objects=ObjectFiles(cell, plan_files, runs, cell.state_folder / "objects"),
            tasks=parts.enter_context(contextlib.closing(Tasks(folder / "commands"))),
            state=state,
            newest=Newest(state),
            entering=entering,
            origins=origins,
            cookie=cookie,
            command_line=Session(Account(f"{getpass.getuser()} (command line)", Role.ENGINEER), 0.0, script=True),
        )


@contextlib.contextmanager
def _console_lock(folder: Path) -> Iterator[None]:
    """Lock the cell's console for this process. Raises InputError if another process has it."""
    with (folder / "lock").open("w", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"{folder}: another `coupole serve` has this cell") from error
        json.dump({"pid": os.getpid()}, lock)
        lock.flush()
        yield
