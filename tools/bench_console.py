"""Cost of ten watchers at a console: efficiency of the acquisition with watchers, divided by that without.

Watchers are clients of the Run screen. They speak the screens' own protocol (socket.io over WebSocket) and fetch
each new picture, as browsers do. They draw nothing, because browsers on other machines would cost this machine
nothing. Cell, console, run and watchers are all on one machine.
"""

from __future__ import annotations

import asyncio
import json
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from demo_plan import write_demo_plan

WATCHERS, SMALLEST_WATCHERS = 10, 2
SMALLEST = {"kind": "every", "every": 40}
"""Lights of the plan for the smallest size."""
_PASSWORD = "a long password"
_RUNS_TAKE_S = 900.0


@dataclass
class Console:
    """A served cell. Requests go to it as from the command line, and as from people."""

    root: Path
    rig: Path
    process: subprocess.Popen[str]
    url: str

    def ask(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        sys.path.insert(0, str(self.root))
        from coupole.console.command_line.client import call
        from coupole.plan.cell import read_cell

        return call(read_cell(self.rig), method, path, body)

    def acquire(self, plan: Path) -> dict[str, Any]:
        """Acquire a plan; return its figures when it has ended. Raises RuntimeError if not all shots were
        proven."""
        entry = self.ask("POST", "/api/v1/queue", {"plan": str(plan), "now": True})["id"]
        end_s = time.monotonic() + _RUNS_TAKE_S
        while time.monotonic() < end_s:
            time.sleep(1.0)
            reply = self.ask("GET", f"/api/v1/queue/{entry}/output")
            if reply["entry"]["state"] not in ("waiting", "running"):
                figures: dict[str, Any] = reply["figures"]
                if reply["entry"]["state"] != "done" or figures["missing"]:
                    raise RuntimeError(f"a run was not complete: {reply}")
                return figures
        raise RuntimeError("a run took too long")


@dataclass
class Seen:
    """Counts of a watcher's messages, and the addresses (`shots`) that it fetched."""

    connections: int = 0
    updates: int = 0
    pictures: int = 0
    bytes: int = 0
    shots: set[str] = field(default_factory=set)


async def _watch(url: str, cookies: dict[str, str], until: asyncio.Event, traffic: Seen) -> None:
    import aiohttp
    import socketio

    async with aiohttp.ClientSession(cookies=cookies) as http:
        async with http.get(f"{url}/run") as reply:
            page = await reply.text()
        query = {
            "client_id": _first_match(r"['\"]client_id['\"]: ?['\"]([0-9a-f-]+)['\"]", page),
            "document_id": "bench",
            "tab_id": "bench",
            "old_tab_id": "",
            "next_message_id": 0,
        }
        client = socketio.AsyncClient(http_session=http)

        async def update(data: Any) -> None:
            traffic.updates += 1
            for address in re.findall(r"/api/v1/runs/[^\"'\\ ]+", json.dumps(data)):
                if address not in traffic.shots:
                    traffic.shots.add(address)
                    async with http.get(url + address.replace("&amp;", "&")) as picture:
                        traffic.bytes += len(await picture.read())
                        traffic.pictures += picture.status == 200

        async def on_connect() -> None:
            traffic.connections += 1
            assert await client.call("handshake", query), "the screen did not take the watcher"
            query["next_message_id"] = None  # after a lost connection, go on with the next message

        client.on("update", update)
        client.on("connect", on_connect)
        headers = {"Origin": url, "Cookie": "; ".join(f"{name}={value}" for name, value in cookies.items())}
        await client.connect(url, headers, transports=["websocket"], socketio_path="/_nicegui_ws/socket.io")
        await until.wait()
        await client.disconnect()


def _first_match(pattern: str, text: str) -> str:
    match = re.search(pattern, text)
    assert match, f"no {pattern} in the page"
    return match.group(1)


def _watchers(url: str, count: int) -> None:
    """Run this number of watchers until this process is told to end; then print their counts."""

    async def work() -> None:
        import aiohttp

        until, all_seen = asyncio.Event(), [Seen() for _ in range(count)]
        loop = asyncio.get_running_loop()
        loop.add_reader(sys.stdin, until.set)
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as http:
            credentials = {"name": "Eve", "password": _PASSWORD}
            async with http.post(f"{url}/api/v1/sign-in", json=credentials) as reply:
                reply.raise_for_status()
                cookies = {cookie.key: cookie.value for cookie in http.cookie_jar}
        await asyncio.gather(*(_watch(url, cookies, until, watcher) for watcher in all_seen))
        print(
            json.dumps(
                [[watcher.updates, watcher.pictures, watcher.bytes, watcher.connections] for watcher in all_seen]
            )
        )

    asyncio.run(work())


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    count = SMALLEST_WATCHERS if smallest else WATCHERS
    with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as name:
        folder = Path(name)
        rig, plan = _cell(root, folder, {"lights": SMALLEST} if smallest else {})
        console = _serve(root, rig, folder)
        without: list[float] = []
        efficiencies: list[float] = []
        counts_of_watchers = [[0, 0, 0, 0]]
        try:
            console.ask("POST", "/api/v1/accounts", {"name": "Eve", "password": _PASSWORD, "role": "observer"})
            for _ in range(rounds):
                without.append(console.acquire(plan)["efficiency"])
                command = [sys.executable, __file__, console.url, str(count)]
                with subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
                ) as watchers:
                    efficiencies.append(console.acquire(plan)["efficiency"])
                    counts_of_watchers = json.loads(watchers.communicate("\n")[0])
        finally:
            console.process.terminate()
            console.process.wait()
    value, peer = statistics.median(efficiencies), statistics.median(without)
    yield {
        "name": "efficiency_with_ten_watchers" if count == WATCHERS else f"efficiency_with_{count}_watchers",
        "value": value,
        "unit": "ideal/taken",
        "peer": "nobody_watches",
        "ratio": value / peer,
        "updates": min(counts[0] for counts in counts_of_watchers),
        "pictures": min(counts[1] for counts in counts_of_watchers),
        "connections": max(counts[3] for counts in counts_of_watchers),
        "mb": round(sum(counts[2] for counts in counts_of_watchers) / 1e6, 1),
    }


def _cell(root: Path, folder: Path, entries: dict[str, Any]) -> tuple[Path, Path]:
    """Return the demo's cell with its own storage folder, and its plan with other entries."""
    from ruamel.yaml import YAML

    rig = YAML(typ="safe", pure=True).load(root / "configs/rigs/sim.yaml")
    rig["dome"]["leds"] = str(root / "configs/domes/coupole.csv")
    rig["storage"] |= {"folder": str(folder / "runs")}
    rig.pop("calibrations", None)
    path = folder / "rig.yaml"
    path.write_text(json.dumps(rig))
    return path, write_demo_plan(root, folder, rig=str(path), calibrations="none", **entries)


def _serve(root: Path, rig: Path, folder: Path) -> Console:
    command = [sys.executable, "-m", "coupole", "serve", str(rig), "--port", "0", "--json"]
    process = subprocess.Popen(
        [*command, "--plans", str(folder)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=root
    )
    assert process.stdout is not None
    return Console(root, rig, process, json.loads(process.stdout.readline())["url"])


if __name__ == "__main__":
    _watchers(sys.argv[1], int(sys.argv[2]))
