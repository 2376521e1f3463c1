"""The firmware of a home-built dome, on the world's clock: one line of text in, one line out.

It is the sketch of docs/how-to/home-built-dome.md. Its commands are `LED <n> ON [<ms>]` (the box ends the light
after this time), `LED <n> OFF`, `ALL OFF` and `ID`. The answer is `OK`, the identity, or `ERR` and the reason.
Like such boxes, it has no clock, log or watchdog, and may light several LEDs at once.
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
    """Properties of the box."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["text"] = "text"
    baud: int = Field(default=115200, ge=0)
    """Rate of the serial line in world time; 0: not limited."""
    led_count: int = Field(default=64, ge=1, le=65535)
    first_led: int = Field(default=0, ge=0)
    """The box's number for LED 0."""
    answers: bool = True
    """True if the box answers. Otherwise it answers only the query for its identity."""
    serial_number: str = "SIM-0002"
    ambient_c: float = 22.0
    """Temperature of the LEDs, which are not heated."""


class TextBox:
    """The box. All methods must be called on the reactor's thread.

    `on_light(led, t_on_ns, t_off_ns)` is called at t_on, `on_dark(led, t_ns)` if that LED ends before its t_off.
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
        """LEDs that are lit, with the timer that will end them."""
        self.dead_leds: set[int] = set()
        """LEDs that give no light from their next flash on."""
        self._deaf_until_ns = 0
        self._stuck_leds: set[int] = set()
        self._line = bytearray()
        self._link = PtyPort(reactor, settings.baud)
        self.port = self._link.port
        self._link.listen(self._receive)

    # Faults for the fault script.

    def mute(self, seconds: float | None = None) -> None:
        """Neither receive nor answer, for ever or for `seconds`. Lit LEDs stay lit until they are due. Data that
        arrive meanwhile are lost.
        """
        if seconds is None:
            self._link.mute()
            return
        self._deaf_until_ns = self._reactor.now_ns + round(seconds * 1e9)

    def unplug(self) -> None:
        """Unplug the cable to the host; lit LEDs stay lit."""
        self._link.close()

    def stick_led(self, led: int) -> None:
        """Make an LED stick, as if its transistor had failed short: once it is lit, it cannot be switched off."""
        self._stuck_leds.add(led)

    def temperature_of_led_c(self, led: int) -> float:
        return self._settings.ambient_c

    def close(self) -> None:
        """Release the line; a second call does nothing."""
        self._link.close()

    # Lines in, lines out.

    def _receive(self, data: bytes) -> None:
        if self._reactor.now_ns < self._deaf_until_ns:
            return
        for byte in data:
            if byte != ord("\n"):
                if len(self._line) <= _LONGEST_LINE:
                    self._line.append(byte)
                continue
            line = self._line.decode("latin-1").strip()
            too_long = len(self._line) > _LONGEST_LINE
            self._line.clear()
            reply = "ERR line too long" if too_long else self._obey(line)
            if self._settings.answers or line == "ID":
                self._link.send(reply.encode("latin-1") + b"\r\n")

    def _obey(self, line: str) -> str:
        """Execute a command line; returns the answer."""
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
        """Return the LED number for the box's own number; None if the box has no such LED."""
        led = int(number) - self._settings.first_led if number.isdecimal() else -1
        return led if 0 <= led < self._settings.led_count else None

    # Light.

    def _lighten(self, led: int, on_ms: int | None) -> None:
        if led in self.dead_leds:
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
