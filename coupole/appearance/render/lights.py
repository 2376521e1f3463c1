"""Lights of a scene file, in photometric units: the spectrum has any scale, and lm, lux or cd/m^2 give the
amount."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AwareDatetime, Field, model_validator

from coupole.appearance.render.bands import Description, StepNm, around_nodes
from coupole.appearance.render.candle import Candle
from coupole.appearance.render.environment_map import EnvironmentMap, emitter, factor
from coupole.appearance.render.led_squares import read_leds
from coupole.appearance.render.model import Model, Positive, Share, Vector, unit
from coupole.appearance.render.spectra import DomeLed, LowSun, Power, Values, luminous, power
from coupole.appearance.spectra import sun
from coupole.appearance.spectra.grid import BANDS, Array
from coupole.appearance.spectra.light_series import read_series
from coupole.errors import InputError

LED_SIDE_MM = 7.0
_FAR_MM, _FAR_REACHES = 1e5, 100.0
"""Least distance of the sun's disk, in mm and in sizes of the scene; it is limited by single precision."""
_MM2 = 1e-6
_SAME_HEIGHT_DEG = 1.0


class Leds(Model):
    """LEDs of the dome, by their ids in its table: squares of 7 mm, Lambertian, with the table's flux."""

    kind: Literal["leds"]
    dome: Path
    ids: Annotated[tuple[int, ...], Field(min_length=1)]
    spectrum: Power = DomeLed(kind="dome_led")


class Distant(Model):
    """Parallel light, or light from a disk with an apparent width, such as the sun (0.53 degrees)."""

    kind: Literal["distant"]
    direction: Vector
    """Direction in which light travels."""
    illuminance_lux: Positive
    """Illuminance of a surface that faces the light."""
    width_deg: Annotated[float, Field(ge=0, le=60)] = 0.0
    spectrum: Power

    @model_validator(mode="after")
    def _one_sun(self) -> Distant:
        height_deg = float(np.degrees(np.arcsin(-unit(self.direction)[2])))
        if isinstance(self.spectrum, LowSun) and abs(height_deg - self.spectrum.elevation_deg) > _SAME_HEIGHT_DEG:
            raise ValueError(
                f"light comes from a height of {height_deg:.1f} degrees, but its spectrum belongs to a sun at "
                f"{self.spectrum.elevation_deg:g} degrees: give both the same height, or take a light "
                "of kind `daylight`"
            )
        return self


class Area(Model):
    """A rectangle that emits light towards its target."""

    kind: Literal["area"]
    position_mm: Vector
    target_mm: Vector
    width_mm: Positive
    height_mm: Positive
    luminance_cd_m2: Positive
    spectrum: Power


class Environment(Model):
    """An environment with the same luminance in all directions."""

    kind: Literal["environment"]
    luminance_cd_m2: Positive
    spectrum: Power


PlainLight = Leds | Distant | Area | Environment | EnvironmentMap | Candle


class Daylight(Model):
    """Sun and clear sky at a time and place. Direction, spectrum and amount of light are computed
    (`spectra.sun`)."""

    kind: Literal["daylight"]
    when: AwareDatetime
    """ISO 8601, with the offset from UTC."""
    latitude_deg: Annotated[float, Field(ge=-90, le=90)]
    """Latitude, positive to the north."""
    longitude_deg: Annotated[float, Field(ge=-180, le=180)]
    """Longitude, positive to the east."""
    altitude_m: Annotated[float, Field(ge=-430, le=9000)] = 0.0
    y_azimuth_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Azimuth of the scene's +y: degrees from north towards east."""
    sky: bool = True
    """True for light of the sky, evenly from all directions; if False, only the sun shines."""
    aerosol_depth_500nm: Annotated[float, Field(ge=0, le=2)] = 0.1
    water_cm: Annotated[float, Field(gt=0, le=10)] = 1.42
    ozone_atm_cm: Annotated[float, Field(ge=0, le=0.7)] = 0.344
    ground_albedo: Share = 0.2
    series: Path | None = None
    """Measured spectra of the sun at several times (`spectra.light_series`), instead of the computed ones."""

    def lights(self, folder: Path) -> tuple[PlainLight, ...]:
        """Return the sun's disk, and the sky. Raises InputError if the sun is down, or if the series does not
        cover the time."""
        place = sun.place(self.when, self.latitude_deg, self.longitude_deg, self.altitude_m)
        air = sun.Air(self.aerosol_depth_500nm, self.water_cm, self.ozone_atm_cm, self.ground_albedo)
        clear_sky = sun.clear_sky(place, air)
        direct = clear_sky.sun if self.series is None else read_series(folder / self.series).at(self.when)
        x, y, z = (float(part) for part in place.direction(self.y_azimuth_deg))
        disk = Distant(
            kind="distant",
            direction=(x, y, z),
            illuminance_lux=float(luminous(direct)),
            width_deg=sun.WIDTH_DEG,
            spectrum=Values(
                kind="values", name=f"sun of {self.when:%Y-%m-%d %H:%M}", values=tuple(direct.tolist())
            ),
        )
        if not self.sky:
            return (disk,)
        blue = Values(
            kind="values", name=f"sky of {self.when:%Y-%m-%d %H:%M}", values=tuple(clear_sky.sky.tolist())
        )
        return (
            disk,
            Environment(kind="environment", luminance_cd_m2=float(luminous(clear_sky.sky) / np.pi), spectrum=blue),
        )


