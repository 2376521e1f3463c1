"""A driver for an LED box that Coupole does not know, written against the contract `coupole.devices.LedBox`.

The Lumen 16 (there is none: it stands for yours) listens on TCP. A request has 9 bytes, big-endian: its number
(u16), `L` (light), `D` (dark) or `?` (who are you), an LED (u16), a time in microseconds (u32). The answer is the
request's number, `+` or `-`, and 24 bytes of text. The box obeys each request as it comes, and ends each light
after its time by itself.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
from collections.abc import Mapping
from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict, Field

from coupole.clock import Clock, Deadline
from coupole.devices import NO_LED, UNKNOWN_NS, Identity, StepRecord
from coupole.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout

REQUEST, ANSWER = struct.Struct(">HcHI"), struct.Struct(">Hc24s")
ANSWERS_WITHIN_S = 2.0
CLOCK_ERROR = 1.01
"""The box's own clock may be slower than the host's by so much."""


class Settings(BaseModel):
    """What a rig says under `settings`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str
    tcp_port: int = Field(ge=1, le=65535)
    led_count: int = Field(default=16, ge=1, le=65535)

    def longest_light_s(self, on_us: int) -> float:
        """Longest time that a light of `on_us` stays on if the host dies."""
        return on_us * 1e-6 * CLOCK_ERROR


@dataclass
class Flash:
    """The last light that was asked for."""

    led: int
    on_us: int
    sent_ns: int
    off_ns: int | None = None
    """When the box had confirmed that it is dark; None until then."""


