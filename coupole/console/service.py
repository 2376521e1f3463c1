"""`coupole serve`: the process that owns a cell's queue and serves its console."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import functools
import getpass
import ipaddress
import json
import os
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from coupole.console.accounts import Account, Accounts, Role
from coupole.console.acquisitions import Acquisitions
from coupole.console.api import make_app
from coupole.console.audit import Audit
from coupole.console.calibration_status import CalibrationStatus
from coupole.console.client import service_socket
from coupole.console.frame_sheets import FrameSheets
from coupole.console.messages import StateNow
from coupole.console.plan_queue import PlanQueue
from coupole.console.run_files import RunFiles
from coupole.console.run_watch import RunWatch
from coupole.console.screens.all_screens import add_screens
from coupole.console.service_parts import Service
from coupole.console.sessions import Control, Session, Sessions
from coupole.console.support_bundle import SupportBundles
from coupole.console.tasks import Tasks
from coupole.errors import CoupoleError, InputError
from coupole.plan import yamlfile
from coupole.plan.cell import Cell
from coupole.plan.rig_devices import in_world
from coupole.preflight.job import read_job
from coupole.storage.arm_faults import ArmFaults
from coupole.storage.durable import make_folder
from coupole.storage.ledger import History, Ledger
from coupole.storage.line_file import utc_now
from coupole.storage.run import Run

_STOP_WITHIN_S, _NEWEST_S = 2, 0.1


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
    folder = cell.state_folder / "console"
    make_folder(folder)
    folder.chmod(0o700)  # hashes of passwords, and who did what
    with _owned(folder), contextlib.closing(Audit(folder / "audit.jsonl")) as audit:
        queue = PlanQueue(folder / "queue.json")
        accounts = Accounts(folder / "accounts.json")
        context = _tls_context(tls)
        listening = _listen(host, port)
        port = listening.getsockname()[1]
        url = f"{'https' if tls else 'http'}://{_in_url(host)}:{port}"
        with Acquisitions(queue, cell, folder / "output") as acquisitions:
            control = Control()
            runs = RunFiles(cell.storage_folder, folder / "verified")
            tasks = Tasks(folder / "commands")
            service = Service(
                cell, folder, plans, accounts, Sessions(), control, audit, queue, acquisitions,
                runs, FrameSheets(runs, folder / "means"), CalibrationStatus(cell, plans),
                SupportBundles(cell, plans, folder), RunWatch(runs), tasks,
                state=lambda: state_of(cell, queue, acquisitions, control, audit),
                newest=Newest(lambda: state_of(cell, queue, acquisitions, control, audit)),
                read_plan=lambda name: read_plan(cell, plans, name),
                origins=_origins(url, [host, *names, *(["localhost", "127.0.0.1"] if _is_here(host) else [])]),
                cookie=f"coupole_session_{port}",
                command_line=Session(
                    Account(f"{getpass.getuser()} (command line)", Role.ENGINEER), 0.0, script=True
                ),
            )  # fmt: skip
            tell({"url": url, "token": accounts.first_token, "pid": os.getpid()})
            try:
                asyncio.run(_run(service, listening, service_socket(cell), context))
            finally:
                tasks.close()


class Newest:
    """A state that is made anew by a thread of its own, however many ask for it."""

    def __init__(self, make: Callable[[], StateNow]) -> None:
        self._make, self._state = make, make()
        threading.Thread(target=self._renew, name="newest state", daemon=True).start()

    def __call__(self) -> StateNow:
        return self._state

    def _renew(self) -> None:
        while True:
            time.sleep(_NEWEST_S)
            try:
                self._state = self._make()
            except Exception as error:  # noqa: BLE001  the old one must not be taken for what is so
                self._state = self._state.model_copy(update={"trouble": str(error), "t": utc_now()})


def state_of(cell: Cell, queue: PlanQueue, acquisitions: Acquisitions, control: Control, audit: Audit) -> StateNow:
    """The cell at this moment."""
    at_work, entry = acquisitions.state or {}, queue.running
    begun = "halted" if queue.halted else "idle"
    if entry is not None:
        begun = "concluding" if entry.run else "starting"
    faults = ArmFaults(cell.state_folder).standing()
    return StateNow(
        state=at_work.get("state", begun),
        rig=cell.rig.name,
        simulated=in_world(cell.rig, dry_run=False),
        run=Path(at_work["run"]).name if at_work else None,
        view=at_work.get("view"),
        proven=at_work.get("proven", 0),
        frames=at_work.get("frames", 0),
        dose=at_work.get("dose_lux_h", 0.0),
        **(_object_of(cell, at_work["run"]) if at_work else _NO_OBJECT),
        left_s=at_work.get("left_s"),
        halted=queue.halted,
        arm_fault=faults[-1].message if faults else "",
        devices=_devices(at_work["run"]) if at_work else {},
        queue=list(queue.entries),
        in_control=control.now.name,
        asked_by=control.now.asked_by,
        trouble=audit.trouble,
        t=utc_now(),
    )


@functools.lru_cache(4)
def _devices(run: str) -> dict[str, Any]:
    """Identities of a run's devices, which do not change."""
    try:
        return dict(Run(Path(run)).about["devices"])
    except (InputError, KeyError):
        return {}


_NO_OBJECT = {"object": "", "dose_before": 0.0, "dose_budget": None}


def _object_of(cell: Cell, run: str) -> dict[str, Any]:
    """Of a run that is being acquired."""
    return _object_when(cell.ledger_folder, cell.former_ledger_folder, run)


@functools.lru_cache(4)
def _object_when(ledgers: Path, former: Path, run: str) -> dict[str, Any]:
    """A run's object, the light on it that is not this run's, and its budget; they do not change while it runs."""
    try:
        opened = Run(Path(run))
        named = opened.about.get("object") or ""
        plan = yamlfile.read(opened.plan_path).data
        history = Ledger(ledgers, named, former).read() if named else History()
    except CoupoleError:
        return _NO_OBJECT
    before = sum(entry.dose_lux_h for entry in history.entries if entry.run != opened.folder.name)
    budget = (plan.get("object") or {}).get("dose_budget_lux_h")
    return {"object": named, "dose_before": before, "dose_budget": budget}


def read_plan(cell: Cell, plans: Path, name: str) -> Path:
    """The file of a plan in the folder of plans, if it is whole and for this cell. Raises InputError."""
    path = (plans / name).resolve()
    if not path.is_relative_to(plans.resolve()):
        raise InputError(f"plan: expected a file below {plans}; found {name!r}")
    if "views" not in yamlfile.read(path).data:
        raise InputError(f"{path}: expected a plan, with `views`")
    job = read_job(path)
    if job.cell.document.path.resolve() != cell.document.path.resolve():
        raise InputError(f"{path}: its rig is {job.cell.document.path}; this console's is {cell.document.path}")
    return path


# -- sockets --------------------------------------------------------------------------------------------------


class _OfThisUser(H11Protocol):
    """HTTP on a Unix socket, with processes of this user alone."""

    def connection_made(self, transport: Any) -> None:
        peer = transport.get_extra_info("socket").getsockopt(
            socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")
        )
        if struct.unpack("3i", peer)[1] not in (os.getuid(), 0):
            transport.abort()
            return
        super().connection_made(transport)


async def _run(service: Service, listening: socket.socket, path: Path, tls: ssl.SSLContext | None) -> None:
    app = make_app(service)
    add_screens(app, service)
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
