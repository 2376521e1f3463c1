"""`coupole serve`: the process that owns a cell's queue and serves its console."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import getpass
import ipaddress
import json
import os
import socket
import ssl
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from coupole.console.accounts import Account, Accounts, Role
from coupole.console.acquisitions import Acquisitions
from coupole.console.api import make_app
from coupole.console.api_at_the_cell import add_routes_at_the_cell
from coupole.console.audit import Audit
from coupole.console.bench_keeper import Bench
from coupole.console.client import service_socket
from coupole.console.drafts import Desk
from coupole.console.entering import Entering
from coupole.console.frame_sheets import FrameSheets
from coupole.console.messages import StateNow
from coupole.console.notifications import console_folder, read_settings
from coupole.console.notifier import Notifier, Occurrences
from coupole.console.object_files import ObjectFiles
from coupole.console.plan_files import PlanFiles
from coupole.console.plan_queue import PlanQueue
from coupole.console.run_files import RunFiles
from coupole.console.run_watch import RunWatch
from coupole.console.screens.all_screens import add_screens
from coupole.console.service_parts import Service
from coupole.console.sessions import Control, Session, Sessions
from coupole.console.state_now import Newest, state_of
from coupole.console.tasks import Tasks
from coupole.errors import InputError
from coupole.plan.cell import Cell
from coupole.storage.durable import make_folder

_STOP_WITHIN_S = 2


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
    """Serve a cell's console until a signal ends it; runs that are being acquired go on. `names` are other names
    under which browsers know this machine; `tell` is called with `url`, `token` and `pid` when it listens.

    Raises InputError: another service owns the cell, an address without TLS that others can reach, no such
    address; StorageError.
    """
    if not _is_here(host) and tls is None:
        raise InputError(f"--host {host}: others can reach this address: give --tls-certificate and --tls-key")
    folder = console_folder(cell)
    make_folder(folder)
    folder.chmod(0o700)  # hashes of passwords, and who did what
    with _owned(folder), contextlib.closing(Audit(folder / "audit.jsonl")) as audit:
        queue = PlanQueue(folder / "queue.json")
        settings = read_settings(folder)
        occurrences = Occurrences(cell, queue, settings.disk_low_gb if settings else 0.0)
        accounts = Accounts(folder / "accounts.json")
        context = _tls_context(tls)
        listening = _listen(host, port)
        port = listening.getsockname()[1]
        url = f"{'https' if tls else 'http'}://{_in_url(host)}:{port}"
        plan_files = PlanFiles(plans, cell.document.path, folder / "drawings")
        with (
            Notifier(settings, occurrences, folder) as notifier,
            Acquisitions(queue, cell, folder / "output") as acquisitions,
            contextlib.closing(Entering(cell, plans, queue, acquisitions)) as entering,
            Bench(cell, acquisitions, plan_files, folder / "bench") as bench,
            contextlib.closing(Tasks(folder / "commands")) as tasks,
            contextlib.closing(Desk()) as desk,
        ):
            control = Control()
            runs = RunFiles(cell.storage_folder, folder / "verified")
            objects = ObjectFiles(cell, plan_files, runs, cell.state_folder / "objects")

            def state() -> StateNow:
                trouble = "; ".join(filter(None, (audit.trouble, notifier.trouble)))
                return state_of(cell, queue, acquisitions, bench, control, trouble)

            service = Service(
                cell, plans, accounts, Sessions(), control, audit, queue, acquisitions,
                plan_files, desk, runs, FrameSheets(runs, folder / "means"), RunWatch(runs), objects, tasks, bench,
                state=state,
                newest=Newest(state),
                entering=entering,
                origins=_origins(url, [host, *names, *(["localhost", "127.0.0.1"] if _is_here(host) else [])]),
                cookie=f"coupole_session_{port}",
                command_line=_command_line(),
            )  # fmt: skip
            tell({"url": url, "token": accounts.first_token, "pid": os.getpid()})
            asyncio.run(_run(_app(service), listening, service_socket(cell), context))


def _command_line() -> Session:
    return Session(Account(f"{getpass.getuser()} (command line)", Role.ENGINEER), 0.0, script=True)


def _app(service: Service) -> FastAPI:
    app = make_app(service)
    add_routes_at_the_cell(app, service, service.cell)
    add_screens(app, service)
    return app


# -- sockets --------------------------------------------------------------------------------------------------


class _OfThisUser(H11Protocol):
    """HTTP on a Unix socket, with processes of this user alone. Their number stands for the client's port."""

    def connection_made(self, transport: Any) -> None:
        peer = transport.get_extra_info("socket").getsockopt(
            socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")
        )
        pid, uid, _ = struct.unpack("3i", peer)
        if uid not in (os.getuid(), 0):
            transport.abort()
            return
        super().connection_made(transport)
        self.client = "command line", pid


async def _run(app: FastAPI, listening: socket.socket, path: Path, tls: ssl.SSLContext | None) -> None:
    page, line = uvicorn.Server(_config(app, lifespan="on")), uvicorn.Server(_config(app, lifespan="off"))
    page.config.ssl_context_factory = (lambda *_: tls) if tls else None
    line.config.http = _OfThisUser
    path.unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX) as local:
        local.bind(str(path))
        path.chmod(0o600)
        try:
            page_task = asyncio.create_task(page.serve(sockets=[listening]))
            line_task = asyncio.create_task(line.serve(sockets=[local]))
            await asyncio.wait({page_task, line_task}, return_when=asyncio.FIRST_COMPLETED)
            page.should_exit = line.should_exit = True
            await asyncio.gather(page_task, line_task)
        finally:
            path.unlink(missing_ok=True)


def _config(app: FastAPI, lifespan: Literal["on", "off"]) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        timeout_graceful_shutdown=_STOP_WITHIN_S,
        lifespan=lifespan,
        proxy_headers=False,
        server_header=False,
    )


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(128)
    except OSError as error:
        raise InputError(f"--host {host} --port {port}: cannot listen there: {error}") from error
    return listening


def _tls_context(tls: tuple[Path, Path] | None) -> ssl.SSLContext | None:
    """Raises InputError: the files are no certificate with its key."""
    if tls is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(*tls)
    except (OSError, ssl.SSLError) as error:
        raise InputError(f"{tls[0]}, {tls[1]}: expected a certificate and its key as PEM: {error}") from error
    return context


def _is_here(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _origins(url: str, hosts: Sequence[str]) -> frozenset[str]:
    """Of pages at these hosts; browsers leave out the port that is their scheme's own."""
    scheme, port = url.partition("://")[0], url.rpartition(":")[2]
    places = {f"{scheme}://{_in_url(host)}" for host in hosts}
    own = port == {"http": "80", "https": "443"}[scheme]
    return frozenset({f"{place}:{port}" for place in places} | (places if own else set()))


@contextlib.contextmanager
def _owned(folder: Path) -> Iterator[None]:
    """The cell's console, of this process alone. Raises InputError: another one has it."""
    with (folder / "lock").open("w", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"{folder}: another `coupole serve` has this cell") from error
        json.dump({"pid": os.getpid()}, lock)
        lock.flush()
        yield
