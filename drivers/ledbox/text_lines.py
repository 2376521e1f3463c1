"""An LED box that is controlled only by lines of text, such as a dome with a microcontroller.

Each command is a line made from a template in the rig, and the box answers each command with one line. A box of
this kind has no table, log, clock or watchdog. Therefore this driver limits the light. A thread ends each flash in
time, whatever the caller does. All LEDs are switched off at opening, at closing and after any failure. The box has
no device clear either: `lights_off` waits for the rest of a line, but not for an answer.
"""

from __future__ import annotations

import contextlib
import math
import string
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NoReturn, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from coupole.clock import Clock, Deadline
from coupole.devices import NO_LED, UNKNOWN_NS, HostNeed, Identity, StepRecord
from coupole.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.host_checks import serial_port
from drivers.ledbox.link import CallEnded, Cleared
from drivers.ledbox.serial_link import SerialLink, open_serial
from drivers.opening import closed_on_failure

_REPLY_MARGIN_S = 2.0
"""Time that a box may take to answer, not counting the transmission of the bytes."""
_SHORT_REPLY_BYTES, _LONGEST_REPLY_BYTES = 100, 1000
_CONFIRMS_S = 0.5
"""Time to confirm a light. If a box takes longer, its light is shorter, because the box's own limit must not come
before the driver's."""
_BOX_PATIENCE = 1.5
"""The box's own limit of a light, divided by the driver's limit. It allows for the box's cheap clock."""
_LOOK_S = 0.001
"""Machine time between two readings of the rig's clock during a flash."""
_ENDED_AT_ONCE = 5
"""Threads that may switch the lights off at the same time. Each thread ends the exchanges of the others."""
_ENDINGS = {"lf": "\n", "crlf": "\r\n", "cr": "\r"}
_FIELDS: dict[str, tuple[frozenset[str], frozenset[str]]] = {
    "on": (frozenset({"led"}), frozenset({"led", "on_ms"})),
    "off": (frozenset({"led"}), frozenset({"led"})),
    "all_off": (frozenset(), frozenset()),
    "identify": (frozenset(), frozenset()),
}
"""Fields of each template: required fields, and allowed fields."""


class Settings(BaseModel):
    """Settings of such a box in a rig. Templates are Python's format strings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    port: str
    """A pyserial URL: `/dev/ttyACM0`, `COM3`, `socket://host:port`, `rfc2217://host:port`."""
    baud: int = Field(default=115200, ge=300)
    led_count: int = Field(ge=1, le=65535)
    """Number of LEDs of the box; Coupole numbers them from 0."""
    first_led: int = Field(default=0, ge=0)
    """The box's number for LED 0. It is 1 for a box that counts from 1."""
    on: str = "LED {led} ON"
    """Switches one LED on. It may contain `{on_ms}`: a time after which the box itself switches the LED off."""
    off: str | None = "LED {led} OFF"
    """Switches one LED off; null for a box that has only `all_off`."""
    all_off: str = "ALL OFF"
    identify: str | None = None
    """Asks the box for its identity, which it answers in one line; null for a box without this command."""
    expected_reply: str = Field(default="OK", min_length=1)
    """The whole line with which the box confirms a command. A box that never answers is not supported, because
    nothing would prove which LED was lit during an exposure."""
    line_ending: Literal["lf", "crlf", "cr"] = "lf"
    """Ending of commands. A reply ends in LF, or in CR if commands do."""
    settle_ms: float = Field(default=2000, ge=0, le=60_000)
    """Time from opening the port until the box accepts commands: many microcontrollers reset when it is opened."""
    name: str = "led box"

    def longest_light_s(self, on_us: int) -> float:
        """Longest time for which the box leaves a light of `on_us` on if the host dies, which is its own limit.
        (If `on` has no `{on_ms}`, the box has no limit, and leaves the light on until the next command.)"""
        return _box_bound_ms(on_us) * 1e-3

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        return serial_port(self.port)

    @model_validator(mode="after")
    def _templates_are_right(self) -> Self:
        for name in _FIELDS:
            template = getattr(self, name)
            if template is not None:
                _check_template(name, template)
        return self