class LumenBox:
    """The box: a `coupole.devices.LedBox`."""

    runs_tables = False
    panel_count = 0

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._settings, self._clock = settings, clock
        self.led_count = settings.led_count
        self._flash: Flash | None = None
        self._lock = threading.Lock()
        """One call at a time; `lights_off` does not wait for it."""
        self._sending = threading.Lock()
        self._number = self._offs = 0
        """Of the last request; and how often `lights_off` has ended the calls in progress."""
        self._answers: dict[int, tuple[bytes, bytes]] = {}
        self._news = threading.Condition()
        self._is_gone = False
        try:
            self._socket = socket.create_connection((settings.host, settings.tcp_port), ANSWERS_WITHIN_S)
        except OSError as error:
            raise self._lost("a connection", str(error)) from error
        self._socket.settimeout(None)
        self._reader = threading.Thread(target=self._read_answers, daemon=True)
        self._reader.start()
        try:
            self.lights_off()
            model, serial, firmware = self._ask(b"?").split(",")
        except BaseException:
            self.close()
            raise
        self._identity = Identity("Lumen", model, serial, firmware, simulated=serial.startswith("SIM"))

    def identify(self) -> Identity:
        return self._identity

    def self_test(self) -> Mapping[str, str]:
        self.lights_off()
        return {"LEDs": str(self.led_count)}

    def flash(self, led: int, on_us: int) -> None:
        if led != NO_LED and not 0 <= led < self.led_count:
            raise self._refused(f"an LED from 0 to {self.led_count - 1}", f"{led} was asked for")
        offs = self._offs
        with self._lock:
            flash = Flash(led, on_us, self._clock.now_ns())
            try:
                if led == NO_LED:
                    self._ask(b"D", offs=offs)
                else:
                    self._ask(b"L", led, on_us, offs=offs)
            except DeviceError:
                if offs == self._offs:  # else lights_off has been called, and all is dark
                    self._try_lights_off()
                raise
            self._flash = flash

    def lit(self) -> bool:
        """The box ends a light no sooner than its time after it was sent."""
        flash = self._flash
        if flash is None or flash.off_ns is not None:
            return False
        return self._clock.now_ns() < flash.sent_ns + flash.on_us * 1000

    def end_flash(self) -> StepRecord:
        offs = self._offs
        with self._lock:
            flash = self._flash
            if flash is None:
                raise self._refused("a flash to end", "none was begun")
            if flash.off_ns is None:
                self._ask(b"D", offs=offs)
                flash.off_ns = self._clock.now_ns()
        on_us = min((flash.off_ns - flash.sent_ns) / 1e3, flash.on_us * CLOCK_ERROR)
        return StepRecord(
            step=0,
            led=flash.led,
            edge_sent=False,
            led_open=False,
            over_temperature=False,
            waited=False,
            on_us=0.0 if flash.led == NO_LED else on_us,
            t_on_ns=UNKNOWN_NS,
            t_trigger_ns=UNKNOWN_NS,
            board_temperature_c=math.nan,
            led_current_ma=math.nan,
        )

    def lights_off(self) -> None:
        """From any thread: it waits for no other call, and ends those that wait for an answer."""
        self._ask(b"D")
        if self._flash is not None and self._flash.off_ns is None:
            self._flash.off_ns = self._clock.now_ns()

    def acknowledge(self) -> None:
        self.lights_off()

    def panel(self, panel: int, on: bool) -> None:
        raise self._refused("a panel that the box has", f"panel {panel} was asked for, it has none")

    def board_temperature_c(self, board: int) -> float | None:
        return None

    def presence(self) -> bool | None:
        return None

    def close(self) -> None:
        self._try_lights_off()
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._reader.join()
        self._socket.close()

    def _try_lights_off(self) -> None:
        with contextlib.suppress(DeviceError):
            self.lights_off()

    def _ask(self, what: bytes, led: int = 0, on_us: int = 0, *, offs: int | None = None) -> str:
        """The box's answer. `offs` is how often all had been ended when the caller began: if that has changed, the
        request is not sent, or its answer not waited for. Without `offs`, this request is what ends the others."""
        expected = f"an answer to `{what.decode()}` within {ANSWERS_WITHIN_S:g} s"
        deadline = Deadline(self._clock, ANSWERS_WITHIN_S)
        with self._sending:
            if what == b"D" and offs is None:
                self._offs += 1
            self._end_if_overtaken(offs)
            self._number = number = (self._number + 1) % 65536
            self._answers.pop(number, None)
            try:
                self._socket.sendall(REQUEST.pack(number, what, led, on_us))
            except OSError as error:
                raise self._lost(expected, str(error)) from error
        with self._news:
            while number not in self._answers:
                if self._is_gone:
                    raise self._lost(expected, "it has hung up")
                self._end_if_overtaken(offs)
                if deadline.has_expired:
                    raise DeviceTimeout(
                        "led box", expected=expected, happened="nothing came", remedy="Check the box's power."
                    )
                self._news.wait(0.005)
            verdict, text = self._answers.pop(number)
        words = text.rstrip(b"\0").decode("ascii", "replace")
        if verdict != b"+":
            raise self._refused(f"`{what.decode()}` to be obeyed", f"the box said `{words}`")
        return words

    def _end_if_overtaken(self, offs: int | None) -> None:
        if offs is not None and offs != self._offs:
            raise DeviceError(
                "led box",
                expected="to finish the call",
                happened="lights_off came first",
                remedy="Call again, if there is to be light.",
            )

    def _read_answers(self) -> None:
        data = b""
        while True:
            try:
                piece = self._socket.recv(4096)
            except OSError:
                piece = b""
            with self._news:
                data += piece
                while len(data) >= ANSWER.size:
                    number, verdict, text = ANSWER.unpack_from(data)
                    self._answers[number] = (verdict, text)
                    data = data[ANSWER.size :]
                self._is_gone = not piece
                self._news.notify_all()
            if not piece:
                return

    def _lost(self, expected: str, happened: str) -> DeviceLost:
        place = f"{self._settings.host}:{self._settings.tcp_port}"
        return DeviceLost("led box", expected=expected, happened=happened, remedy=f"Check the cable to {place}.")

    def _refused(self, expected: str, happened: str) -> DeviceRefused:
        return DeviceRefused("led box", expected=expected, happened=happened, remedy="Correct plan or rig.")
