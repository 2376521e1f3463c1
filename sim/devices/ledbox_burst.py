"""One run of a table: light, edges and log, timed by the box's own quartz.

Step k lights its LED at t_on(k), sends its edge at t_on(k) + trigger_delay, darkens the LED at t_on(k) + on, and
t_on(k + 1) = t_on(k) + period. Everything is scheduled ahead in world time, so the load of the machine does not
affect it. The pure functions and two small states used (quartz, boards) follow below.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.devices.ledbox_table import FLAG_NO_TRIGGER, NO_LIGHT
from sim.world.reactor import Reactor, Timer

_LOG_RECORD = struct.Struct("<IHHQQhH")
STATUS_LED_OPEN, STATUS_OVER_TEMPERATURE, STATUS_NO_EDGE, STATUS_WAITED = 1, 2, 4, 8
"""Bits of a log record's status: the LED drew no current; its board was too hot, and the burst ends; no edge was
sent; the step was delayed until the camera was ready."""
_START_LEAD_NS = 200_000
"""Time from INITiate to the first t_on."""
_READY_SAMPLE_NS = 100_000
"""Period at which the box samples the ready line while a step is delayed."""


@dataclass(frozen=True)
class Wiring:
    """Connections of a burst. `send_edge` has no argument: it happens at the reactor's `now_ns`."""

    send_edge: Callable[[], None]
    on_light: Callable[[int, int, int], None]
    on_dark: Callable[[int], None]
    ready: Callable[[], bool] | None
    """The camera's exposure-ready line; None if the box does not use it."""
    on_end: Callable[[], None]


class _Done(NamedTuple):
    """Log data of a step, except temperature; times on the box's clock."""

    step: int
    led: int
    status: int
    t_on: int
    t_edge: int
    current_ma: int


class Burst:
    """Runs `table` (STEP [n]) once. `state` is RUN, then IDLE, ABORTED or FAULT."""

    def __init__(
        self,
        reactor: Reactor,
        quartz: Quartz,
        boards: Boards,
        table: NDArray[np.void],
        wiring: Wiring,
        *,
        dead_leds: set[int],
        led_current_ma: int,
    ) -> None:
        self._reactor, self._quartz, self._boards, self._wiring = reactor, quartz, boards, wiring
        self._steps: list[tuple[int, int, int, int, int]] = table.tolist()
        self._dead_leds, self._led_current_ma = dead_leds, led_current_ma
        self._timers: list[Timer] = []
        self._lit: tuple[int, int, int] | None = None  # led, world ns on, world ns off
        self.state = "RUN"
        self.edges = 0
        self.log = bytearray()
        self._begin(0, quartz.box_ns(reactor.now_ns) + _START_LEAD_NS, 0)

    @property
    def finished_count(self) -> int:
        """Steps whose LED went off and whose edge was sent: records in the log."""
        return len(self.log) // _LOG_RECORD.size

    def records(self, first: int, count: int) -> bytes:
        """Log bytes of at most `count` records from record `first`."""
        return bytes(self.log[first * _LOG_RECORD.size : (first + count) * _LOG_RECORD.size])

    def abort(self) -> None:
        """Darken the LED at once and end the burst. The present step gets no record."""
        if self.state == "RUN":
            self._end("ABORTED")

    def _begin(self, index: int, t_on: int, status: int) -> None:
        """Schedule step `index` for box time `t_on`."""
        callback = partial(self._step, index, t_on, status)
        self._timers.append(self._reactor.at(self._quartz.world_ns(t_on), callback))

    def _step(self, index: int, t_on: int, status: int) -> None:
        self._timers = []
        if self._wiring.ready is not None and not self._wiring.ready():
            self._begin(index, t_on + _READY_SAMPLE_NS, STATUS_WAITED)
            return
        led, flags, on_us, delay_us, period_us = self._steps[index]
        at, world_ns = self._reactor.at, self._quartz.world_ns
        t_off, t_edge, current_ma = t_on + on_us * 1000, 0, 0
        t_next = t_on + period_us * 1000
        if led != NO_LIGHT:
            if led in self._dead_leds:
                status |= STATUS_LED_OPEN
            else:
                current_ma = self._led_current_ma
                self._lit = (led, self._reactor.now_ns, world_ns(t_off))
                self._timers.append(at(self._lit[2], self._darken))
                self._wiring.on_light(*self._lit)
        if flags & FLAG_NO_TRIGGER:
            status |= STATUS_NO_EDGE
        else:
            t_edge = t_on + delay_us * 1000 + round(self._quartz.edge_lateness_ns())
            self._timers.append(at(world_ns(t_edge), self._edge))
        finish = partial(self._finish, _Done(index, led, status, t_on, t_edge, current_ma))
        self._timers.append(at(world_ns(max(t_off, t_edge)), finish))
        if index + 1 < len(self._steps):
            self._begin(index + 1, t_next, 0)
        else:
            self._timers.append(at(world_ns(t_next), partial(self._end, "IDLE")))

    def _edge(self) -> None:
        self.edges += 1
        self._wiring.send_edge()

    def _darken(self) -> None:
        """Switch the LED off and add the heat of its light to its board."""
        if self._lit is not None:
            led, on_ns, _ = self._lit
            now_ns = self._reactor.now_ns
            self._boards.heat(led, (now_ns - on_ns) / 1e9, now_ns)
            self._lit = None

    def _finish(self, finished_step: _Done) -> None:
        temperature_c = self._boards.temperature_of_led_c(finished_step.led, self._reactor.now_ns)
        too_hot = self._boards.tripped or temperature_c > self._boards.limit_c
        status = finished_step.status | (STATUS_OVER_TEMPERATURE if too_hot else 0)
        self.log += _LOG_RECORD.pack(
            finished_step.step,
            finished_step.led,
            status,
            finished_step.t_on,
            finished_step.t_edge,
            round(temperature_c * 10),
            finished_step.current_ma,
        )
        if too_hot:
            self._end("FAULT")

    def _end(self, state: str) -> None:
        for timer in self._timers:
            timer.cancel()
        if self._lit is not None:
            self._darken()
            self._wiring.on_dark(self._reactor.now_ns)
        self.state = state
        self._wiring.on_end()


