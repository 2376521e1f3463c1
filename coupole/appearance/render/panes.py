"""Coloured glass of windows: thin sheets that filter light and let it pass straight on.

Transmittance along the normal is exact, with all reflections between the two faces. At other angles the faces
follow Fresnel, and the absorption stays as along the normal (at 45 degrees the path in glass is 1.13 times as
long).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from coupole.appearance.optics import fresnel
from coupole.appearance.render.bands import Description
from coupole.appearance.render.model import Index, Model, Positive
from coupole.appearance.spectra import measured, resampling
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from coupole.errors import InputError

PLUGIN = "thindielectric"
"""Name of Mitsuba's plugin."""
_SHAPES: dict[str, tuple[tuple[float, float, float], ...]] = {
    "cobalt_blue_shape": ((1.0, 540.0, 22.0), (1.35, 592.0, 22.0), (1.25, 645.0, 25.0)),
    "copper_ruby_shape": ((1.6, 562.0, 16.0), (1.5, 480.0, 70.0), (0.8, 395.0, 35.0)),
    "silver_yellow_shape": ((1.9, 410.0, 42.0),),
    "manganese_purple_shape": ((1.2, 495.0, 45.0), (0.25, 570.0, 45.0)),
    "copper_green_shape": ((1.7, 790.0, 105.0), (1.5, 380.0, 42.0)),
}
"""Assumed optical density, centre and width in nm of absorption bands. The centres are those of colourants of
glass (cobalt in tetrahedra, copper and silver colloids, trivalent manganese, bivalent copper). The densities are
not measured."""


class Transmitted(Model):
    """Transmittance of a sheet, measured along its normal, including reflections at its faces."""

    kind: Literal["transmittance"]
    path: Path
    column: int | None = None


class Absorbed(Model):
    """A sheet of glass, given by its coefficient of absorption in 1/mm (natural logarithm) and its thickness."""

    kind: Literal["absorption"]
    path: Path
    column: int | None = None
    thickness_mm: Positive


class AssumedGlass(Model):
    """An assumed spectrum, with `density` times its usual depth of colour."""

    kind: Literal["shape"]
    name: Literal[
        "cobalt_blue_shape",
        "copper_ruby_shape",
        "silver_yellow_shape",
        "manganese_purple_shape",
        "copper_green_shape",
    ]
    density: Annotated[float, Field(gt=0, le=10)] = 1.0


class Clear(Model):
    """Glass that absorbs nothing."""

    kind: Literal["clear"]


Colour = Annotated[Transmitted | Absorbed | AssumedGlass | Clear, Field(discriminator="kind")]


class Pane(Model):
    """A sheet of glass."""

    kind: Literal["pane"] = "pane"
    colour: Colour
    index: Index = 1.52


def passage(pane: Pane, folder: Path) -> Array:
    """[81] share of light that remains after one passage through the glass itself, along the normal. Raises
    InputError."""
    colour = pane.colour
    if isinstance(colour, Clear):
        return np.ones_like(WAVELENGTHS_NM)
    if isinstance(colour, AssumedGlass):
        bands = sum(
            d * np.exp(-0.5 * ((WAVELENGTHS_NM - nm) / width) ** 2) for d, nm, width in _SHAPES[colour.name]
        )
        return np.asarray(10.0 ** (-colour.density * bands))
    path = folder / colour.path
    if isinstance(colour, Absorbed):
        spectrum = measured.read_spectrum(path, unit="power", column=colour.column)
        per_mm = resampling.fill_missing(resampling.on_grid(spectrum))
        if per_mm.min() < 0.0:
            raise InputError(f"{path}: expected 0 or more per mm, found {per_mm.min():.3g}; correct it")
        return np.asarray(np.exp(-per_mm * colour.thickness_mm))
    through = resampling.fill_missing(resampling.on_grid(measured.read_spectrum(path, column=colour.column)))
    most = float(sheet(np.ones(1), _face(pane))[1][0])
    if through.min() < 0.0 or through.max() > most + 0.01:
        raise InputError(
            f"{path}: expected transmittances from 0 to {most:.3f}, the transmittance of clear glass "
            f"of index {pane.index:g}, "
            f"found {through.min():.3g} to {through.max():.3g}; give the transmittances of the whole sheet"
        )
    return _inside(np.clip(through, 0.0, most), _face(pane))


def sheet(internal_transmittance: Array, face: float) -> tuple[Array, Array]:
    """Return reflectance and transmittance of a sheet: the sums over all reflections between its faces. Each
    passage leaves the share `internal_transmittance` of light, and the faces have the reflectance `face`."""
    through = (1.0 - face) ** 2 * internal_transmittance / (1.0 - (face * internal_transmittance) ** 2)
    return np.asarray(face + face * internal_transmittance * through), np.asarray(through)


def _inside(through: Array, face: float) -> Array:
    """Return the inverse of `sheet`'s transmittance, from a quadratic equation."""
    half = 0.5 * (1.0 - face) ** 2
    return np.asarray(through / (half + np.sqrt(half**2 + (face * through) ** 2)))


def _face(pane: Pane) -> float:
    return float(fresnel.reflectance(1.0, pane.index))


def bsdf(pane: Pane, folder: Path) -> Description:
    """Return the sheet for Mitsuba. Mitsuba's own sheet is clear, so its parts are multiplied by the effect of the
    colour."""
    face = _face(pane)
    reflectance, through = sheet(passage(pane, folder), face)
    clear_reflectance, clear_through = sheet(np.ones(1), face)
    return {
        "type": PLUGIN,
        "int_ior": pane.index,
        "ext_ior": 1.0,
        "specular_reflectance": reflectance / clear_reflectance,
        "specular_transmittance": through / clear_through,
    }
