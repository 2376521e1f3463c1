"""A world with nothing but the GigE Vision camera in it, for tests."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

from camera_world import begun_ns, fire, flat, in_world, sensor
from gige import gige_port

from coupole.devices import Frame
from coupole.testing.camera_state_conformance import Left
from drivers.camera.aravis.driver import AravisCamera, Settings
from sim.devices import gige_camera
from sim.devices.camera_body import Render
from sim.world.clock import ClockWriter, SharedClock
from sim.world.reactor import Reactor

SETTINGS: dict[str, Any] = {
    "address": "127.0.0.1",
    "packet_size": 32_000,
    "exposed_counter": {"select": {"CounterSelector": "Counter0"}},
    "over_trigger_counter": {"select": {"CounterSelector": "Counter1"}},
}


def arv_tool(*arguments: str) -> str:
    """What Aravis's own client says of the camera."""
    command = ["arv-tool-0.8", "-a", SETTINGS["address"], *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout


def _written(value: Any) -> str:
    """A feature's value in the words of `arv-tool`."""
    if isinstance(value, str):
        return value
    return str(value).lower() if isinstance(value, bool) else f"{value:g}"


class GigeWorld:
    """See `CameraWorld`."""

    def __init__(
        self, folder: Path, *, height_px: int = 24, width_px: int = 40, render: Render = flat, **settings: Any
    ) -> None:
        self.reactor = Reactor(ClockWriter(folder / "clock", speed=1.0))
        self.clock = SharedClock(folder / "clock")
        self.camera = gige_camera.GigeCamera(
            self.reactor, gige_camera.Settings(**settings), **sensor(height_px, width_px, render)
        )
        self._thread = threading.Thread(target=self.reactor.run)
        self._thread.start()
        self._drivers = ExitStack()

    def open(self, **settings: Any) -> AravisCamera:
        checked = Settings.model_validate({**SETTINGS, **settings})
        return self._drivers.enter_context(closing(AravisCamera(checked, self.clock)))

    def open_nothing(self) -> AravisCamera:
        return self.open(address="127.0.0.77")

    def fire(self, *periods_us: int) -> list[int]:
        return fire(self.reactor, self.camera.edge, periods_us)

    def unplug(self) -> None:
        in_world(self.reactor, self.camera.unplug)

    def leave(self, left: Left) -> None:
        """Through Aravis's own command line."""
        said = arv_tool("control", *(f"{name}={_written(value)}" for name, value in left))
        taken = [line.split()[:3] for line in said.splitlines() if line]
        assert taken == [[name, "=", _written(value)] for name, value in left]

    def begun_ns(self, frame: Frame) -> int:
        return begun_ns(frame)

    @property
    def is_armed(self) -> bool:
        return self.camera.is_armed

    def close(self) -> None:
        self._drivers.close()
        self.reactor.stop()
        self._thread.join()
        self.camera.close()


@contextmanager
def gige_world(folder: Path, **settings: Any) -> Iterator[GigeWorld]:
    """A running world with the port for itself."""
    with gige_port(), closing(GigeWorld(folder, **settings)) as world:
        yield world
