"""The firmware of a home-built dome, standing on the world's clock: lines of text in, one line out for each.

It is the sketch of docs/how-to/home-built-dome.md: `LED <n> ON [<ms>]` (ended by the box after that time),
`LED <n> OFF`, `ALL OFF`, `ID`; the answer is `OK`, the identity, or `ERR` and why. It knows no time, keeps no log,
has no watchdog and may light several LEDs at once, as such boxes do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from sim.devices.pty_port import PtyPort
from sim.world.clock import FOREVER_NS
from sim.world.reactor import Reactor, Timer

_LONGEST_LINE = 64


class Settings(BaseModel):
    """What the box is like."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["text"] = "text"
    baud: int = Field(default=115200, ge=0)
    """Pace of the serial line, world time; 0 for none."""
    led_count: int = Field(default=64, ge=1, le=65535)
    first_led: int = Field(default=0, ge=0)
    """The box's own number of LED 0."""
    answers: bool = True
    """Without, it never says anything but who it is."""
    serial_number: str = "SIM-0002"
    ambient_c: float = 22.0
    """Of the LEDs, which are not heated."""


class TextBox:
    """The box. All methods are to be called on the reactor's thread.

    `on_light(led, t_on_ns, t_off_ns)` comes at t_on, `on_dark(led, t_ns)` when that LED ends before its t_off.
    """

    def __init__(
        self,
        reactor: Reactor,
        settings: Settings,
        *,
        on_light: Callable[[int, int, int], None],
        on_dark: Callable[[int, int], None],
    ) -> None:
        self._reactor, self._settings = reactor, settings
        self._on_light, self._on_dark = on_light, on_dark
        self._lit: dict[int, Timer | None] = {}
        """LEDs that shine, with the timer that will end them."""
        self._dead_leds: set[int] = set()
        self._stuck_leds: set[int] = set()
        self._line = bytearray()
        self._link = PtyPort(reactor, settings.baud)
        self.port = self._link.port
        self._link.listen(self._receive)

    # Faults that a script may cause.

    def mute(self) -> None:
        """The box neither hears nor answers any more; what shines, shines on."""
        self._link.mute()

    def unplug(self) -> None:
        """The cable to the host is pulled; what shines, shines on."""
        self._link.close()

    def kill_led(self, led: int) -> None:
        """From its next lighting on, the LED gives no light."""
        self._dead_leds.add(led)

    def stick_led(self, led: int) -> None:
        """From now on nothing ends the LED's light once it shines: its transistor is burnt through."""
        self._stuck_leds.add(led)

    def temperature_of_led_c(self, led: int) -> float:
        return self._settings.ambient_c

    def close(self) -> None:
        """Give the line back; a second call does nothing."""
        self._link.close()

    # Lines in, lines out.

    def _receive(self, data: bytes) -> None:
        for byte in data:
            if byte != ord("\n"):
                self._line.append(byte)
                continue
            line = self._line.decode("latin-1").strip()
            too_long = len(self._line) > _LONGEST_LINE
            self._line.clear()
            reply = "ERR line too long" if too_long else self._obey(line)
            if self._settings.answers or line == "ID":
                self._link.send(reply.encode("latin-1") + b"\r\n")

    def _obey(self, line: str) -> str:
        """Do what a line says; the answer."""
        match line.split():
            case ["ID"]:
                return f"Coupole,text box,{self._settings.serial_number},1.0"
            case ["ALL", "OFF"]:
                for shining in list(self._lit):
                    self._darken(shining)
                return "OK"
            case ["LED", number, "ON" | "OFF" as what, *rest] if len(rest) <= (what == "ON"):
                led = self._led(number)
                if led is None:
                    return f"ERR no LED {number}"
                if not all(word.isdecimal() for word in rest):
                    return f"ERR what? {line}"
                if what == "ON":
                    self._lighten(led, int(rest[0]) if rest else None)
                else:
                    self._darken(led)
                return "OK"
        return f"ERR what? {line}"

    def _led(self, number: str) -> int | None:
        """Of the LED with the box's own number, ours; None if the box has no such LED."""
        led = int(number) - self._settings.first_led if number.isdecimal() else -1
        return led if 0 <= led < self._settings.led_count else None

    # Light.

    def _lighten(self, led: int, on_ms: int | None) -> None:
        if led in self._dead_leds:
            return
        self._darken(led)
        now_ns = self._reactor.now_ns
        t_off_ns = FOREVER_NS
        self._lit[led] = None
        if on_ms is not None:
            t_off_ns = now_ns + on_ms * 1_000_000
            self._lit[led] = self._reactor.at(t_off_ns, lambda: self._darken(led))
        self._on_light(led, now_ns, FOREVER_NS if led in self._stuck_leds else t_off_ns)

    def _darken(self, led: int) -> None:
        if led not in self._lit or led in self._stuck_leds:
            return
        timer = self._lit.pop(led)
        if timer is not None:
            timer.cancel()
        self._on_dark(led, self._reactor.now_ns)
