"""Disturbances of a measurement that frames show: lamps, drifting LEDs, bumps, smudges, gain, hands.

The world keeps them in a `Disturber`. Each exposure has its own copy of them (`Disturbance`), so a picture that is
rendered later is still the picture of its moment. This code shares nothing with the code that looks for
disturbances.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim.world import faults as script

Electrons = NDArray[np.float32]
Millimetres = tuple[float, float, float]
_VEIL = 0.3
"""Share of a smudge's lost light that the smudge spreads evenly over its place."""
_SOFT = 0.15
"""Width of the edge of a thing in the field, out of focus, as a share of its radius."""


@dataclass(frozen=True)
class Spot:
    """A round place in the picture; lengths are shares of the picture's width."""

    x: float
    y: float
    radius: float
    share: float
    """Transmission of a smudge in its middle, or brightness of a thing relative to the mean of the picture."""

    def radius_share(self, shape: tuple[int, int]) -> Electrons:
        """[h, w] distance of each pixel from the middle over the radius."""
        height, width = shape
        rows, columns = np.ogrid[:height, :width]
        away = np.hypot((columns + 0.5) / width - self.x, (rows + 0.5 - height / 2) / width + 0.5 - self.y)
        return np.asarray(away / self.radius, np.float32)


@dataclass(frozen=True)
class Disturbance:
    """Disturbances of one exposure."""

    lamp_lux: float = 0.0
    """Room light on everything that the camera sees, from all directions."""
    gain: float = 1.0
    camera_mm: Millimetres = (0.0, 0.0, 0.0)
    """Displacement of the camera in the base frame."""
    object_mm: Millimetres = (0.0, 0.0, 0.0)
    """Displacement of the plan's object in the support frame."""
    smudges: tuple[Spot, ...] = ()
    things: tuple[Spot, ...] = ()
    """Things between camera and object."""

    @property
    def covers(self) -> bool:
        """True if something is in the way of the light."""
        return bool(self.smudges or self.things)

    def cover_up(self, mean_e: Electrons) -> Electrons:
        """Return mean electrons [h, w] behind the things in the way."""
        level = np.float32(mean_e.mean())
        for smudge in self.smudges:
            loss = np.float32(1.0 - smudge.share) * np.exp(-0.5 * (2.0 * smudge.radius_share(mean_e.shape)) ** 2)
            mean_e = mean_e * (1.0 - loss) + np.float32(_VEIL) * loss * level
        for thing in self.things:
            cover = np.clip((1.0 - thing.radius_share(mean_e.shape)) / np.float32(_SOFT) + 0.5, 0.0, 1.0)
            mean_e = mean_e * (1.0 - cover) + cover * np.float32(thing.share) * level
        return np.asarray(mean_e, np.float32)


CALM = Disturbance()
OF_EACH_KIND = Disturbance(lamp_lux=1.0, smudges=(Spot(0.5, 0.5, 0.1, 0.9),))
"""A disturbance with one of each kind, which compiles their code before the first frame is due. Calm pictures may
not need this code."""
Disturbing = (
    script.RoomLamp
    | script.Warming
    | script.DimLed
    | script.Bump
    | script.Smudge
    | script.ExposureStep
    | script.Hand
)


class Disturber:
    """The disturbances of a world. Times are world times, ns."""

    def __init__(self) -> None:
        self._lasting = CALM
        self._hands: list[tuple[int, script.Hand]] = []
        self._warming: list[tuple[int, script.Warming]] = []
        self._dim: dict[int, float] = {}

    def happen(self, fault: Disturbing, now_ns: int) -> None:
        """Let a fault happen now."""
        lasting = self._lasting
        match fault:
            case script.RoomLamp():
                self._lasting = replace(lasting, lamp_lux=fault.lux)
            case script.ExposureStep():
                self._lasting = replace(lasting, gain=lasting.gain * fault.factor)
            case script.Bump(what="camera"):
                self._lasting = replace(lasting, camera_mm=fault.mm)
            case script.Bump():
                self._lasting = replace(lasting, object_mm=fault.mm)
            case script.Smudge():
                spot = Spot(*fault.at, fault.radius, fault.transmission)
                self._lasting = replace(lasting, smudges=(*lasting.smudges, spot))
            case script.Hand():
                self._hands.append((now_ns, fault))
            case script.Warming():
                self._warming.append((now_ns, fault))
            case script.DimLed():
                self._dim[fault.led] = 1.0 - fault.loss

    def at(self, now_ns: int) -> Disturbance:
        """Return the disturbance of an exposure at that time."""
        things = []
        for since_ns, hand in self._hands:
            age_s = (now_ns - since_ns) * 1e-9
            if 0.0 <= age_s < hand.seconds:
                away = hand.sway * math.sin(2.0 * math.pi * age_s / max(hand.seconds, 1e-9))
                things.append(Spot(hand.at[0] + away, hand.at[1] + 0.5 * away, hand.radius, hand.brightness))
        return replace(self._lasting, things=tuple(things)) if things else self._lasting

    def flux(self, led: int, now_ns: int) -> float:
        """Return the flux of an LED relative to its flux without disturbances."""
        factor = self._dim.get(led, 1.0)
        for since_ns, warming in self._warming:
            factor *= max(0.0, 1.0 + warming.per_s * max(0.0, (now_ns - since_ns) * 1e-9))
        return factor
