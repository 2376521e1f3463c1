"""Sockets of a console: a port for browsers, with TLS if other machines can reach it, and a Unix socket for
commands."""

from __future__ import annotations

import asyncio
import ipaddress
import os
import socket
import ssl
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from coupole.errors import InputError

_STOP_WITHIN_S = 2
_BEAT_S = 0.1


class _Known(H11Protocol):
    """HTTP whose requests have their `connection`, a socket, in their state."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.app_state = {**self.app_state, "connection": transport.get_extra_info("socket")}


class _OfThisUser(_Known):
    """HTTP on a Unix socket, with processes of this user only. The process id takes the place of the client's
    port."""

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


async def run_servers(
    app: FastAPI,
    listening: socket.socket,
    path: Path,
    tls: ssl.SSLContext | None,
    tell: Callable[[], object],
    beat: Callable[[], object],
) -> None:
    """Serve until a signal ends it. `tell` is called once when both sockets listen, `beat` repeatedly."""
    page, line = uvicorn.Server(_config(app, lifespan="on")), uvicorn.Server(_config(app, lifespan="off"))
    page.config.ssl_context_factory = (lambda *_: tls) if tls else None
    page.config.http, line.config.http = _Known, _OfThisUser
    path.unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX) as local:
        local.bind(str(path))
        path.chmod(0o600)
        try:
            page_task = asyncio.create_task(page.serve(sockets=[listening]))
            line_task = asyncio.create_task(line.serve(sockets=[local]))
            beating = asyncio.create_task(_beat(lambda: page.started and line.started, tell, beat))
            await asyncio.wait({page_task, line_task, beating}, return_when=asyncio.FIRST_COMPLETED)
            beating.cancel()
            page.should_exit = line.should_exit = True
            await asyncio.gather(page_task, line_task)
        finally:
            path.unlink(missing_ok=True)


async def _beat(listens: Callable[[], bool], tell: Callable[[], object], beat: Callable[[], object]) -> None:
    while not listens():
        beat()
        await asyncio.sleep(_BEAT_S)
    tell()
    while True:
        beat()
        await asyncio.sleep(_BEAT_S)


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


def listen(host: str, port: int) -> socket.socket:
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(128)
    except OSError as error:
        raise InputError(f"--host {host} --port {port}: cannot listen there: {error}") from error
    return listening


def tls_context(tls: tuple[Path, Path] | None) -> ssl.SSLContext | None:
    """Return the TLS context of a certificate and its key. Raises InputError if the files are not such a pair."""
    if tls is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(*tls)
    except (OSError, ssl.SSLError) as error:
        raise InputError(f"{tls[0]}, {tls[1]}: expected a certificate and its key as PEM: {error}") from error
    return context


def is_here(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def origins_of(url: str, hosts: Sequence[str]) -> frozenset[str]:
    """Return the origins of pages at these hosts; browsers leave out the default port of a scheme."""
    scheme, port = url.partition("://")[0], url.rpartition(":")[2]
    places = {f"{scheme}://{in_url(host)}" for host in hosts}
    is_default_port = port == {"http": "80", "https": "443"}[scheme]
    return frozenset({f"{place}:{port}" for place in places} | (places if is_default_port else set()))