def _check_template(name: str, template: str) -> None:
    """Raise ValueError for a template that does not give one line of ASCII with the fields allowed for it."""
    must, may = _FIELDS[name]
    try:
        template_fields = {
            field_name for _, field_name, _, _ in string.Formatter().parse(template) if field_name is not None
        }
        if missing := must - template_fields:
            raise ValueError(f"it lacks {{{min(missing)}}}")
        if unknown := template_fields - may:
            allowed_fields = ", ".join(f"{{{known_field}}}" for known_field in sorted(may)) or "no field"
            raise ValueError(f"it has {{{min(unknown)}}}; allowed: {allowed_fields}")
        line = template.format(led=0, on_ms=1)
    except (ValueError, IndexError, KeyError) as error:
        raise ValueError(f"`{name}`: `{template}` is not a template of a command: {error}") from error
    if not line.isascii() or not line.isprintable() or not line:
        raise ValueError(f"`{name}`: expected one line of printable ASCII, found {line!r}")


def _box_bound_ms(on_us: int) -> int:
    """Return the box's own limit for a light of `on_us`."""
    return math.ceil(_BOX_PATIENCE * (on_us * 1e-6 + _CONFIRMS_S) * 1e3)


@dataclass
class _Flash:
    """A flash that was requested."""

    led: int
    sent_ns: int
    """Rig time at which its command was sent. The flash cannot have begun earlier."""
    deadline: Deadline
    end_event: threading.Event = field(default_factory=threading.Event)
    """Set before the command that ends the light is sent."""
    off_ns: int | None = None
    """Rig time at which the box confirmed that command; None until then."""
    failure: DeviceError | None = None
    """Error that prevented the driver's thread from ending the flash."""


