"""Initial state of a scene's page: the scene's first camera, and its lights in the form that the page has."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, assert_never

import numpy as np

from coupole.appearance.render.candle import Candle
from coupole.appearance.render.environment_map import EnvironmentMap
from coupole.appearance.render.led_squares import read_leds
from coupole.appearance.render.lights import Area, Distant, Environment, Leds, PlainLight
from coupole.appearance.render.scene_file import Camera, PlainScene
from coupole.appearance.render.spectra import BlackBody, DomeLed, Illuminant, LowSun, Power, Source, Values, power
from coupole.appearance.spectra import light as known_light
from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.white_led import LedSpectrum, spectral_power
from coupole.errors import InputError

MOST_LIGHTS = 10
_WIDEST_DEG = 30.0
"""Greatest radius of a light's disk on a page, degrees."""


@dataclass(frozen=True)
class _Lamp:
    """A distant light, as seen from the target of the first camera."""

    to_light: Array
    illuminance_lux: float
    """Illuminance on a surface that faces the light."""
    radius_deg: float
    spectrum: Power


def illuminants(scene: PlainScene, folder: Path) -> dict[str, Array]:
    """Spectral power [81] by name: first the scene's own, then those that every page offers."""
    powers = {spectrum_name(light.spectrum): power(light.spectrum, folder) for light in scene.lights}
    offers = {name: known_light.illuminant(name) for name in ("D65", "A")}
    offers |= {"LED of the dome": spectral_power(LedSpectrum())}
    offers |= {name: known_light.led(name) for name in ("LED-B1", "LED-B3")}
    return powers | {name: curve for name, curve in offers.items() if name not in powers}


def spectrum_name(spectrum: Power) -> str:
    """Return the page's name for a spectrum."""
    match spectrum:
        case Illuminant() | Source() | Values():
            return spectrum.name
        case DomeLed():
            return "LED of the dome"
        case BlackBody():
            return f"{spectrum.kelvin:g} K"
        case LowSun():
            return f"sun {spectrum.elevation_deg:g} degrees high, haze {spectrum.haze:g}"
        case _:
            column = "" if spectrum.column is None else f", column {spectrum.column}"
            return f"{spectrum.path.name}{column}"


def start_of(scene: PlainScene, folder: Path) -> dict[str, Any]:
    """Return the page's initial state. Raises InputError if the scene has more lamps than the page."""
    target = np.asarray(scene.cameras[0].target_mm)
    lamps = [lamp for light in scene.lights for lamp in _lamps(light, folder, target)]
    if len(lamps) > MOST_LIGHTS:
        raise InputError(
            f"{scene.name}: has {len(lamps)} lamps; a page can have at most {MOST_LIGHTS}; leave some out"
        )
    around = [light for light in scene.lights if isinstance(light, Environment)]
    white_cd_m2 = scene.display.white_cd_m2 or max(
        [lamp.illuminance_lux / math.pi for lamp in lamps] + [light.luminance_cd_m2 for light in around]
    )
    lights = [_lamp_entry(lamp, white_cd_m2) for lamp in lamps] or [_dark(spectrum_name(around[0].spectrum))]
    is_used_to_first = lights[0]["illuminant"] == spectrum_name(scene.lights[0].spectrum)
    sky = sum(light.luminance_cd_m2 for light in around) / white_cd_m2
    return {
        "lights": lights,
        "sky": min(sky, 100.0),
        "skyIlluminant": spectrum_name(next(iter(around or scene.lights)).spectrum),
        "white": 1.0 if scene.display.white_cd_m2 else 0.0,
        "camera": _camera(scene.cameras[0]),
        "adapted": scene.display.adaptation != "none" and is_used_to_first,
    }


def _lamps(light: PlainLight, folder: Path, target: Array) -> Iterator[_Lamp]:
    match light:
        case Environment():
            return
        case Distant():
            yield _Lamp(-np.asarray(light.direction), light.illuminance_lux, 0.5 * light.width_deg, light.spectrum)
        case Area():
            way = np.asarray(light.position_mm) - target
            facing = np.asarray(light.target_mm) - np.asarray(light.position_mm)
            area_mm2 = light.width_mm * light.height_mm
            yield _square(way, facing, area_mm2, light.luminance_cd_m2 * area_mm2, light.spectrum)
        case Leds():
            table = read_leds(folder / light.dome)
            rows = {int(led): row for row, led in enumerate(table.ids)}
            if missing := [led for led in light.ids if led not in rows]:
                raise InputError(f"{folder / light.dome}: has no LEDs {missing}; choose others")
            for row in (rows[led] for led in light.ids):
                intensity_cd = float(table.flux_lm[row]) / math.pi
                way = table.positions_mm[row] - target
                yield _square(way, table.normals[row], 49.0, intensity_cd * 1e6, light.spectrum)
        case EnvironmentMap():
            raise InputError(
                f"{light.path}: a page has no light from a map; take `environment` of the same mean luminance"
            )
        case Candle():
            raise InputError("a page has no candles; take an `area` of a few cm², or `distant`")
        case _:
            assert_never(light)


def _square(way: Array, facing: Array, area_mm2: float, intensity_cd_mm2_m2: float, spectrum: Power) -> _Lamp:
    """A Lambertian square, with its luminance times area in cd/m^2 mm^2, as a disk of the same solid angle."""
    apart_mm = float(np.linalg.norm(way))
    cosine = max(float(-(way @ facing) / (apart_mm * np.linalg.norm(facing))), 0.0)
    radius_deg = math.degrees(math.atan(math.sqrt(area_mm2 * cosine / math.pi) / apart_mm))
    return _Lamp(way, intensity_cd_mm2_m2 * cosine / apart_mm**2, radius_deg, spectrum)


def _lamp_entry(lamp: _Lamp, white_cd_m2: float) -> dict[str, Any]:
    return _dark(spectrum_name(lamp.spectrum)) | {
        "direction": (lamp.to_light / np.linalg.norm(lamp.to_light)).tolist(),
        "strength": min(lamp.illuminance_lux / (math.pi * white_cd_m2), 100.0),
        "softness": min(lamp.radius_deg, _WIDEST_DEG),
    }


def _dark(illuminant: str) -> dict[str, Any]:
    """A light of no strength."""
    return {
        "direction": [0.0, 0.0, 1.0], "strength": 0.0, "softness": 1.0,
        "colour": "#ffffff", "kelvin": 6500, "illuminant": illuminant,
    }  # fmt: skip


def _camera(camera: Camera) -> dict[str, Any]:
    """The page's camera, with z up. Its `field` spans a window's shorter side and equals the scene's field across
    the longer side."""
    back = np.asarray(camera.position_mm) - np.asarray(camera.target_mm)
    distance = float(np.linalg.norm(back))
    half = math.tan(math.radians(camera.field_deg() / 2.0))
    longer = max(camera.width_px, camera.height_px) / camera.width_px
    steep = math.hypot(back[0], back[1]) < 1e-6 * distance
    return {
        "target": list(camera.target_mm),
        "azimuth": -90.0 if steep else math.degrees(math.atan2(back[1], back[0])),
        "height": min(max(math.degrees(math.asin(back[2] / distance)), -89.9), 89.9),
        "distance": distance,
        "field": 2.0 * math.degrees(math.atan(half * longer)),
    }
