"""Light from a picture of all directions: an equirectangular HDR map, photographed from a mirror ball or stitched.

Pixels are linear, with the primaries of sRGB (ITU-R BT.709) and white D65. A pixel becomes the smooth spectrum
with the pixel's colour under D65 (Jakob and Hanika, "A Low-Dimensional Function Space for Efficient Spectral
Upsampling", Computer Graphics Forum 38(2), 2019; Mitsuba's table), times the light's own white. Mitsuba draws
directions by the map's luminance, the same for all bands.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from coupole.appearance.render.bands import StepNm, around_nodes
from coupole.appearance.render.model import Model, Positive
from coupole.appearance.render.spectra import Illuminant, Power, luminous, power
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from coupole.errors import InputError

MOST_COLUMNS = 2048
"""Largest width of a map in the renderer; larger ones are reduced by means over pixels."""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Luminance of the primaries of linear sRGB (IEC 61966-2-1)."""
_D65_AT_560_NM = 100.0 / 98.8900106203
"""Scale of Mitsuba's D65, which has the luminance of 1 W/(m^2 sr nm) at all wavelengths."""
_MOST_NEGATIVE = 0.01
_PARTS = 40
"""Number of parts of a band in which D65 is averaged, as in the renderer."""


class EnvironmentMap(Model):
    """Luminance and colour by direction, from a file. Give either `white_cd_m2` or `illuminance_lux`."""

    kind: Literal["environment_map"]
    path: Path
    """Equirectangular, .hdr or .exr: twice as wide as high, up is the first row."""
    centre_azimuth_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Azimuth of the picture's middle: degrees from +y towards +x (from north towards east, if +y is north)."""
    white_cd_m2: Positive | None = None
    """Luminance of a pixel 1, 1, 1. It is 1 if pixels are in cd/m^2, and 179 by Radiance's convention."""
    illuminance_lux: Positive | None = None
    """Illuminance of a horizontal plane that receives light from the map alone."""
    spectrum: Power = Illuminant(kind="illuminant", name="D65")
    """Spectrum of a white pixel."""

    @model_validator(mode="after")
    def _one_amount(self) -> EnvironmentMap:
        if (self.white_cd_m2 is None) == (self.illuminance_lux is None):
            raise ValueError("give either `white_cd_m2` or `illuminance_lux`, and not both")
        return self

    def white_luminance_cd_m2(self, pixels: Array) -> float:
        """Return the luminance of a pixel 1, 1, 1. Raises InputError if a dark map cannot give this amount of
        light."""
        if self.white_cd_m2 is not None:
            return self.white_cd_m2
        assert self.illuminance_lux is not None
        irradiance = level_irradiance(pixels @ _LUMINANCE)
        if irradiance <= 0.0:
            raise InputError(f"{self.path}: expected light from above, found none; give `white_cd_m2`")
        return self.illuminance_lux / irradiance


def read_map(path: Path, mi: Any) -> Array:
    """Linear pixels [h, w, 3], at most `MOST_COLUMNS` wide. Raises InputError."""
    if path.suffix.lower() not in {".hdr", ".exr"}:
        raise InputError(f"{path}: expected a map .hdr or .exr, found {path.suffix or 'no suffix'}; convert it")
    if not path.is_file():
        raise InputError(f"{path}: expected an equirectangular map, found no file")
    try:
        bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
    except RuntimeError as error:
        raise InputError(f"{path}: expected a picture .hdr or .exr; {' '.join(str(error).split())}") from error
    pixels = np.array(bitmap, dtype=float)
    height, width = pixels.shape[:2]
    if width != 2 * height or height < 4:
        raise InputError(
            f"{path}: expected an equirectangular map, twice as wide as high, found {width} x {height} pixels; "
            "stitch or unwrap it to all directions"
        )
    if not np.isfinite(pixels).all():
        raise InputError(
            f"{path}: expected finite pixels, found {np.sum(~np.isfinite(pixels))} that are not finite; mend them"
        )
    negative = float((pixels < 0.0).any(axis=2).mean())
    if negative > _MOST_NEGATIVE:
        raise InputError(
            f"{path}: expected colours within sRGB, found {100 * negative:.1f} % of the pixels negative; "
            "convert the map to linear sRGB"
        )
    return _reduced_map(np.maximum(pixels, 0.0))


