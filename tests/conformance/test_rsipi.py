"""RSIPI, another RSI implementation, at either end of the wire: its client moves our stand-in, and the echo server
that it ships plays the controller for our driver. Both read what `tools/make_kuka_files.py` writes.

RSIPI runs in processes of its own: on import it writes a log into the working directory.
"""

from __future__ import annotations

import json
import re
import runpy
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from cells import REPO, CellFolder, wait_until

from coupole.devices import SystemClock
from coupole.kinematics import forward
from drivers.kuka.rsi.driver import KukaRsi, Settings

HOME_DEG = np.array([0.0, -90.0, 90.0, 0.0, 90.0, 0.0])
_ECHO_PORT = 50000
"""Where the echo server binds; it cannot be told another."""
_UNTOLD = 50
"""Late answers that it counts, but may no longer tell: it notices a stall after the stall."""
_CLIENT = """
import json, sys, time
from RSIPI import RSIAPI

if __name__ == "__main__":
    config, what, values = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
    with RSIAPI(config, rsi_mode="absolute", max_cartesian_rate=0.2, max_joint_rate=0.05) as api:
        api.start()
        assert api.wait_for_connection(timeout=30.0)
        getattr(api.motion, what)(**values)
        print("told", flush=True)
        sys.stdin.readline()
        print(json.dumps(api.motion.get_current_joints()), flush=True)
"""
_ECHO_SERVER = """
import sys
from RSIPI.rsi_echo_server import EchoServer

server = EchoServer(sys.argv[1], delay_ms=4, mode="absolute", timeout_packets=1_000_000)
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
    ("corrects", "what", "values"),
    [
        ("axes", "update_joints", {"A1": 5.0, "A6": -3.0}),
        pytest.param("pose", "update_cartesian", {"X": 20.0, "Z": -10.0}, marks=pytest.mark.full),
    ],
)
def test_its_client_moves_our_stand_in(
    tmp_path: Path,
    port: int,
    corrects: str,
    what: str,
    values: dict[str, float],
) -> None:
    settings = Settings.model_validate(
        {"arm_model": KR10_R1100_SIXX, "listen": f"127.0.0.1:{port}", "corrects": corrects}
    )
    robot = {"sends_to": settings.listen, "sends_pose": True, "corrects": corrects}
    config = configuration(tmp_path, settings)
    arguments = [sys.executable, "-c", _CLIENT, str(config), what, json.dumps(values)]
    wanted = forward(KR10_R1100_SIXX, HOME_DEG + [values.get(f"A{axis}", 0.0) for axis in range(1, 7)])
    wanted[:3, 3] += [values.get(name, 0.0) for name in "XYZ"]
    with (
        CellFolder(tmp_path, speed=1.0).world(robot=robot) as world,
        subprocess.Popen(
            arguments, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as client,
    ):
        assert client.stdout is not None
        assert client.stdout.readline() == "told\n"

        def there() -> bool:
            joints_deg = world.ask("state")["joints_deg"]
            return bool(np.allclose(forward(KR10_R1100_SIXX, joints_deg), wanted, atol=1e-3))

        wait_until(there, "the stand-in where RSIPI's corrections lead")
        out, _ = client.communicate("\n", timeout=30.0)
        assert client.returncode == 0
        seen_deg = list(json.loads(out).values())
        assert np.allclose(seen_deg, world.ask("state")["joints_deg"], atol=1e-3)


def test_its_echo_server_takes_every_answer_of_our_driver(
    tmp_path: Path, port: int, scale: Callable[[int, int], int]
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("0.0.0.0", _ECHO_PORT))
        except OSError:
            pytest.skip(f"port {_ECHO_PORT}, the echo server's, is in use")
    settings = Settings.model_validate(
        {"arm_model": KR10_R1100_SIXX, "listen": f"127.0.0.1:{port}", "delay_limit": 1_000_000}
    )
    config = configuration(tmp_path, settings)
    arguments = [sys.executable, "-c", _ECHO_SERVER, str(config)]
    with (
        subprocess.Popen(
            arguments, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as server,
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
