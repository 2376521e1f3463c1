"""RSIPI, another RSI implementation, at either end of the wire: its client moves our stand-in, and the echo server
that it ships plays the controller for our driver. Both read what `tools/make_kuka_files.py` writes.

RSIPI runs in processes of its own: on import it writes a log into the working directory.
"""

from __future__ import annotations

import json
import re
import runpy
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from beside import beside
from cells import REPO, CellFolder, wait_until

from coupole.clock import SystemClock
from coupole.errors import DeviceFault
from coupole.kinematics import forward
from drivers.kuka.rsi.driver import KukaRsi, Settings

HOME_DEG = np.array([0.0, -90.0, 90.0, 0.0, 90.0, 0.0])
_ECHO_PORT = 50000
"""Where the echo server binds; it cannot be told another."""
_ANSWER_S = 0.1
"""A packet may stay without an answer: no driver is there yet."""
_UNTOLD = 50
"""Late answers that it counts, but may no longer tell: it notices a stall after the stall."""
_CLIENT = """
import json, sys, time
from RSIPI import RSIAPI
from RSIPI.fault_injection import suspended

if __name__ == "__main__":
    config, what, values = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
    with RSIAPI(config, rsi_mode="absolute", max_cartesian_rate=0.2, max_joint_rate=0.05) as api:
        api.start()
        assert api.wait_for_connection(timeout=30.0)
        with suspended(api.client.network_process.pid):
            time.sleep(0.2)
        getattr(api.motion, what)(**values)
        print("told", flush=True)
        for _ in sys.stdin:
            print(json.dumps(api.motion.get_current_joints()), flush=True)
"""
_ECHO_SERVER = """
import sys
from RSIPI.rsi_echo_server import EchoServer

server = EchoServer(sys.argv[1], delay_ms=int(sys.argv[2]), mode="absolute", timeout_packets=1_000_000)
server.start()
sys.stdin.readline()
server.stop()
"""


@pytest.fixture
def port() -> int:
    """A port that is free now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        found: int = probe.getsockname()[1]
        return found


def configuration(folder: Path, settings: Settings) -> Path:
    """The file that both ends load."""
    tool = runpy.run_path(str(REPO / "tools" / "make_kuka_files.py"))
    path = folder / "RSI_EthernetConfig.xml"
    path.write_text(tool["rsi_xml"](settings, "127.0.0.1"))
    return path


@pytest.mark.parametrize(
    ("corrects", "what", "values", "cycle_ms", "host"),
    [
        ("axes", "update_joints", {"A1": 5.0, "A6": -3.0}, 12, "127.0.0.2"),
        pytest.param("axes", "update_joints", {"A1": 5.0, "A6": -3.0}, 4, "127.0.0.1", marks=pytest.mark.full),
        pytest.param("pose", "update_cartesian", {"X": 20.0, "Z": -10.0}, 4, "127.0.0.1", marks=pytest.mark.full),
    ],
)
def test_its_client_moves_our_stand_in(
    tmp_path: Path,
    port: int,
    corrects: str,
    what: str,
    values: dict[str, float],
    cycle_ms: int,
    host: str,
) -> None:
    """Its cycle and address are the world's own; its process is stopped for 200 ms, meanwhile packets come
    twice."""
    settings = Settings.model_validate(
        {"arm_model": KR10_R1100_SIXX, "listen": f"{host}:{port}", "corrects": corrects}
    )
    robot = {"sends_to": settings.listen, "sends_pose": True, "corrects": corrects, "cycle_ms": cycle_ms}
    config = configuration(tmp_path, settings)
    arguments = [sys.executable, "-c", _CLIENT, str(config), what, json.dumps(values)]
    wanted = forward(KR10_R1100_SIXX, HOME_DEG + [values.get(f"A{axis}", 0.0) for axis in range(1, 7)])
    wanted[:3, 3] += [values.get(name, 0.0) for name in "XYZ"]
    with (
        CellFolder(tmp_path, speed=1.0).world(robot=robot) as world,
        subprocess.Popen(
            arguments, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        ) as client,
    ):
        assert client.stdin is not None
        assert client.stdout is not None
        assert client.stdout.readline() == "told\n"

        def there() -> bool:
            joints_deg = world.ask("state")["joints_deg"]
            return bool(np.allclose(forward(KR10_R1100_SIXX, joints_deg), wanted, atol=1e-3))

        def seen() -> bool:
            assert client.stdin is not None
            assert client.stdout is not None
            client.stdin.write("\n")
            seen_deg = list(json.loads(client.stdout.readline()).values())
            return bool(np.allclose(seen_deg, world.ask("state")["joints_deg"], atol=1e-3))

        wait_until(there, "the stand-in where RSIPI's corrections lead")
        wait_until(seen, "what RSIPI reads of the stand-in to be where it is")
        client.stdin.close()
        assert client.wait(timeout=30.0) == 0


@contextmanager
def echo_server(config: Path, cycle_ms: int) -> Iterator[subprocess.Popen[str]]:
    """RSIPI's stand-in for a controller, ended by a line of input."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("0.0.0.0", _ECHO_PORT))
        except OSError:
            pytest.skip(f"port {_ECHO_PORT}, the echo server's, is in use")
    arguments = [sys.executable, "-c", _ECHO_SERVER, str(config), str(cycle_ms)]
    with subprocess.Popen(
        arguments, cwd=config.parent, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as server:
        try:
            yield server
        finally:
            server.kill()


def _ipoc(data: bytes) -> bytes:
    found = re.search(rb"<IPOC>(\d+)</IPOC>", data)
    assert found is not None, data
    return found[1]


@contextmanager
def bad_network(port: int, driver_port: int) -> Iterator[None]:
    """Between the controller, which sends to `port` of 127.0.0.1, and the driver: packets are doubled, held back
    and repeated long after. Each has its answer before the next is passed on, however busy this machine is: the
    driver leaves all but the newest of several packets unanswered, and this controller counts such a cycle when it
    hears its client again, not when it passes, as a KUKA does."""

    def relay(near: socket.socket, far: socket.socket, over: threading.Event) -> None:
        passed: list[bytes] = []
        controller: tuple[str, int] | None = None
        unanswered, until_s = b"", 0.0
        while not over.is_set():
            waits = bool(unanswered) and time.monotonic() < until_s
            for ready in select.select([far] if waits else [far, near], [], [], 0.05)[0]:
                data, sender = ready.recvfrom(65535)
                if ready is far:
                    assert controller is not None
                    near.sendto(data, controller)
                    if _ipoc(data) == unanswered:  # not the second answer to what came twice
                        unanswered = b""
                    continue
                controller = sender
                passed.append(data)
                if len(passed) % 100 == 50:
                    time.sleep(0.03)
                repeats = [data] * (len(passed) % 7 == 0) + passed[-30:-29] * (len(passed) % 40 == 39)
                for packet in (data, *repeats):
                    far.sendto(packet, ("127.0.0.2", driver_port))
                unanswered, until_s = _ipoc(data), time.monotonic() + _ANSWER_S

    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as near,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as far,
    ):
        near.bind(("127.0.0.1", port))
        far.bind(("127.0.0.2", 0))
        with beside(partial(relay, near, far)):
            yield


