"""A stand-in whose cycle is its own line of the rig, and an outside client whose corrections are refused."""

from __future__ import annotations

import contextlib
import json
import signal
import socket

import cells
import pytest
from cells import CellFolder


@pytest.mark.parametrize(
    "ipoc_step", [1, pytest.param(0, marks=pytest.mark.full)], ids=["ipoc-by-1", "ipoc-in-ms"]
)
def test_a_driver_set_to_another_cycle_than_its_controllers_moves_nothing(
    cell: CellFolder, ipoc_step: int
) -> None:
    """The driver has 12 ms; the rig's world says by itself what its controller has."""
    cell.world_settings["robot"] = {"cycle_ms": 4, "ipoc_step": ipoc_step}
    cell.write()
    ended = cell.acquire()
    assert ended.code == 4
    assert "a controller with a cycle of 12 ms" in ended.err
    assert f"declares 4.00 ms and its IPOC counts {ipoc_step or 4} a packet" in ended.err
    assert not list((cell.folder / "storage").glob("2*/views/*"))


def test_an_outside_client_reads_on_the_terminal_why_its_correction_was_refused(cell: CellFolder) -> None:
    serving = cells.start("sim", cell.rig)
    assert serving.stdout is not None
    try:
        robot = json.loads(serving.stdout.readline())["robot"]
        host, port = robot["listen"].rsplit(":", 1)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.bind((host, int(port)))
            client.settimeout(10.0)
            with contextlib.suppress(TimeoutError):
                for cycle in range(2000):
                    packet, controller = client.recvfrom(4096)
                    ipoc = packet.partition(b"<IPOC>")[2].partition(b"<")[0]
                    axes = f'<AKorr A1="{90 if cycle > 20 else 0}" A2="0" A3="0" A4="0" A5="0" A6="0"/>'
                    client.sendto(
                        f'<Sen Type="ImFree">{axes}<IPOC>'.encode() + ipoc + b"</IPOC></Sen>", controller
                    )
                    client.settimeout(0.5)
                pytest.fail("the controller took everything")
    finally:
        serving.send_signal(signal.SIGINT)
        ended = cells.finish(serving)
    assert "robot: RSI stops: command velocity of A1 exceeded: 90.000 deg a cycle" in ended.err
