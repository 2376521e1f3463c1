"""The LED control box's firmware, on the world's clock (docs/reference/ledbox-protocol.md).

It answers on a pseudo-terminal; its effects on the world (light, trigger edges, panels) are callbacks with world
times in nanoseconds. The box has its own quartz, which differs from the world's clock.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from sim.devices.ledbox_burst import BoardHeat, Boards, Burst, Quartz, Wiring
from sim.devices.ledbox_link import Link
from sim.devices.ledbox_table import MAX_RECORDS, STEP, check_table, read_table
from sim.devices.pty_port import PtyPort
from sim.devices.scpi_parser import (
    Argument,
    Command,
    Interpreter,
    ScpiError,
    block,
    boolean,
    integer,
    keyword,
    number,
)
from sim.world.reactor import Reactor, Timer

_PANELS = (1, 2, 3, 4)
_OVER_LIMIT_K = 5.0
"""Temperature above the board's limit that the fault `over_temperature` sets."""


class Settings(BaseModel):
    """Properties of the box. Physical values are those of a typical 15 W LED on a small board."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["scpi"] = "scpi"
    baud: int = Field(default=115200, ge=0)
    """Rate of the serial line in world time; 0: no limit."""
    led_count: int = Field(default=1080, ge=1, le=65535)
    leds_per_board: int = Field(default=6, ge=1)
    """Board of an LED: led // leds_per_board."""
    serial_number: str = "SIM-0001"
    enabling_switch: Literal["none", "released", "held"] = "none"
    """State of the enabling switch at power-on, on the box's input for it; `none`: the box has no such input."""
    clock_offset_ns: int = Field(default=5_000_000_000, ge=0)
    """Reading of the box's clock at world time 0."""
    clock_ppm: float = Field(default=12.0, ge=-1000, le=1000)
    edge_jitter_us: float = Field(default=1.0, ge=0, le=3)
    """Rms lateness of trigger edges."""
    seed: int = 1
    protocol: Literal["1.0", "1.1"] = "1.1"
    """Version of the protocol. In 1.0 the box does not know device clear, tables in blocks, and the question for
    this version."""
    led_current_ma: int = Field(default=700, ge=0, le=65535)
    led_power_w: float = Field(default=15.0, ge=0)
    heat_k_per_j: float = Field(default=0.02, ge=0)
    thermal_time_constant_s: float = Field(default=240.0, gt=0)
    ambient_c: float = 22.0
    warm_k: float = Field(default=0.0, ge=0)
    """Temperature of the boards above ambient at power-on, as after a long run. The boards then cool."""
    board_limit_c: float = 75.0
    block_timeout_s: float = Field(default=2.0, gt=0)
    """An incomplete block is discarded after this time without further bytes."""


@dataclass(frozen=True)
class BoxCables:
    """The cables between the box and the simulated world. Times are on the world's clock. By default nothing is
    connected."""

    on_edge: Callable[[int], None] = lambda t_ns: None
    """Called for each pulse on the trigger cable."""
    on_light: Callable[[int, int, int], None] = lambda led, t_on_ns, t_off_ns: None
    """Called at t_on."""
    on_dark: Callable[[int], None] = lambda t_ns: None
    """Called if a light ends before its t_off."""
    on_panel: Callable[[int, bool, int], None] = lambda panel, on, t_ns: None
    ready: Callable[[], bool] = lambda: True
    """Reads the camera's exposure-ready line."""


NOT_CONNECTED = BoxCables()


