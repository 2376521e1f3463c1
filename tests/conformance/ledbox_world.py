"""A world with nothing but the LED box in it, on a thread of its own, for tests."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from coupole.devices import NO_LED, STEP_DTYPE
from drivers.ledbox import LedBox, Settings
from sim.devices import ledbox_firmware
from sim.world.clock import ClockWriter, SharedClock
from sim.world.reactor import Reactor

SPEED = 8.0


@dataclass
class LedBoxWorld:
    """The box, its clock, and what it did to the world."""

    reactor: Reactor
    clock: SharedClock
    box: ledbox_firmware.LedBoxFirmware = field(init=False)
    edges_ns: list[int] = field(default_factory=list)
    lights: list[tuple[int, int, int]] = field(default_factory=list)
    darkened_ns: list[int] = field(default_factory=list)
    panels: list[tuple[int, bool]] = field(default_factory=list)
    ready: bool = True

    def do(self, action: Callable[[], Any]) -> None:
        """Run `action` on the world's thread and wait until it is done."""
        done = threading.Event()

        def act() -> None:
            action()
            done.set()

        self.reactor.call_threadsafe(act)
        assert done.wait(10)


@contextmanager
def ledbox_world(
    folder: Path, link: Callable[[Reactor], Any] = lambda reactor: None, speed: float = SPEED, **settings: Any
) -> Iterator[LedBoxWorld]:
    """A running world; `link` makes what carries the box's bytes, a pseudo-terminal by default."""
    clock_path = folder / "clock"
    reactor = Reactor(ClockWriter(clock_path, speed))
    world = LedBoxWorld(reactor, SharedClock(clock_path))
    world.box = ledbox_firmware.LedBoxFirmware(
        reactor,
        ledbox_firmware.Settings(**settings),
        on_edge=world.edges_ns.append,
        on_light=lambda led, t_on_ns, t_off_ns: world.lights.append((led, t_on_ns, t_off_ns)),
        on_dark=world.darkened_ns.append,
        on_panel=lambda panel, on, t_ns: world.panels.append((panel, on)),
        ready=lambda: world.ready,
        link=link(reactor),
    )
    thread = threading.Thread(target=reactor.run)
    thread.start()
    try:
        yield world
    finally:
        reactor.stop()
        thread.join()
        world.box.close()


@contextmanager
def opened(world: LedBoxWorld, **settings: Any) -> Iterator[LedBox]:
    """The driver, opened on the world's box. The watchdog is slow: the tests' machine may stall."""
    values = {"port": world.box.port, "watchdog_s": 20.0, **settings}
    driver = LedBox(Settings(**values), world.clock)
    try:
        yield driver
    finally:
        driver.close()


def table(
    count: int = 12, *, led: int = 0, on_us: int = 8000, delay_us: int = 100, period_us: int = 10_000
) -> Any:
    """`count` lit steps of different LEDs, from `led` on."""
    steps = np.zeros(count, STEP_DTYPE)
    steps["led"] = led + np.arange(count)
    steps["on_us"], steps["trigger_delay_us"], steps["period_us"] = on_us, delay_us, period_us
    steps["sends_edge"] = True
    return steps


def dark_table(count: int = 4) -> Any:
    steps = table(count)
    steps["led"], steps["on_us"] = NO_LED, 0
    return steps


def run_to_end(driver: LedBox, world: LedBoxWorld, wait_s: float = 30.0) -> Any:
    """Poll until the burst has ended; all records of the log."""
    end_ns = world.clock.now_ns() + int(wait_s * 1e9)
    parts = [driver.poll_log()]
    while driver.running():
        parts.append(driver.poll_log())
        assert world.clock.now_ns() < end_ns
        world.clock.sleep(0.03)
    parts.append(driver.poll_log())
    return np.concatenate(parts)
