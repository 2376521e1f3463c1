"""Lights of a scene file, in photometric units: spectra give the shape, lm, lux or cd/m^2 the scale."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from coupole.appearance.render.bands import Description
from coupole.appearance.render.led_squares import read_leds
from coupole.appearance.render.model import Model, Positive, Vector, unit
from coupole.appearance.render.spectra import DomeLed, Power, power, scaled
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

LED_SIDE_MM = 7.0
_FAR_MM = 1e5
"""Distance of the sun's disk in mm, limited by single precision."""
_MM2 = 1e-6


class Leds(Model):
    """LEDs of the dome, by their ids in its table: squares of 7 mm, Lambertian, with the table's flux."""

    kind: Literal["leds"]
    dome: Path
    ids: Annotated[tuple[int, ...], Field(min_length=1)]
    spectrum: Power = DomeLed(kind="dome_led")


class Distant(Model):
    """Parallel light, or a disk of some apparent width such as the sun (0.53 degrees)."""

    kind: Literal["distant"]
    direction: Vector
    """In which light travels."""
    illuminance_lux: Positive
    """On a surface that faces it."""
    width_deg: Annotated[float, Field(ge=0, le=60)] = 0.0
    spectrum: Power


class Area(Model):
    """A rectangle that emits towards its target."""

    kind: Literal["area"]
    position_mm: Vector
    target_mm: Vector
    width_mm: Positive
    height_mm: Positive
    luminance_cd_m2: Positive
    spectrum: Power


class Environment(Model):
    """The same luminance from all directions."""

    kind: Literal["environment"]
    luminance_cd_m2: Positive
    spectrum: Power


Light = Annotated[Leds | Distant | Area | Environment, Field(discriminator="kind")]


def emitters(light: Light, folder: Path, mi: Any) -> list[Description]:
    """The light for Mitsuba, W/(m^2 sr nm); paths are relative to `folder`. Raises InputError."""
    shape = power(light.spectrum, folder)
    if isinstance(light, Environment):
        return [{"type": "constant", "radiance": scaled(shape, light.luminance_cd_m2)}]
    if isinstance(light, Area):
        return [
            _rectangle(
                mi,
                light.position_mm,
                light.target_mm,
                (light.width_mm, light.height_mm),
                scaled(shape, light.luminance_cd_m2),
            )
        ]
    if isinstance(light, Distant):
        return [_distant(light, scaled(shape, light.illuminance_lux), mi)]
    return _leds(light, shape, folder, mi)


def _distant(light: Distant, irradiance: Array, mi: Any) -> Description:
    way = unit(light.direction)
    if light.width_deg == 0.0:
        return {"type": "directional", "direction": list(way), "irradiance": irradiance}
    sine = np.sin(np.radians(light.width_deg / 2))
    away = [-_FAR_MM * component for component in way]
    radius_mm = _FAR_MM * np.tan(np.radians(light.width_deg / 2))
    return {
        "type": "disk",
        "to_world": _look(mi, away, [0.0, 0.0, 0.0]) @ mi.ScalarTransform4f().scale([radius_mm, radius_mm, 1.0]),
        "emitter": {"type": "area", "radiance": irradiance / (np.pi * sine**2)},
    }


def _leds(light: Leds, shape: Array, folder: Path, mi: Any) -> list[Description]:
    path = folder / light.dome
    table = read_leds(path)
    rows = {int(led): row for row, led in enumerate(table.ids)}
    if missing := [led for led in light.ids if led not in rows]:
        raise InputError(f"{path}: expected LEDs {missing}, which the table does not have; choose others")
    area_m2 = LED_SIDE_MM**2 * _MM2
    squares = []
    for row in (rows[led] for led in light.ids):
        position, normal = table.positions_mm[row], table.normals[row]
        radiance = scaled(shape, float(table.flux_lm[row]) / (np.pi * area_m2))
        squares.append(_rectangle(mi, position, position + 100.0 * normal, (LED_SIDE_MM, LED_SIDE_MM), radiance))
    return squares


def _rectangle(mi: Any, position: Any, target: Any, size_mm: tuple[float, float], radiance: Array) -> Description:
    half = [0.5 * size_mm[0], 0.5 * size_mm[1], 1.0]
    return {
        "type": "rectangle",
        "to_world": _look(mi, position, target) @ mi.ScalarTransform4f().scale(half),
        "emitter": {"type": "area", "radiance": radiance},
    }


def _look(mi: Any, origin: Any, target: Any) -> Any:
    """A frame at `origin` whose z axis points to `target`."""
    start, end = (np.asarray(point, dtype=float) for point in (origin, target))
    steep = np.linalg.norm(np.cross(end - start, [0.0, 0.0, 1.0])) < 1e-6 * np.linalg.norm(end - start)
    up = [0.0, 1.0, 0.0] if steep else [0.0, 0.0, 1.0]
    return mi.ScalarTransform4f().look_at(origin=list(start), target=list(end), up=up)
