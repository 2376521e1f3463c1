"""LEDs and their boards in a schedule: on-times within limits, dark times, heat."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.devices import NO_LED
from coupole.plan.bursts import Burst
from coupole.plan.led_table import LedTable
from coupole.plan.rig import BoardThermal, LedLimits


def refuse_on_times(bursts_of_views: Sequence[Sequence[Burst]], limits: LedLimits) -> list[str]:
    """Return a refusal for each exposure of each view in which an LED is on for too long or too short. Views with
    the same table of steps share one refusal."""
    low_us, high_us = limits.on_us
    first_of: dict[tuple[int, int], tuple[Burst, int]] = {}
    views_of: dict[tuple[int, int], list[str]] = {}
    for burst in (burst for bursts in bursts_of_views for burst in bursts):
        lit = burst.table["led"] != NO_LED
        wrong = lit & ((burst.table["on_us"] < low_us) | (burst.table["on_us"] > high_us))
        if wrong.any():
            step = int(np.flatnonzero(wrong)[0])
            alike = burst.exposure_index, int(burst.table["led"][step])
            first_of.setdefault(alike, (burst, step))
            views_of.setdefault(alike, []).append(burst.view)
    refusals = []
    for alike, (burst, step) in first_of.items():
        other_count = len(set(views_of[alike])) - 1
        also = f" (and in {other_count} more views)" if other_count else ""
        refusals.append(
            f"shot {burst.view}/{burst.labels[step]}{also}: LED {burst.table['led'][step]} would be on for "
            f"{burst.table['on_us'][step]} us; the limits are {low_us} to {high_us} us"
        )
    return refusals


@dataclass(frozen=True)
class Heat:
    """Heating of the boards over a whole schedule."""

    peak_c: float
    too_hot: bool
    """True if boards exceed their limit, or LEDs have too short dark times."""
    refusals: tuple[str, ...]


class BoardHeat:
    """Board temperatures (first order) and dark times of each LED, burst after burst."""

    def __init__(self, limits: LedLimits, leds: LedTable) -> None:
        boards, row_of_board = np.unique(leds.boards, return_inverse=True)
        self._limits = limits
        self._board_of_led = dict(zip(leds.ids.tolist(), row_of_board.tolist(), strict=True))
        self._rise = np.zeros(len(boards))
        self._off_since = np.full(int(leds.ids.max()) + 1, -np.inf)
        self._peak, self._t_s = 0.0, 0.0
        self._short_rest = ""

    def light(self, bursts: Iterable[Burst], move_s: float = 0.0) -> None:
        """Light bursts one after the other, after a move of the arm in the dark."""
        model = self._limits.board
        self._rise *= np.exp(-move_s / model.time_constant_s)
        self._t_s += move_s
        for burst in bursts:
            starts_s = np.concatenate([[0.0], np.cumsum(burst.table["period_us"][:-1], dtype=np.int64)]) / 1e6
            lit = np.flatnonzero(burst.table["led"] != NO_LED)
            led = burst.table["led"][lit]
            on_s = burst.table["on_us"][lit] / 1e6
            rest_s = self._t_s + starts_s[lit] - self._off_since[led]
            short = rest_s < self._limits.cooldown_ratio * on_s
            if short.any() and not self._short_rest:
                k = int(np.flatnonzero(short)[0])
                self._short_rest = (
                    f"shot {burst.view}/{burst.labels[lit[k]]}: LED {led[k]} rests {rest_s[k]:.3f} s before it is "
                    f"lit for {on_s[k]:.3f} s; it needs {self._limits.cooldown_ratio * on_s[k]:.3f} s"
                )
            self._off_since[led] = self._t_s + starts_s[lit] + on_s
            board_numbers = np.array([self._board_of_led[int(n)] for n in led], np.int64)
            last_s = np.zeros(len(self._rise))
            peak = _warm(self._rise, last_s, board_numbers, starts_s[lit] + on_s, on_s, model)
            self._peak = max(self._peak, peak)
            self._rise *= np.exp(-(burst.duration_s - last_s) / model.time_constant_s)
            self._t_s += burst.duration_s

    def heat(self) -> Heat:
        """Return the highest temperature so far, and the violations of the limits."""
        model = self._limits.board
        peak_c = model.ambient_c + self._peak
        refusals = [self._short_rest] if self._short_rest else []
        if peak_c > model.limit_c:
            refusals.append(
                f"LED boards: the hottest would reach {peak_c:.1f} C; the limit is {model.limit_c:g} C"
            )
        return Heat(peak_c, bool(refusals), tuple(refusals))


def heat_of(
    bursts_of_views: Sequence[Sequence[Burst]], moves_s: Sequence[float], limits: LedLimits, leds: LedTable
) -> Heat:
    """Return the heat of a whole schedule: bursts in the order of the visits, with the arm's move before each
    view."""
    boards = BoardHeat(limits, leds)
    for bursts, move_s in zip(bursts_of_views, moves_s, strict=True):
        boards.light(bursts, move_s)
    return boards.heat()


def _warm(
    rise: NDArray[np.float64],
    last_s: NDArray[np.float64],
    boards: NDArray[np.int64],
    ends_s: NDArray[np.float64],
    on_s: NDArray[np.float64],
    model: BoardThermal,
) -> float:
    """Add the heat of lit LEDs to `rise` [boards] in order of time, for all boards at once; return the highest
    rise."""
    peak = 0.0
    turn = np.zeros(len(boards), np.int64)
    order = np.argsort(boards, kind="stable")
    sorted_boards = boards[order]
    first = np.searchsorted(sorted_boards, sorted_boards, side="left")
    turn[order] = np.arange(len(boards)) - first
    for k in range(int(turn.max()) + 1 if len(turn) else 0):
        now = turn == k
        b = boards[now]
        rise[b] *= np.exp(-(ends_s[now] - last_s[b]) / model.time_constant_s)
        rise[b] += model.rise_c_per_j * model.led_power_w * on_s[now]
        last_s[b] = ends_s[now]
        peak = max(peak, float(rise[b].max()))
    return peak