class TextLineBox:
    """The box: a `coupole.devices.LedBox`.

    Each call may raise DeviceTimeout, DeviceLost, DeviceRefused with the box's reply, or another DeviceError if
    `lights_off` was called meanwhile.
    """

    runs_tables = False
    panel_count = 0

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._settings, self._clock = settings, clock
        self.led_count = settings.led_count
        self._lock = threading.RLock()
        self._ends = 0
        """Number of times that `lights_off` has ended calls in progress."""
        self._flash: _Flash | None = None
        self._in_step = False
        """True if the next line from the box is the answer to the next command."""
        self._link: SerialLink = open_serial(settings.name, settings.port, settings.baud, clock)
        with closed_on_failure(self.close):
            clock.sleep(settings.settle_ms * 1e-3)
            self.lights_off()
            self._identity = self._greet()

    def identify(self) -> Identity:
        return self._identity

    def self_test(self) -> Mapping[str, str]:
        """Number of LEDs and kind of confirmation; raises if the box does not execute a command."""
        self.lights_off()
        return {
            "LEDs": str(self.led_count),
            "confirms": f"with `{self._settings.expected_reply}`",
            "enabling switch": "no input for one",
        }

    def presence(self) -> bool | None:
        """A box of this kind has no input for an enabling switch."""
        return None

    def flash(self, led: int, on_us: int) -> None:
        """Switch one LED on; returns when the box has confirmed it."""
        if led != NO_LED and not 0 <= led < self.led_count:
            self._refuse(
                f"an LED from 0 to {self.led_count - 1}", f"{led} was asked for", "Correct the LED table."
            )
        ends = self._ends
        longest_s = on_us * 1e-6 + _CONFIRMS_S
        on_ms = _box_bound_ms(on_us)  # by then the driver has ended the light, or the host is dead
        with self._lock:
            try:
                self._end(ends)
                from_sending, sent_ns = Deadline(self._clock, longest_s), self._clock.now_ns()
                if led != NO_LED:
                    self._command(self._settings.on.format(led=led + self._settings.first_led, on_ms=on_ms), ends)
                lasts_s = min(on_us * 1e-6, from_sending.remaining_s)
                self._flash = _Flash(led, sent_ns, Deadline(self._clock, lasts_s))
                threading.Thread(target=self._watch, args=(self._flash,), name="led box", daemon=True).start()
            except BaseException:
                self._try_lights_off()
                raise

    def lit(self) -> bool:
        """False once the flash's time is over, because the box may have ended it before this driver's thread."""
        flash = self._flash
        return flash is not None and not flash.end_event.is_set() and not flash.deadline.has_expired

    def end_flash(self) -> StepRecord:
        """End the flash now, if its time has not ended it. `on_us` ends at the box's confirmation."""
        flash = self._flash
        if flash is None:
            self._refuse("a flash to end", "none was begun", "This is a fault of the program that drives the box.")
        ends = self._ends
        with self._lock:
            self._end(ends)
            if flash.failure is not None:
                raise flash.failure
            if flash.off_ns is None:  # lights_off() failed
                self.lights_off()
        assert flash.off_ns is not None
        return StepRecord(
            step=0,
            led=flash.led,
            edge_sent=False,
            led_open=False,
            over_temperature=False,
            waited=False,
            on_us=0.0 if flash.led == NO_LED else (flash.off_ns - flash.sent_ns) / 1e3,
            t_on_ns=UNKNOWN_NS,
            t_trigger_ns=UNKNOWN_NS,
            board_temperature_c=math.nan,
            led_current_ma=math.nan,
        )

    def lights_off(self) -> None:
        """Switch all LEDs off; the box confirms it. Calls of other threads end with DeviceError. Raises only if a
        second try fails too, because the first command may have been appended to an incomplete line in the box."""
        self._ends += 1
        self._link.end_exchanges()
        with self._lock:
            if self._flash is not None:
                self._flash.end_event.set()
            for _ in range(_ENDED_AT_ONCE):
                # another thread's lights_off has ended this call: send it again
                with contextlib.suppress(CallEnded):
                    self._all_off()
                    break
            if self._flash is not None and self._flash.off_ns is None:
                self._flash.off_ns = self._clock.now_ns()

    def acknowledge(self) -> None:
        """Do nothing: a box of this kind keeps no faults."""
        self.lights_off()

    def panel(self, panel: int, on: bool) -> None:
        self._refuse(
            "a panel that the box has", f"panel {panel} was requested, but the box has none", "Leave out panels."
        )

    def board_temperature_c(self, board: int) -> float | None:
        return None

    def close(self) -> None:
        """Switch the lights off if the box still answers. Never raises for a lost link."""
        self._try_lights_off()
        self._link.close()

    def _all_off(self) -> None:
        try:
            self._command(self._settings.all_off, self._ends)
        except (DeviceTimeout, DeviceRefused):
            self._command(self._settings.all_off, self._ends)

    # How a light ends.

    def _watch(self, flash: _Flash) -> None:
        """End a flash when its time is over. Runs in its own thread."""
        ends = self._ends
        while not flash.deadline.has_expired:
            if flash.end_event.wait(_LOOK_S):
                return
        with self._lock:
            if not flash.end_event.is_set():
                with contextlib.suppress(DeviceError):  # kept in flash.failure, for the caller
                    self._end(ends)

    def _end(self, ends: int) -> None:
        """End the present flash, if it has not ended."""
        flash = self._flash
        if flash is None or flash.end_event.is_set():
            return
        flash.end_event.set()
        try:
            if flash.led != NO_LED:
                settings = self._settings
                off = (settings.off or settings.all_off).format(led=flash.led + settings.first_led)
                self._command(off, ends)
            flash.off_ns = self._clock.now_ns()
        except DeviceError as error:
            flash.failure = error
            self._try_lights_off()
            raise

    def _try_lights_off(self) -> None:
        """Switch all LEDs off if the box still answers."""
        with contextlib.suppress(DeviceError):
            self.lights_off()

    # Lines.

    def _greet(self) -> Identity:
        """Return the identity from a reply `vendor,model,serial,firmware`. Any other reply counts as the model."""
        if self._settings.identify is None:
            return Identity("unknown", "box of text lines", "unknown", "unknown")
        text = self._exchange(self._settings.identify, self._ends)
        fields = [part.strip() for part in text.split(",")]
        vendor, model, serial, firmware = fields if len(fields) == 4 else ("unknown", text, "unknown", "unknown")
        return Identity(vendor, model, serial, firmware, simulated=serial.startswith("SIM"))

    def _command(self, line: str, ends: int) -> None:
        """Let the box execute a command. Raises DeviceRefused for any reply but the expected one."""
        expected_reply = self._settings.expected_reply
        reply = self._exchange(line, ends)
        if reply != expected_reply:
            self._in_step = False
            self._refuse(
                f"`{expected_reply}` in answer to `{line}`",
                f"it said `{reply}`",
                "Check the box's reply and the rig.",
            )

    def _exchange(self, line: str, ends: int) -> str:
        """Send a line, and return the box's answer without its ending. `ends` is the number of ended calls when
        the call began."""
        settings, link = self._settings, self._link
        data = (line + _ENDINGS[settings.line_ending]).encode("ascii")
        seconds = _REPLY_MARGIN_S + (len(data) + _SHORT_REPLY_BYTES) / link.bytes_per_s
        clears = link.clears  # read before `ends` is compared: then no end of calls is overlooked
        if self._ends != ends:
            raise CallEnded(settings.name, f"`{line}`")
        try:
            if not self._in_step:
                link.clear()
            elif stray_bytes := link.waiting().strip():
                self._in_step = False
                self._refuse(
                    f"silence before `{line}`",
                    f"the box said `{_printable(stray_bytes)}` unasked",
                    "Check whether it has restarted, and whether it answers each command with one line.",
                )
            self._in_step = False
            deadline = Deadline(self._clock, seconds)
            link.write(data, deadline, clears)
            reply = read_reply(lambda: link.read_bytes(deadline, clears), settings.line_ending)
            self._in_step = True
        except Cleared as cleared:
            raise CallEnded(settings.name, f"`{line}`") from cleared
        except TimeoutError as error:
            raise DeviceTimeout(
                settings.name,
                expected=f"an answer to `{line}` within {seconds:.2f} s",
                happened=str(error),
                remedy=f"Check that the box at {settings.port} has power and the rig's baud rate, then resume.",
            ) from error
        except ConnectionError as error:
            raise DeviceLost(
                settings.name,
                expected=f"an answer to `{line}`",
                happened=str(error),
                remedy=f"Check the cable at {settings.port} and the box's power, then resume.",
            ) from error
        except ValueError as error:
            self._refuse(f"one line in answer to `{line}`", str(error), "Make the box answer with one short line.")
        return reply

    def _refuse(self, expectation: str, observation: str, remedy: str) -> NoReturn:
        raise DeviceRefused(self._settings.name, expected=expectation, happened=observation, remedy=remedy)


def read_reply(receive: Callable[[], bytes], line_ending: str) -> str:
    """One line of a box's reply, without its ending; `receive` returns the next bytes at each call.

    Raises ValueError for a line that is too long, or followed by more bytes; TimeoutError, with the bytes
    received, if `receive` raises it.
    """
    ending = b"\r" if line_ending == "cr" else b"\n"
    data = b""
    while ending not in data:
        if len(data) > _LONGEST_REPLY_BYTES:
            raise ValueError(f"{len(data)} bytes came without an end: `{_printable(data[:40])}`...")
        try:
            data += receive()
        except TimeoutError as error:
            raise TimeoutError(f"only `{_printable(data)}` came" if data else str(error)) from error
    line, _, rest = data.partition(ending)
    if rest.strip():
        raise ValueError(f"it said `{_printable(data)}`")
    return _printable(line.strip())


def _printable(data: bytes) -> str:
    """The box's reply with unprintable bytes escaped."""
    return data.decode("ascii", "backslashreplace").replace("\r", "\\r").replace("\n", "\\n")
