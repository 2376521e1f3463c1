"""Record of lit LEDs and panels over time, from which exposures are integrated."""

from __future__ import annotations

from collections import Counter, deque

_KEEP_NS = 10_000_000_000


class Lighting:
    """Intervals of world time in which LEDs and panels were lit."""

    def __init__(self) -> None:
        self._lit: deque[tuple[int, int, int, float]] = deque()
        self._panels_since_ns: dict[int, int] = {}
        self._led_ns: Counter[int] = Counter()
        """Time for which each LED was lit, without the intervals that are still in `_lit`."""
        self._panel_ns: Counter[int] = Counter()

    def light(self, led: int, t_on_ns: int, t_off_ns: int, flux: float = 1.0) -> None:
        """LED `led` is switched on at `t_on_ns` and off at `t_off_ns` unless `dark` comes first, with `flux` times
        its tabulated flux."""
        while self._lit and self._lit[0][2] < t_on_ns - _KEEP_NS:
            led_before, on, off, _ = self._lit.popleft()
            self._led_ns[led_before] += off - on
        self._lit.append((led, t_on_ns, t_off_ns, flux))

    def dark(self, t_ns: int) -> None:
        """All LEDs are switched off now."""
        self._lit = deque((led, on, min(off, t_ns), flux) for led, on, off, flux in self._lit if on < t_ns)

    def darken_one(self, led: int, t_ns: int) -> None:
        """One LED is switched off now."""
        self._lit = deque(
            (lit_led, on, min(off, t_ns) if lit_led == led else off, flux) for lit_led, on, off, flux in self._lit
        )

    def panel(self, panel: int, on: bool, t_ns: int) -> None:
        if on:
            self._panels_since_ns.setdefault(panel, t_ns)
        else:
            since_ns = self._panels_since_ns.pop(panel, t_ns)
            self._panel_ns[panel] += t_ns - since_ns

    def shining(self, t_ns: int) -> list[int]:
        """LEDs that are lit at `t_ns`."""
        return [led for led, on, off, _ in self._lit if on <= t_ns < off]

    def panels(self, t_ns: int) -> list[int]:
        """Panels that are lit at `t_ns`."""
        return [panel for panel, since in self._panels_since_ns.items() if since <= t_ns]

    def given_s(self, t_ns: int) -> tuple[dict[int, float], dict[int, float]]:
        """Seconds for which each LED and each panel has been lit until `t_ns`, since the world began."""
        leds, panels = self._led_ns.copy(), self._panel_ns.copy()
        for led, on, off, _ in self._lit:
            leds[led] += max(0, min(off, t_ns) - on)
        for panel, since_ns in self._panels_since_ns.items():
            panels[panel] += t_ns - since_ns
        return {led: ns / 1e9 for led, ns in leds.items()}, {panel: ns / 1e9 for panel, ns in panels.items()}

    def exposure_s(self, start_ns: int, end_ns: int) -> dict[int, float]:
        """Seconds for which each LED was lit between two times, at its tabulated flux; unlit LEDs are left out."""
        seconds: dict[int, float] = {}
        for led, on, off, flux in reversed(self._lit):
            overlap_ns = min(off, end_ns) - max(on, start_ns)
            if overlap_ns > 0:
                seconds[led] = seconds.get(led, 0.0) + flux * overlap_ns / 1e9
        return seconds
