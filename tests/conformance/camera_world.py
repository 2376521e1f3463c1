"""What stand-ins for cameras are made with in the tests, and what is done to them on the world's thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.devices import Frame
from coupole.testing.camera_conformance import (
    EXPOSURE,
    HEIGHT_PX,
    PATIENCE_S,
    WHITE_DN,
    WIDTH_PX,
    expected_ramp,
)
from sim.devices import camera_body
from sim.devices.camera_body import Exposed, Render, Surroundings
from sim.world.lighting import Lighting
from sim.world.reactor import Reactor


def flat(out: NDArray[np.uint16], exposed: Exposed) -> None:
    """A frame filled with the number of its exposure."""
    out[:] = exposed.number


def ramp(out: NDArray[np.uint16], exposed: Exposed) -> None:
    """A frame whose pixels tell its number and their own places, if it is exposed as asked; else all is white."""
    as_asked = (exposed.exposure_s, exposed.gain) == (EXPOSURE.exposure_us / 1e6, 1.0)
    out[:] = expected_ramp(exposed.number) if as_asked else WHITE_DN


def sensor(height_px: int = HEIGHT_PX, width_px: int = WIDTH_PX, render: Render = flat) -> dict[str, Any]:
    """What a stand-in for a camera is made with, whatever its wire."""
    return {
        "frame_format": {
            "height_px": height_px,
            "width_px": width_px,
            "bit_depth": 12,
            "bayer_pattern": "GBRG",
            "black_dn": 64,
            "white_dn": WHITE_DN,
        },
        "surroundings": Surroundings(
            readout_us=10_000,
            exposure_gap_us=100,
            lighting=Lighting(),
            pose=lambda: np.eye(4),
            render=render,
        ),
    }


def begun_ns(frame: Frame) -> int:
    """World time at which a frame's exposure began: the clock of `sim.devices.camera_body`, read backwards."""
    clock = camera_body.Settings()
    return round((frame.timestamp_ns - clock.clock_offset_ns) / (1 + clock.clock_ppm * 1e-6))


def in_world(reactor: Reactor, action: Callable[[], object]) -> None:
    """Do something on the world's thread and wait until it is done."""
    done = threading.Event()

    def act() -> None:
        action()
        done.set()

    reactor.call_threadsafe(act)
    assert done.wait(PATIENCE_S)


def fire(reactor: Reactor, edge: Callable[[int], None], periods_us: tuple[int, ...]) -> list[int]:
    """Call `edge` at the times that `CameraWorld.fire` speaks of; returns when all have been sent."""
    at_ns: list[int] = []
    done = threading.Event()

    def act() -> None:
        start_ns = reactor.now_ns + 5_000_000
        at_ns.extend(start_ns + int(offset) * 1000 for offset in np.cumsum([0, *periods_us]))
        for t_ns in at_ns:
            reactor.at(t_ns, lambda t_ns=t_ns: edge(t_ns))  # type: ignore[misc]
        reactor.at(at_ns[-1] + 1, done.set)

    reactor.call_threadsafe(act)
    assert done.wait(PATIENCE_S + 20e-6 * sum(periods_us))
    return at_ns
