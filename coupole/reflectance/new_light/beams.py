"""Lights as beams: a beam is light from one direction or from one place. An area or an environment is represented
by many beams.

A beam's irradiance on a surface that faces it is its strength. If the beam comes from a place, it is the strength
times cos^k / d^2 (d in m), where cos is the cosine of the angle to the emitter's axis. Values of pictures are
radiances. In their unit, a white diffuser that faces a light of irradiance pi has the value 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.geometry import apply
from coupole.reflectance.new_light.environment import OF_RUNS, read_environment
from coupole.reflectance.new_light.light_kinds import (
    AnyLight,
    AreaLight,
    DistantLight,
    EnvironmentLight,
    LedLight,
    PointLight,
)
from coupole.reflectance.run_result import ViewSamples

Floats = NDArray[np.float64]

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True)
class Beam:
    """Light from one direction or place, base frame."""

    near: bool
    place: Floats
    """[3] mm; for distant light the unit direction to it."""
    axis: Floats
    """[3] unit vector in the direction to which the emitter points."""
    exponent: int
    """k: 0 for light that is equal in all directions, 1 for Lambert's law."""
    strength: Floats
    """[channels]"""
    density: float = 0.0
    """Density of the beams that represent an emitter: number per steradian for a distant emitter, else per m^2 of
    the emitter. 0 for an emitter without size."""


@dataclass(frozen=True)
class Emitter:
    """An area or an environment, as a mirror reflects it."""

    near: bool
    axes: Floats
    """[3, 3] rows: an area's width, height and normal; an environment's middle, left and up."""
    centre_mm: Floats
    """[3], of an area."""
    halves_mm: Floats
    """[2] half of its width and half of its height."""
    radiance: NDArray[np.float32]
    """[h, w, channels]; [1, 1, channels] of an area."""
    density: float
    """Density of its beams. For an area it is their number per m^2; for an environment it is their number per
    steradian, divided by the colours' mean radiance."""


@dataclass(frozen=True)
class Lighting:
    """All lights of a picture."""

    beams: tuple[Beam, ...]
    emitters: tuple[Emitter, ...]


def lighting_of(
    lights: Sequence[AnyLight],
    views: Sequence[ViewSamples],
    base_from_support: Floats,
    channels: int,
    samples: int,
    *,
    paper: bool,
) -> Lighting:
    """Return the beams of lights with places in the support frame; each area and environment has `samples` beams.
    LEDs are taken from the first view that was lit by them; `paper` tells that their emission is by Lucat et al.
    2025, Eq. 2.

    Raises InputError if no view was lit by an LED, or if a file has no environment.
    """
    beams: list[Beam] = []
    emitters: list[Emitter] = []
    turn = base_from_support[:3, :3]
    for light in lights:
        strength = light.rgb if channels == 3 else light.rgb[1:2]
        match light:
            case DistantLight():
                towards = turn @ np.array(light.towards)
                towards /= np.linalg.norm(towards)
                beams.append(Beam(False, towards, -towards, 0, math.pi * strength))
            case PointLight():
                place = apply(base_from_support, light.at_mm)
                beams.append(Beam(True, place, np.array([0.0, 0.0, 1.0]), 0, math.pi * strength))
            case LedLight():
                beams.append(_led(light, views, strength, paper))
            case AreaLight():
                emitters.append(area := _area(light, base_from_support, strength, samples))
                beams += _beams_of_area(area, samples)
            case EnvironmentLight():
                environment = _environment(light, turn, channels, samples)
                if environment is not None:
                    emitters.append(environment[0])
                    beams += environment[1]
    return Lighting(tuple(beams), tuple(emitters))


def _led(light: LedLight, views: Sequence[ViewSamples], strength: Floats, paper: bool) -> Beam:
    """Return the beam of an LED: E = full scale * cos / (pi d^2), as in
    coupole.reflectance.extraction.lamp_sight."""
    for view in views:
        if len(rows := np.flatnonzero(view.leds == light.number)):
            row = int(rows[0])
            full_scale = np.nan_to_num(view.full_scales[row]) * strength / math.pi
            return Beam(True, view.led_mm[row], view.led_normals[row], 2 if paper else 1, full_scale)
    led_numbers = np.unique(np.concatenate([view.leds for view in views]))
    raise InputError(
        f"the result has no LED {light.number}, only {len(led_numbers)} from {led_numbers[0]} to {led_numbers[-1]}"
    )


def _area(light: AreaLight, base_from_support: Floats, strength: Floats, samples: int) -> Emitter:
    """Return an area's emitter. Its width has the direction `across`, or is level: perpendicular to the normal and
    to z, or along x if the normal is z."""
    normal = np.array(light.normal) / np.linalg.norm(light.normal)
    across = np.cross([0.0, 0.0, 1.0], normal)
    if light.across is not None:
        across = np.array(light.across) - np.dot(light.across, normal) * normal
    across = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(across) < 1e-6 else across / np.linalg.norm(across)
    axes = np.stack([across, np.cross(normal, across), normal]) @ base_from_support[:3, :3].T
    halves_mm = np.array([light.width_mm, light.height_mm or light.width_mm]) / 2.0
    density = samples / (4e-6 * float(np.prod(halves_mm)))
    radiance = strength[None, None].astype(np.float32)
    return Emitter(True, axes, apply(base_from_support, light.at_mm), halves_mm, radiance, density)


def _beams_of_area(area: Emitter, samples: int) -> list[Beam]:
    """Return the beams of an area, on a lattice of golden sections."""
    number = np.arange(samples)
    across = 2.0 * (number + 0.5) / samples - 1.0
    along = 2.0 * ((number * _GOLDEN + 0.5) % 1.0) - 1.0
    shares = np.stack([across, along], axis=1) * area.halves_mm
    strength = area.radiance[0, 0].astype(np.float64) / area.density
    return [
        Beam(True, place, area.axes[2], 1, strength, area.density)
        for place in area.centre_mm + shares @ area.axes[:2]
    ]


def _environment(
    light: EnvironmentLight, turn: Floats, channels: int, samples: int
) -> tuple[Emitter, list[Beam]] | None:
    """Return an environment's beams; None if it has no light of these channels."""
    environment = read_environment(light.file, OF_RUNS @ turn.T, light.rgb, light.turn_deg)
    if channels == 1:
        environment = replace(environment, radiance=environment.radiance[..., 1:2])
    if not environment.radiance.any():
        return None
    directions, radiances, densities = environment.sample(samples)
    beams = [
        Beam(False, direction, -direction, 0, radiance / density, float(density))
        for direction, radiance, density in zip(directions, radiances, densities, strict=True)
    ]
    nowhere = np.zeros(3)
    emitter = Emitter(
        False, environment.axes, nowhere, nowhere[:2], environment.radiance, samples / environment.total()
    )
    return emitter, beams
