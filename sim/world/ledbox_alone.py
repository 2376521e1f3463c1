"""A world with nothing but an LED box in it, on a thread of its own: the other end of the wire of a box's driver,
for `coupole.testing.LedBoxConformance` and `TableLedBoxConformance`.

A stand-in is built on the world's event loop (`reactor`). It reports its light to the world by `light` and `dark`
(or `darken_one`), its panels by `switch_panel`, and its edges by `edge`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from sim.world.clock import ClockWriter, SharedClock
from sim.world.lighting import Lighting
from sim.world.reactor import Reactor

_PATIENCE_S = 20.0
_SLOW = 0.5
"""Speed of a world in which a driver's time-out takes longer than any other work of the machine."""


class Sender(Protocol):
    """Carrier of the box's answers."""

    def send(self, data: bytes) -> bool:
        """Send an answer; False if it was lost."""
        ...


class BoxAlone(Protocol):
    """A stand-in for an LED box. All methods are called on the world's thread."""

    dead_leds: set[int]
    """LEDs that give no light from their next flash on."""

    def mute(self, seconds: float | None = None) -> None:
        """The box neither receives nor answers, for ever or for `seconds`."""
        ...

    def unplug(self) -> None:
        """Unplug its cable to the host."""
        ...

    def close(self) -> None: ...


@dataclass
class LedBoxAlone:
    """The box, its clock, and its effects on the world: a `coupole.testing.TableLedBoxWorld`."""

    reactor: Reactor
    clock: SharedClock
    """Clock for the driver."""
    box: Any = field(init=False)
    """The stand-in: a `BoxAlone`."""
    link: Sender = field(init=False)
    """Carrier of its answers."""
    opener: Callable[..., AbstractContextManager[Any]] = field(init=False)
    """Opens the driver on the box, with settings that may differ from the usual ones."""
    lighting: Lighting = field(default_factory=Lighting)
    edges_ns: list[int] = field(default_factory=list)
    """Times of all edges that the box sent."""
    lights: list[tuple[int, int, int]] = field(default_factory=list)
    """Each light that was begun: LED, when it began, when it would end by itself (ns)."""
    darkened_ns: list[int] = field(default_factory=list)
    """Times when the box switched all light off."""
    panels: list[tuple[int, bool]] = field(default_factory=list)
    """Each switching of a panel."""
    ready: bool = True
    """State of the camera's exposure-ready line."""

    # What a stand-in tells.

    def light(self, led: int, t_on_ns: int, t_off_ns: int) -> None:
        """An LED shines from now on, until `t_off_ns` or until it is darkened."""
        self.lights.append((led, t_on_ns, t_off_ns))
        self.lighting.light(led, t_on_ns, t_off_ns)

    def dark(self, t_ns: int) -> None:
        """All LEDs are off."""
        self.darkened_ns.append(t_ns)
        self.lighting.dark(t_ns)

    def darken_one(self, led: int, t_ns: int) -> None:
        """One LED is off."""
        self.lighting.darken_one(led, t_ns)

    def switch_panel(self, panel: int, on: bool, t_ns: int) -> None:
        """A panel is switched at `t_ns`."""
        self.panels.append((panel, on))

    def edge(self, t_ns: int) -> None:
        """An edge is sent to the camera."""
        self.edges_ns.append(t_ns)

    # What a test does and sees.

    def do(self, action: Callable[[], Any]) -> Any:
        """Run `action` on the world's thread, wait until it is done, and return its result."""
        is_done = threading.Event()
        returned_values: list[Any] = []

        def act() -> None:
            returned_values.append(action())
            is_done.set()

        self.reactor.call_threadsafe(act)
        assert is_done.wait(_PATIENCE_S)
        return returned_values[0]

    def kill_led(self, led: int) -> None:
        """Let an LED give no light from its next flash on."""
        self.do(lambda: self.box.dead_leds.add(led))

    def mute(self, seconds: float | None = None) -> None:
        """The box neither receives nor answers, for ever or for `seconds` of the world."""
        self.do(lambda: self.box.mute(seconds))

    def unplug(self) -> None:
        """Pull the cable between host and box."""
        self.do(self.box.unplug)

    def lose_answers(self, count: int) -> list[bytes]:
        """Let the box's next `count` answers get lost on their way. Return the list in which they are
        collected."""
        lost_answers: list[bytes] = []
        send = self.link.send

        def lose(data: bytes) -> bool:
            if len(lost_answers) < count:
                lost_answers.append(data)
                return True
            return send(data)

        self.do(lambda: setattr(self.link, "send", lose))
        return lost_answers

    def slow_down(self) -> None:
        """Slow the world down from now on, so that a time-out of the driver takes longer than any other work of
        the machine."""

        def act() -> None:
            self.reactor.clock.speed = _SLOW
            self.reactor.clock.slip_to(self.reactor.now_ns)

        self.do(act)

    def shining(self) -> list[int]:
        """LEDs that shine now."""
        lit_leds: list[int] = self.do(lambda: self.lighting.shining(self.reactor.now_ns))
        return lit_leds

    def wait_until_dark(self) -> None:
        """Wait until nothing shines. Fails if something does not stop shining."""
        end_s = time.monotonic() + _PATIENCE_S
        while self.shining():
            assert time.monotonic() < end_s, "the LEDs did not become dark in time"
            time.sleep(0.005)

    def lit_us(self, number: int) -> float:
        """Time for which light number `number` (from 0) has really shone, us."""
        _, on_ns, _ = self.lights[number]
        (seconds,) = self.do(lambda: self.lighting.exposure_s(on_ns, self.reactor.now_ns)).values()
        return 1e6 * float(seconds)


@contextmanager
def ledbox_alone(
    folder: Path,
    make: Callable[[LedBoxAlone], tuple[BoxAlone, Sender]],
    opener: Callable[..., AbstractContextManager[Any]],
    speed: float = 4.0,
) -> Iterator[LedBoxAlone]:
    """A running world, at `speed` times real time, until the context ends.

    `make(world)` gives the stand-in and the carrier of its answers. `opener(world, **settings)` opens the driver,
    with `world.clock` as its clock. The clock's file is in `folder`.
    """
    clock_path = folder / "clock"
    world = LedBoxAlone(Reactor(ClockWriter(clock_path, speed)), SharedClock(clock_path))
    world.box, world.link = make(world)
    world.opener = lambda **settings: opener(world, **settings)
    thread = threading.Thread(target=world.reactor.run)
    thread.start()
    try:
        yield world
    finally:
        world.reactor.stop()
        thread.join()
        world.box.close()
