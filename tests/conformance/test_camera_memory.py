"""What every Camera must do, run on the camera in shared memory."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from camera_world import fire, in_world, sensor

from coupole.devices import Camera
from coupole.testing.camera_conformance import CameraConformance
from sim.devices.camera_server import CameraServer
from sim.devices.camera_server import Settings as ServerSettings
from sim.devices.memory_camera import MemoryCamera, Settings
from sim.world.clock import ClockWriter, SharedClock
from sim.world.reactor import Reactor


class MemoryWorld:
    """See `CameraWorld`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._reactor = Reactor(ClockWriter(folder / "clock", speed=1.0))
        self._clock = SharedClock(folder / "clock")
        self._server = CameraServer(self._reactor, ServerSettings(), path=folder / "camera", **sensor())
        self._thread = threading.Thread(target=self._reactor.run)
        self._thread.start()
        self._drivers = ExitStack()

    def open(self) -> Camera:
        return self._open("camera")

    def open_nothing(self) -> Camera:
        return self._open("nothing")

    def _open(self, name: str) -> Camera:
        settings = Settings(address=str(self._folder / name))
        return self._drivers.enter_context(closing(MemoryCamera(settings, self._clock)))

    def fire(self, *periods_us: int) -> list[int]:
        return fire(self._reactor, self._server.edge, periods_us)

    def unplug(self) -> None:
        in_world(self._reactor, self._server.unplug)

    @property
    def is_armed(self) -> bool:
        return self._server.is_armed

    def close(self) -> None:
        self._drivers.close()
        self._reactor.stop()
        self._thread.join()
        self._server.close()


@pytest.fixture
def world(tmp_path: Path) -> Iterator[MemoryWorld]:
    world = MemoryWorld(tmp_path)
    yield world
    world.close()


class TestMemoryCamera(CameraConformance):
    """The contract, over shared memory."""
