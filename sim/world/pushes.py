"""Displacement of a stand-in's arm from its commanded axes by pushes, which may spring back."""

from __future__ import annotations

from collections.abc import Sequence

from sim.world.reactor import Reactor, Timer

_NOWHERE: tuple[float, ...] = (0.0,) * 6


class Pushes:
    """The sum of all pushes, `deg` for each axis."""

    def __init__(self, reactor: Reactor) -> None:
        self.deg = _NOWHERE
        self._reactor = reactor
        self._springs: list[Timer] = []

    def push(self, joints_deg: Sequence[float], seconds: float | None) -> None:
        """Displace by six angles: permanently, or until the arm springs back after `seconds`."""
        self.deg = tuple(map(float.__add__, self.deg, map(float, joints_deg)))
        if seconds is not None:
            back_deg = [-angle for angle in joints_deg]
            self._springs.append(self._reactor.after(seconds, lambda: self.push(back_deg, None)))

    def forget(self) -> None:
        """Reset the displacement to zero, and cancel all springing back."""
        self.deg = _NOWHERE
        for spring in self._springs:
            spring.cancel()
        self._springs.clear()