class LedBoxFirmware:
    """The box. All methods must be called on the reactor's thread.

    `on_edge_counted`, if set, gets each edge's number since power-on (from 0), after the edge, for faults at a
    given edge. Without `link`, the box opens a pseudo-terminal.
    """

    def __init__(
        self, reactor: Reactor, settings: Settings, cables: BoxCables = NOT_CONNECTED, *, link: Link | None = None
    ) -> None:
        self._reactor, self._settings, self._cables = reactor, settings, cables
        self.on_edge_counted: Callable[[int], None] | None = None
        self._quartz = Quartz(settings.clock_offset_ns, settings.clock_ppm, settings.edge_jitter_us, settings.seed)
        self._boards = Boards(
            -(-settings.led_count // settings.leds_per_board),
            BoardHeat(
                leds_per_board=settings.leds_per_board,
                ambient_c=settings.ambient_c,
                warm_k=settings.warm_k,
                limit_c=settings.board_limit_c,
                led_power_w=settings.led_power_w,
                heat_k_per_j=settings.heat_k_per_j,
                time_constant_s=settings.thermal_time_constant_s,
            ),
        )
        self._edge_count = 0
        self._dropped_edges: set[int] = set()
        self._doubled_edges: dict[int, int] = {}
        self.dead_leds: set[int] = set()
        """LEDs that draw no current and give no light from their next step on."""
        self._panels = dict.fromkeys(_PANELS, False)
        self.enabling_switch = settings.enabling_switch
        self._burst: Burst | None = None
        self._heard_ns = self._deaf_until_ns = reactor.now_ns
        self._watchdog_timer: Timer | None = None
        self._block_timer: Timer | None = None
        self._reset()
        self._scpi = Interpreter(self._commands(), MAX_RECORDS * STEP.itemsize)
        self._link: Link = link or PtyPort(reactor, settings.baud)
        self.port = self._link.port
        self._link.listen(self._receive, self._device_clear if self._clears else None)

    # Faults for the fault script.

    @property
    def edge_count(self) -> int:
        """Number of edges since power-on; it is also the number of the next edge."""
        return self._edge_count

    def drop_edge(self, n: int) -> None:
        """Edge number `n` since power-on is logged and counted, but not sent."""
        self._dropped_edges.add(n)

    def double_edge(self, n: int, delay_us: int) -> None:
        """A second pulse, neither logged nor counted, follows edge number `n` after `delay_us`."""
        self._doubled_edges[n] = delay_us

    def mute(self, seconds: float | None = None) -> None:
        """Neither receive nor answer, for ever or for `seconds`. A burst continues."""
        if seconds is None:
            self._link.mute()
        else:
            self._deaf_until_ns = self._reactor.now_ns + round(seconds * 1e9)

    def unplug(self) -> None:
        """Unplug the cable to the host."""
        self._link.close()

    def close(self) -> None:
        """Release the line; a second call does nothing."""
        self._link.close()

    def temperature_of_led_c(self, led: int) -> float:
        """Present temperature of the LED's board."""
        return self._boards.temperature_of_led_c(led, self._reactor.now_ns)

    def over_temperature(self, board: int) -> None:
        """Set the board above its limit; it then cools."""
        self._boards.set_temperature(board, self._boards.limit_c + _OVER_LIMIT_K, self._reactor.now_ns)

    # Bytes in, bytes out.

    def _receive(self, data: bytes) -> None:
        if (now_ns := self._reactor.now_ns) < self._deaf_until_ns:
            return
        self._heard_ns = now_ns
        for reply in self._scpi.replies(data):
            if reply and not self._link.send(reply):
                self._scpi.report(ScpiError(-430, "responses were not read"))
        if self._scpi.inside_block and self._block_timer is None:
            self._check_block()

    def _device_clear(self) -> None:
        """Make everything dark at once, and forget the incomplete message and the unsent responses."""
        self._abort()
        self._scpi.clear()
        self._link.drop_output()

    @property
    def _clears(self) -> bool:
        return self._settings.protocol != "1.0"

    def _check_block(self) -> None:
        """Check for the time-out of an incomplete block; one timer per time-out, not per byte."""
        self._block_timer = None
        due_ns = self._heard_ns + round(self._settings.block_timeout_s * 1e9)
        if not self._scpi.inside_block:
            return
        if self._reactor.now_ns >= due_ns:
            self._scpi.drop_block()
        else:
            self._block_timer = self._reactor.at(due_ns, self._check_block)

    def _commands(self) -> dict[str, Command]:
        newer = {
            "SYSTem:PROTocol?": Command(lambda: self._settings.protocol),
            "SEQuence:DATA:APPend": Command(self._append_data, 1, 1),
        }
        if self._settings.enabling_switch != "none":
            newer["INPut:ENABle?"] = Command(lambda: str(int(self.enabling_switch == "held")))
        return (newer if self._clears else {}) | {
            "*IDN?": Command(lambda: f"Coupole,LED control box,{self._settings.serial_number},1.0"),
            "*RST": Command(self._reset),
            "ABORt": Command(self._abort),
            "INITiate": Command(self._initiate),
            "SYSTem:LEDS?": Command(lambda: str(self._settings.led_count)),
            "SYSTem:WATChdog": Command(self._set_watchdog, 1, 1),
            "SYSTem:WATChdog?": Command(lambda: f"{self._watchdog_s:g}"),
            "SEQuence:BANK": Command(self._set_bank, 1, 1),
            "SEQuence:BANK?": Command(lambda: str(self._bank)),
            "SEQuence:DATA": Command(self._set_data, 1, 1),
            "SEQuence:COUNt?": Command(lambda: str(len(self._tables[self._bank]))),
            "SEQuence:CRC?": Command(lambda: str(zlib.crc32(self._tables[self._bank].tobytes()))),
            "SEQuence:STATe?": Command(self._state),
            "SEQuence:INDex?": Command(lambda: str(self._burst.finished_count if self._burst else 0)),
            "SEQuence:LOG?": Command(self._log, 2, 2),
            "TRIGger:COUNt?": Command(lambda: str(self._burst.edges if self._burst else 0)),
            "TRIGger:OUTPut:WIDTh": Command(self._set_width, 1, 1),
            "TRIGger:OUTPut:WIDTh?": Command(lambda: str(self._width_us)),
            "TRIGger:OUTPut:POLarity": Command(self._set_polarity, 1, 1),
            "TRIGger:OUTPut:POLarity?": Command(lambda: self._polarity),
            "TRIGger:READy:SOURce": Command(self._set_ready_source, 1, 1),
            "TRIGger:READy:SOURce?": Command(lambda: self._ready_source),
            "OUTPut:PANel#": Command(self._set_panel, 1, 1),
            "OUTPut:PANel#?": Command(lambda panel: str(int(self._panels[_panel(panel)]))),
            "MEASure:TEMPerature?": Command(self._temperature, 0, 1),
        }

    # Commands.

    def _reset(self) -> None:
        self._abort()
        self._burst = None
        self._fault = ""
        self._bank = 0
        empty: NDArray[np.void] = np.empty(0, STEP)
        self._tables = [empty, empty]
        self._watchdog_s = 0.0
        self._width_us, self._polarity, self._ready_source = 50, "NORM", "NONE"

    def _abort(self) -> None:
        """Switch off all light and end the burst."""
        if self._burst is not None:
            self._burst.abort()
        for panel in _PANELS:
            self._switch_panel(panel, on=False)

    def _initiate(self) -> None:
        if self._running:
            raise ScpiError(-213, "a burst is running")
        self._refuse_while_faulty()
        table = self._tables[self._bank]
        if not len(table):
            raise ScpiError(-221, f"bank {self._bank} is empty")
        check_table(table, self._settings.led_count, self._width_us)  # the width may have grown since
        board, celsius = self._boards.hottest(self._reactor.now_ns)
        if self._boards.tripped:
            raise ScpiError(102, f"board {board} is at {celsius:.1f} C")
        wiring = Wiring(
            send_edge=self._send_edge,
            on_light=self._cables.on_light,
            on_dark=self._cables.on_dark,
            ready=self._cables.ready if self._ready_source == "INP" else None,
            on_end=self._burst_ended,
        )
        self._running_bank = self._bank
        self._burst = Burst(
            self._reactor,
            self._quartz,
            self._boards,
            table,
            wiring,
            dead_leds=self.dead_leds,
            led_current_ma=self._settings.led_current_ma,
        )
        self._watch()

    def _burst_ended(self) -> None:
        if self._burst is not None and self._burst.state == "FAULT":
            board, celsius = self._boards.hottest(self._reactor.now_ns)
            self._latch(ScpiError(102, f"board {board} at {celsius:.1f} C, step {self._burst.finished_count - 1}"))

    def _set_bank(self, bank: Argument) -> None:
        self._bank = integer(bank, 0, 1)

    def _set_data(self, payload: Argument) -> None:
        self._upload(np.empty(0, STEP), payload)

    def _append_data(self, payload: Argument) -> None:
        self._upload(self._tables[self._bank], payload)

    def _upload(self, before: NDArray[np.void], payload: Argument) -> None:
        if isinstance(payload, str):
            raise ScpiError(-161, "a block is wanted")
        if self._running and self._bank == self._running_bank:
            raise ScpiError(-221, f"bank {self._bank} is running")
        self._tables[self._bank] = read_table(before, payload, self._settings.led_count, self._width_us)

    def _state(self) -> str:
        if self._burst is not None and self._burst.state != "IDLE":
            return self._burst.state
        return "ABORTED" if self._fault else "IDLE"

    def _log(self, first: Argument, count: Argument) -> bytes:
        start, record_count = integer(first, 0, 2**32 - 1), integer(count, 0, MAX_RECORDS)
        return block(self._burst.records(start, record_count) if self._burst else b"")

    def _set_width(self, width_us: Argument) -> None:
        self._width_us = integer(width_us, 10, 10_000)

    def _set_polarity(self, polarity: Argument) -> None:
        self._polarity = "NORM" if keyword(polarity, "NORMal", "INVerted") == "NORMal" else "INV"

    def _set_ready_source(self, source: Argument) -> None:
        self._ready_source = "INP" if keyword(source, "NONE", "INPut") == "INPut" else "NONE"

    def _set_panel(self, panel: int, on: Argument) -> None:
        _panel(panel)
        switch_on = boolean(on)
        if switch_on:
            self._refuse_while_faulty()
        self._switch_panel(panel, on=switch_on)
        self._watch()

    def _temperature(self, board: Argument = "") -> str:
        if board == "":
            return f"{self._boards.hottest(self._reactor.now_ns)[1]:.1f}"
        if isinstance(board, bytes) or not (board.startswith("(@") and board.endswith(")")):
            raise ScpiError(-104, "a channel list such as (@12) is wanted")
        number_of_board = integer(board[2:-1], 0, len(self._boards) - 1)
        return f"{self._boards.temperature_c(number_of_board, self._reactor.now_ns):.1f}"

    def _set_watchdog(self, seconds: Argument) -> None:
        self._watchdog_s = number(seconds, 0.0, 60.0)
        self._watch()

    # Events without command.

    @property
    def _running(self) -> bool:
        return self._burst is not None and self._burst.state == "RUN"

    def _send_edge(self) -> None:
        n, now_ns = self._edge_count, self._reactor.now_ns
        self._edge_count += 1
        if n not in self._dropped_edges:
            self._cables.on_edge(now_ns)
        if n in self._doubled_edges:
            self._reactor.after(self._doubled_edges[n] * 1e-6, self._send_surplus_edge)
        if self.on_edge_counted is not None:
            self.on_edge_counted(n)

    def _send_surplus_edge(self) -> None:
        self._cables.on_edge(self._reactor.now_ns)

    def _switch_panel(self, panel: int, *, on: bool) -> None:
        if self._panels[panel] != on:
            self._panels[panel] = on
            self._cables.on_panel(panel, on, self._reactor.now_ns)

    def _watch(self) -> None:
        """Check the watchdog. Its one timer is set to the earliest time at which it may trip."""
        if self._watchdog_timer is not None:
            self._watchdog_timer.cancel()
            self._watchdog_timer = None
        if not self._watchdog_s or not (self._running or any(self._panels.values())):
            return
        due_ns = self._heard_ns + round(self._watchdog_s * 1e9)
        if self._reactor.now_ns < due_ns:
            self._watchdog_timer = self._reactor.at(due_ns, self._watch)
            return
        self._abort()
        self._latch(ScpiError(101, f"nothing was received for {self._watchdog_s:g} s"))

    def _latch(self, error: ScpiError) -> None:
        self._fault = f"fault {error.code} is latched, *RST ends it"
        self._scpi.report(error)

    def _refuse_while_faulty(self) -> None:
        if self._fault:
            raise ScpiError(-200, self._fault)


def _panel(panel: int) -> int:
    if panel not in _PANELS:
        raise ScpiError(-114, f"panel {panel} is not 1 to 4")
    return panel