Light = Annotated[PlainLight | Daylight, Field(discriminator="kind")]


def plain(lights: Iterable[Light], folder: Path) -> tuple[PlainLight, ...]:
    """Return the lights, with daylight as sun and sky. Raises InputError, also if there are two environments."""
    plain_lights = tuple(
        part for light in lights for part in (light.lights(folder) if isinstance(light, Daylight) else (light,))
    )
    around = [light.kind for light in plain_lights if isinstance(light, Environment | EnvironmentMap)]
    if len(around) > 1:
        raise InputError(
            f"lights: expected one light from all directions, found {len(around)} ({', '.join(around)}); keep "
            "one of them, or write `sky: false` in `daylight`"
        )
    return plain_lights


def radiance_unit(lights: Iterable[PlainLight], folder: Path, step_nm: StepNm) -> Array:
    """[81] radiance that has the value 1 in the renderer, in which a map's white is always D65. Raises
    InputError."""
    maps = [light for light in lights if isinstance(light, EnvironmentMap)]
    return factor(maps[0], folder, step_nm) if maps else np.ones(BANDS)


@dataclass(frozen=True)
class Setting:
    """Quantities that lights depend on."""

    folder: Path
    """Folder at which relative paths start."""
    step_nm: StepNm
    radiance_unit: Array
    """[81] W/(m^2 sr nm)."""
    reach_mm: float
    """Distance from the origin to the farthest point of the scene's objects."""


def emitters(light: PlainLight, setting: Setting, mi: Any) -> list[Description]:
    """Return the light for Mitsuba; for a candle, the emission of its flame. Raises InputError."""
    folder = setting.folder
    if isinstance(light, EnvironmentMap):
        return [emitter(light, folder, mi)]
    spectral_power = power(light.spectrum, folder)
    shape = around_nodes(spectral_power, setting.step_nm) / luminous(spectral_power) / setting.radiance_unit
    if isinstance(light, Candle):
        return [{"type": "area", "radiance": shape * light.luminance_cd_m2()}]
    if isinstance(light, Environment):
        return [{"type": "constant", "radiance": shape * light.luminance_cd_m2}]
    if isinstance(light, Area):
        return [
            _rectangle(
                mi,
                light.position_mm,
                light.target_mm,
                (light.width_mm, light.height_mm),
                shape * light.luminance_cd_m2,
            )
        ]
    if isinstance(light, Distant):
        return [_distant(light, shape * light.illuminance_lux, setting.reach_mm, mi)]
    return _leds(light, shape, folder, mi)


def _distant(light: Distant, irradiance: Array, reach_mm: float, mi: Any) -> Description:
    way = unit(light.direction)
    if light.width_deg == 0.0:
        return {"type": "directional", "direction": list(way), "irradiance": irradiance}
    sine = np.sin(np.radians(light.width_deg / 2))
    far_mm = max(_FAR_MM, _FAR_REACHES * reach_mm)
    away = [-far_mm * component for component in way]
    radius_mm = far_mm * np.tan(np.radians(light.width_deg / 2))
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
        radiance = shape * float(table.flux_lm[row]) / (np.pi * area_m2)
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
    """Return a frame at `origin` with its z axis towards `target`."""
    start, end = (np.asarray(point, dtype=float) for point in (origin, target))
    steep = np.linalg.norm(np.cross(end - start, [0.0, 0.0, 1.0])) < 1e-6 * np.linalg.norm(end - start)
    up = [0.0, 1.0, 0.0] if steep else [0.0, 0.0, 1.0]
    return mi.ScalarTransform4f().look_at(origin=list(start), target=list(end), up=up)
