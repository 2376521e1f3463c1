"""A camera behind a GenTL producer: that of `gentl_producer/`, compiled here; the camera is in another process."""

from __future__ import annotations

import logging
import multiprocessing
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
from camera_world import begun_ns
from gentl_camera import serve
from harvesters.core import Harvester

from coupole.devices import Camera, Frame
from coupole.testing.camera_state_conformance import Left
from drivers.camera.gentl.driver import GenTLCamera
from drivers.camera.gentl.settings import Settings
from sim.world.clock import SharedClock

SOURCES = Path(__file__).with_name("gentl_producer")
COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler for the GenTL producer")
SERIAL = "00000120"
_QUIET = logging.getLogger("foreign-client")
_QUIET.addHandler(logging.NullHandler())
SETTINGS: dict[str, Any] = {
    "exposed_counter": {"select": {"CounterSelector": "Counter0"}},
    "over_trigger_counter": {"select": {"CounterSelector": "Counter1"}},
    "buffers": 200,
}
"""More buffers than any test leaves untaken, so that losses are made on purpose."""


def compile_producer(folder: Path) -> Path:
    """The producer in a folder of its own, where it looks for its cameras."""
    assert COMPILER is not None
    producer = folder / "stand-in.cti"
    flags = [
        "-std=c11",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-shared",
        "-fPIC",
        "-O1",
        "-pthread",
        "-fvisibility=hidden",
    ]
    sources = sorted(str(path) for path in SOURCES.glob("*.c"))
    subprocess.run([COMPILER, *flags, *sources, "-o", str(producer), "-ldl"], check=True)
    return producer


@contextmanager
def camera_process() -> Iterator[Connection]:
    """The process that cameras are in; see `gentl_camera.serve`."""
    spawning = multiprocessing.get_context("spawn")
    here, there = spawning.Pipe()
    process = spawning.Process(target=serve, args=(there,), daemon=True)
    process.start()
    there.close()
    yield here
    here.close()
    process.join()


class GenTLWorld:
    """See `CameraWorld`."""

    def __init__(
        self,
        producer: Path,
        cameras: Connection,
        folder: Path,
        *,
        tl_type: str = "U3V",
        ticks_hz: int = 10**9,
        ramp: bool = False,
        **settings: Any,
    ) -> None:
        self._producer, self._cameras = producer, cameras
        character = {"tl_type": tl_type, "ticks_hz": ticks_hz, "ramp": ramp}
        given = {"id_modulus": 65535 if tl_type == "GEV" else 2**62, **settings}
        self._ask("begin", producer.with_name(f"{SERIAL}.camera"), folder / "clock", given, character)
        self._clock = SharedClock(folder / "clock")
        self._drivers = ExitStack()

    def _ask(self, name: str, *arguments: Any) -> Any:
        self._cameras.send((name, arguments))
        return self._cameras.recv()

    def open(self, **settings: Any) -> GenTLCamera:
        checked = Settings.model_validate({"producer": self._producer, **SETTINGS, **settings})
        return self._drivers.enter_context(closing(GenTLCamera(checked, self._clock)))

    def leave(self, left: Left) -> None:
        """Through harvesters and the producer, without our driver."""
        harvester = Harvester(logger=_QUIET)
        harvester.add_file(str(self._producer))
        harvester.update()
        acquirer = harvester.create(0)
        nodes = acquirer.remote_device.node_map
        for name, value in left:
            nodes.get_node(name).value = value
        acquirer.destroy()
        harvester.reset()

    def begun_ns(self, frame: Frame) -> int:
        return begun_ns(frame)

    def open_nothing(self) -> Camera:
        return self.open(serial="99999999")

    def fire(self, *periods_us: int) -> list[int]:
        at_ns: list[int] = self._ask("fire", *periods_us)
        return at_ns

    def unplug(self, *, silently: bool = False) -> None:
        """Silently: as on transports where images just cease to come."""
        self._ask("unplug", silently)

    def lose(self, *numbers: int) -> None:
        """Exposures of these numbers do not reach the host."""
        self._ask("lose", *numbers)

    def tear(self, *frame_ids: int) -> None:
        """Frames of these ids arrive without their lower half."""
        self._ask("tear", *frame_ids)

    def register(self, address: int) -> int:
        """What the camera was told."""
        value: int = self._ask("register", address)
        return value

    @property
    def sent(self) -> int:
        """Images that left the camera."""
        images: int = self._ask("sent")
        return images

    @property
    def is_armed(self) -> bool:
        return bool(self._ask("is_armed"))

    def close(self) -> None:
        self._drivers.close()
        self._ask("close")
