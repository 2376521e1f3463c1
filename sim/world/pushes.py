"""What something pushed a stand-in's arm aside by, off the axes that are commanded; some of it springs back."""

from __future__ import annotations

from collections.abc import Sequence

from sim.world.reactor import Reactor, Timer

_NOWHERE: tuple[float, ...] = (0.0,) * 6


class Pushes:
    """The sum of all pushes, `deg` of each axis."""

    def __init__(self, reactor: Reactor) -> None:
        self.deg = _NOWHERE
        self._reactor = reactor
        self._springs: list[Timer] = []

    def push(self, joints_deg: Sequence[float], seconds: float | None) -> None:
        """Push by six angles: for good, or until the arm springs back after `seconds`."""
        self.deg = tuple(map(float.__add__, self.deg, map(float, joints_deg)))
        if seconds is not None:
            back_deg = [-angle for angle in joints_deg]
            self._springs.append(self._reactor.after(seconds, lambda: self.push(back_deg, None)))

    def forget(self) -> None:
        """From now on the arm belongs where it stands: nothing springs back."""
        self.deg = _NOWHERE
        for spring in self._springs:
            spring.cancel()
        self._springs.clear()