class Quartz:
    """The box's clock relative to the world's: offset, rate error, and the seeded jitter of edges."""

    def __init__(self, offset_ns: int, ppm: float, edge_jitter_us: float, seed: int) -> None:
        self._offset_ns, self._rate = offset_ns, 1.0 + ppm * 1e-6
        self._jitter_ns, self._random = edge_jitter_us * 1000.0, Random(seed)

    def box_ns(self, world_ns: int) -> int:
        return self._offset_ns + round(world_ns * self._rate)

    def world_ns(self, box_ns: int) -> int:
        return round((box_ns - self._offset_ns) / self._rate)

    def edge_lateness_ns(self) -> float:
        """Lateness of an edge, half-normal with the rms `edge_jitter_us`: an edge may be late, never early."""
        return abs(self._random.gauss(0.0, self._jitter_ns))


@dataclass(frozen=True)
class BoardHeat:
    """Thermal properties of the boards."""

    leds_per_board: int
    ambient_c: float
    warm_k: float
    """Excess over ambient at power-on."""
    limit_c: float
    led_power_w: float
    heat_k_per_j: float
    time_constant_s: float


class Boards:
    """Temperature of every board: one first-order thermal node each.

    T(t) = ambient + (T(t0) - ambient) exp(-(t - t0) / tau), and each lit joule adds `heat_k_per_j`.
    """

    def __init__(self, count: int, heat: BoardHeat) -> None:
        self.limit_c, self._ambient_c = heat.limit_c, heat.ambient_c
        self._leds_per_board = heat.leds_per_board
        self._kelvin_per_s = heat.led_power_w * heat.heat_k_per_j
        self._tau_ns = heat.time_constant_s * 1e9
        self._excess_k = [heat.warm_k] * count
        self._since_ns = [0] * count
        self.tripped = False
        """True from the moment an unlit board exceeds the limit, until it has cooled."""

    def __len__(self) -> int:
        return len(self._excess_k)

    def temperature_c(self, board: int, now_ns: int) -> float:
        decay = math.exp(-(now_ns - self._since_ns[board]) / self._tau_ns)
        return self._ambient_c + self._excess_k[board] * decay

    def temperature_of_led_c(self, led: int, now_ns: int) -> float:
        """Temperature of the LED's board; the ambient one for a dark step."""
        if led == NO_LIGHT:
            return self._ambient_c
        return self.temperature_c(led // self._leds_per_board, now_ns)

    def heat(self, led: int, lit_s: float, now_ns: int) -> None:
        board = led // self._leds_per_board
        excess_k = self.temperature_c(board, now_ns) - self._ambient_c
        self._excess_k[board] = excess_k + lit_s * self._kelvin_per_s
        self._since_ns[board] = now_ns

    def set_temperature(self, board: int, celsius: float, now_ns: int) -> None:
        """Set a board's temperature, as if something other than light had heated it."""
        self._excess_k[board] = celsius - self._ambient_c
        self._since_ns[board] = now_ns
        self.tripped = self.tripped or celsius > self.limit_c

    def hottest(self, now_ns: int) -> tuple[int, float]:
        """Return number and temperature of the hottest board. `tripped` is cleared if the temperature is within
        the limit."""
        board = max(range(len(self)), key=lambda one: self.temperature_c(one, now_ns))
        celsius = self.temperature_c(board, now_ns)
        self.tripped = celsius > self.limit_c
        return board, celsius
