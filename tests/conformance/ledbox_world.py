"""Worlds with nothing but one of our LED boxes in them, and our drivers on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from pathlib import Path
from typing import Any

from drivers.ledbox import LedBox, Settings, text_lines
from sim.devices import ledbox_firmware, text_box
from sim.world.ledbox_alone import LedBoxAlone, ledbox_alone
from sim.world.reactor import Reactor

SPEED = 4.0
TEXT_SPEED = 4.0
"""Slower: its driver's own thread, on a busy machine, is what ends its lights."""


def ledbox_world(
    folder: Path, link: Callable[[Reactor], Any] = lambda reactor: None, speed: float = SPEED, **settings: Any
) -> AbstractContextManager[LedBoxAlone]:
    """A running world; `link` makes what carries the box's bytes, a pseudo-terminal by default."""

    def make(world: LedBoxAlone) -> tuple[Any, Any]:
        cables = ledbox_firmware.BoxCables(
            world.edge, world.light, world.dark, world.switch_panel, lambda: world.ready
        )
        box = ledbox_firmware.LedBoxFirmware(
            world.reactor, ledbox_firmware.Settings(**settings), cables, link=link(world.reactor)
        )
        return box, box._link

    return ledbox_alone(folder, make, opened, speed)


def text_world(
    folder: Path, driver: dict[str, Any] | None = None, speed: float = TEXT_SPEED, **settings: Any
) -> AbstractContextManager[LedBoxAlone]:
    """The same with a box of text lines; `driver` are settings of its driver, `settings` the stand-in's."""
    usual = {"led_count": 64, "settle_ms": 0, "identify": "ID", **(driver or {})}

    def make(world: LedBoxAlone) -> tuple[Any, Any]:
        box = text_box.TextBox(
            world.reactor, text_box.Settings(**settings), on_light=world.light, on_dark=world.darken_one
        )
        return box, box._link

    def opened_text(world: LedBoxAlone, **changed: Any) -> AbstractContextManager[text_lines.TextLineBox]:
        values = {"port": world.box.port, **usual, **changed}
        return closing(text_lines.TextLineBox(text_lines.Settings(**values), world.clock))

    return ledbox_alone(folder, make, opened_text, speed)


@contextmanager
def opened(world: LedBoxAlone, **settings: Any) -> Iterator[LedBox]:
    """The driver, opened on the world's box. The watchdog is slow: the tests' machine may stall."""
    values = {"port": world.box.port, "watchdog_s": 20.0, **settings}
    driver = LedBox(Settings(**values), world.clock)
    try:
        yield driver
    finally:
        driver.close()