def _reduced_map(pixels: Array) -> Array:
    height, width = pixels.shape[:2]
    if width <= MOST_COLUMNS:
        return pixels
    for axis, (pixel_count, most_pixels) in enumerate(((height, MOST_COLUMNS // 2), (width, MOST_COLUMNS))):
        starts = np.linspace(0, pixel_count, most_pixels, endpoint=False).astype(int)
        counts = np.diff([*starts, pixel_count]).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        pixels = np.add.reduceat(pixels, starts, axis=axis) / counts
    return pixels


def level_irradiance(radiance: Array) -> float:
    """Return the irradiance of a plane that faces up, from radiance [h, w] of an equirectangular map."""
    height, width = radiance.shape
    above = np.minimum(np.linspace(0.0, np.pi, height + 1), 0.5 * np.pi)
    return float(radiance.sum(axis=1) @ np.diff(np.sin(above) ** 2) * (np.pi / width))


def factor(source: EnvironmentMap, folder: Path, step_nm: StepNm) -> Array:
    """[81] factors from the light as it is rendered, with white D65, to the map's own light. Raises InputError."""
    white = around_nodes(power(source.spectrum, folder), step_nm)
    if not np.all(white > 0.0):
        raise InputError(
            f"{source.path}: expected a light for the map with some power in all bands, found "
            f"{np.count_nonzero(white <= 0.0)} bands without power; choose another `spectrum`"
        )
    fine_nm = WAVELENGTHS_NM[:, None] + step_nm * ((np.arange(_PARTS) + 0.5) / _PARTS - 0.5)
    d65 = np.interp(fine_nm, WAVELENGTHS_NM, light.illuminant("D65")).mean(axis=1)
    return np.asarray((white / luminous(white)) / (d65 / luminous(light.illuminant("D65"))))


def emitter(source: EnvironmentMap, folder: Path, mi: Any) -> Any:
    """The map for Mitsuba, under D65; loaded once for all groups of bands."""
    pixels = read_map(folder / source.path, mi)
    d65 = light.illuminant("D65") * (_D65_AT_560_NM / light.illuminant("D65")[WAVELENGTHS_NM == 560.0])
    return mi.load_dict(
        {
            "type": "envmap",
            "bitmap": mi.Bitmap(_refined_map(pixels).astype(np.float32)),
            "scale": source.white_luminance_cd_m2(pixels) / float(luminous(d65)),
            "to_world": _scene_from_map(source.centre_azimuth_deg, mi),
        }
    )


def _refined_map(pixels: Array) -> Array:
    """Return the map at Mitsuba's nodes. Mitsuba's rows go from zenith to nadir; the pixels of the map are half a
    step from the poles.

    Mitsuba interpolates brightness and colour separately. So the nodes are made dense, and are interpolated here
    by the product of both.
    """
    height, width = pixels.shape[:2]
    finer = max(1, MOST_COLUMNS // 2 // width)
    rows = np.linspace(0.0, height, 2 * max(1, finer // 2) * height + 1) - 0.5
    columns = (np.arange(finer * width) + 0.5) / finer - 0.5
    return _between(_between(pixels, np.clip(rows, 0.0, height - 1.0), 0), columns, 1)


def _between(pixels: Array, places: Array, axis: int) -> Array:
    """Interpolate linearly along a periodic axis."""
    first = np.floor(places).astype(int)
    part = np.reshape(places - first, (-1, 1, 1) if axis == 0 else (1, -1, 1))
    count = pixels.shape[axis]
    lower, upper = np.take(pixels, first % count, axis), np.take(pixels, (first + 1) % count, axis)
    return np.asarray(lower + part * (upper - lower))


def _scene_from_map(centre_azimuth_deg: float, mi: Any) -> Any:
    """Return the map's frame: Mitsuba's map has its middle at +z, up at +y, and the right of the middle towards
    -x."""
    east, north = np.sin(np.radians(centre_azimuth_deg)), np.cos(np.radians(centre_azimuth_deg))
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = [-north, east, 0.0], [0.0, 0.0, 1.0], [east, north, 0.0]
    return mi.ScalarTransform4f(matrix)
