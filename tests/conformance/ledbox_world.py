"""Worlds with nothing but an LED box in them, each on a thread of its own, for tests."""

from __future__ import annotations

import gc
import linecache
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from coupole.devices import NO_LED, STEP_DTYPE
from drivers.ledbox import LedBox, Settings, text_lines
from sim.devices import ledbox_firmware, text_box
from sim.world.clock import ClockWriter, SharedClock
from sim.world.lighting import Lighting
from sim.world.reactor import Reactor

SPEED = 4.0
TEXT_SPEED = 4.0
"""Slower: its driver's own thread, on a busy machine, is what ends its lights."""


@dataclass
class LedBoxWorld:
    """The box, its clock, and what it did to the world."""

    reactor: Reactor
    clock: SharedClock
    box: Any = field(init=False)
    """The stand-in: a `sim.devices.ledbox_stand_in.LedBoxStandIn`."""
    opener: Callable[..., AbstractContextManager[Any]] = field(init=False)
    """Opens the driver on the box, with settings that differ from the usual ones."""
    lighting: Lighting = field(default_factory=Lighting)
    edges_ns: list[int] = field(default_factory=list)
    lights: list[tuple[int, int, int]] = field(default_factory=list)
    darkened_ns: list[int] = field(default_factory=list)
    panels: list[tuple[int, bool]] = field(default_factory=list)
    ready: bool = True

    def do(self, action: Callable[[], Any]) -> Any:
        """Run `action` on the world's thread and wait until it is done; what it gave."""
        done = threading.Event()
        given: list[Any] = []

        def act() -> None:
            given.append(action())
            done.set()

        self.reactor.call_threadsafe(act)
        assert done.wait(10)
        return given[0]

    def lose_answers(self, count: int) -> list[bytes]:
        """The box's next `count` answers get lost on their way; the list that they are collected in."""
        lost: list[bytes] = []
        link = self.box._link
        send = link.send

        def lose(data: bytes) -> bool:
            if len(lost) < count:
                lost.append(data)
                return True
            return send(data)

        self.do(lambda: setattr(link, "send", lose))
        return lost

    def slow_down(self) -> None:
        """From now on a time-out of the driver takes longer than anything the machine is busy with."""

        def act() -> None:
            self.reactor.clock.speed = 0.5
            self.reactor.clock.slip_to(self.reactor.now_ns)

        self.do(act)

    def shining(self) -> list[int]:
        """LEDs that shine now."""
        found: list[int] = self.do(lambda: self.lighting.shining(self.reactor.now_ns))
        return found

    def wait_until_dark(self) -> None:
        """Fails if something shines on and on."""
        wait_until(lambda: not self.shining(), "darkness")

    def lit_us(self, number: int) -> float:
        """How long light number `number` (from 0) has really shone."""
        _, on_ns, _ = self.lights[number]
        (seconds,) = self.do(lambda: self.lighting.exposure_s(on_ns, self.reactor.now_ns)).values()
        return 1e6 * float(seconds)

    def light(self, led: int, t_on_ns: int, t_off_ns: int) -> None:
        self.lights.append((led, t_on_ns, t_off_ns))
        self.lighting.light(led, t_on_ns, t_off_ns)

    def dark(self, t_ns: int) -> None:
        self.darkened_ns.append(t_ns)
        self.lighting.dark(t_ns)


class Call:
    """A call of the driver in a thread of its own."""

    def __init__(self, action: Callable[[], Any]) -> None:
        self.error: BaseException | None = None
        self._action = action
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def ended(self) -> BaseException | None:
        """Wait for its end; what it raised."""
        self._thread.join(20.0)
        assert not self._thread.is_alive()
        return self.error

    def waits_for_a_lock(self) -> bool:
        """True if its thread is about to take a lock: the line of code that it stands in says so."""
        gc.disable()  # a collection in there may wait for ever (CPython's gh-106883)
        try:
            frame = sys._current_frames().get(self._thread.ident or 0)
        finally:
            gc.enable()
        if frame is None:
            return False
        file = frame.f_code.co_filename
        return file.endswith("fair_lock.py") or "with self._lock" in linecache.getline(file, frame.f_lineno)

    def _run(self) -> None:
        try:
            self._action()
        except BaseException as error:  # noqa: BLE001  the test looks at it
            self.error = error


def wait_until(condition: Callable[[], bool], what: str) -> None:
    """Fails if it does not come; only a broken box or driver lets the time run out."""
    end_s = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end_s, f"waited in vain for {what}"
        time.sleep(0.005)


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
        on_light=world.light,
        on_dark=world.dark,
        on_panel=lambda panel, on, t_ns: world.panels.append((panel, on)),
        ready=lambda: world.ready,
        link=link(reactor),
    )
    world.opener = lambda **changed: opened(world, **changed)
    with _running(world):
        yield world


@contextmanager
def text_world(
    folder: Path, driver: dict[str, Any] | None = None, speed: float = TEXT_SPEED, **settings: Any
) -> Iterator[LedBoxWorld]:
    """The same with a box of text lines; `driver` are settings of its driver, `settings` the stand-in's."""
    clock_path = folder / "clock"
    reactor = Reactor(ClockWriter(clock_path, speed))
    world = LedBoxWorld(reactor, SharedClock(clock_path))
    world.box = text_box.TextBox(
        reactor, text_box.Settings(**settings), on_light=world.light, on_dark=world.lighting.darken_one
    )
    usual = {"led_count": 64, "settle_ms": 0, "identify": "ID", **(driver or {})}
    world.opener = lambda **changed: closing(
        text_lines.TextLineBox(
            text_lines.Settings(**{"port": world.box.port, **usual, **changed}),
            world.clock,
        )
    )
    with _running(world):
        yield world


@contextmanager
def _running(world: LedBoxWorld) -> Iterator[None]:
    thread = threading.Thread(target=world.reactor.run)
    thread.start()
    try:
        yield
    finally:
        world.reactor.stop()
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