@pytest.mark.parametrize("cycle_ms", [12, pytest.param(4, marks=pytest.mark.full)])
def test_its_echo_server_takes_every_answer_of_our_driver(
    tmp_path: Path, port: int, scale: Callable[[int, int], int], cycle_ms: int
) -> None:
    """Through a network that doubles packets, holds some back and repeats others."""
    arm = {"arm_model": KR10_R1100_SIXX, "delay_limit": 1_000_000, "cycle_ms": cycle_ms}
    config = configuration(tmp_path, Settings.model_validate(arm | {"listen": f"127.0.0.1:{port}"}))
    settings = Settings.model_validate(arm | {"listen": f"127.0.0.2:{port}", "controller": "127.0.0.2"})
    with (
        bad_network(port, port),
        echo_server(config, cycle_ms) as server,
        closing(KukaRsi(settings, SystemClock())) as robot,
    ):
        assert not robot.identify().simulated
        end_s = time.monotonic() + scale(4, 60)
        # it starts with all axes at 0 and tells two decimals
        targets_deg = np.array([[12.0, -9.5, 8.25, 7.0, -6.0, 5.0], [-3.0, 4.0, -5.0, 6.0, 7.0, -8.0]])
        while time.monotonic() < end_s:
            robot.move_to(targets_deg[0])
            assert np.allclose(robot.wait_settled().joints_deg, targets_deg[0], atol=0.006)
            targets_deg = targets_deg[::-1]
        out, _ = server.communicate("\n", timeout=30.0)
        figures = robot.statistics()
    faulty = re.search(r"Faulty packets: (\d+)", out)
    assert faulty is not None, out
    assert not re.search("mismatch|malformed", out), out
    late = figures["late_answers"]
    print(f"late: {late:.0f} of {figures['packets']:.0f} packets")
    assert int(faulty[1]) <= late + _UNTOLD, out  # what it counts is lateness alone
    assert figures["astray_packets"] > 0


def test_its_echo_server_with_another_cycle_than_the_drivers_is_refused(tmp_path: Path, port: int) -> None:
    settings = Settings.model_validate(
        {"arm_model": KR10_R1100_SIXX, "listen": f"127.0.0.1:{port}", "cycle_ms": 12, "delay_limit": 1_000_000}
    )
    with (
        echo_server(configuration(tmp_path, settings), 4),
        pytest.raises(DeviceFault, match="its IPOC counts 4 a packet; `cycle_ms` is 12"),
    ):
        KukaRsi(settings, SystemClock())
