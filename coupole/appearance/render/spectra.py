"""Spectra of a scene file: reflectances and lights; [81] on the materials' grid."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from coupole.appearance.matter import typical
from coupole.appearance.matter.glossy_face import BARE, InternalReflectance, MeasuredReflectance, face
from coupole.appearance.matter.paint_file import read_paint
from coupole.appearance.matter.pigments import Pigment
from coupole.appearance.render.model import Model, Share
from coupole.appearance.spectra import light, measured, resampling
from coupole.appearance.spectra.grid import BANDS, STEP_NM, WAVELENGTHS_NM, Array
from coupole.appearance.spectra.white_led import LedSpectrum, spectral_power
from coupole.errors import InputError

LM_PER_W = 683.0
"""CIE: luminous efficacy at 540 THz."""
_C2_NM_K = 1.4388e7
_SUN_K = 5778.0


class Constant(Model):
    """The same value at all wavelengths."""

    kind: Literal["constant"]
    value: Share


class Shape(Model):
    """An assumed spectrum from `coupole.appearance.matter.typical`, of an opaque layer inside its binder; it is no
    measured pigment.

    `kind: pigment` and names of pigments come from before version 0.2; they are still read, with a remark.
    """

    kind: Literal["shape", "pigment"]
    name: str

    def remark(self) -> str:
        """Return a remark for the author of the scene about a former name; empty if there is none."""
        now = typical.FORMER_NAMES.get(self.name)
        if now is None:
            return ""
        return f"{self.name} is not a measured pigment but an assumed shape: write {{kind: shape, name: {now}}}"


class Bole(Model):
    """The papers' bole, half red lead, half red ochre (Callet et al. 2010, section 5), of assumed shapes, in its
    binder."""

    kind: Literal["bole"]


class Measured(Model):
    """A spectrophotometer's export (docs/reference/materials.md); beyond its ends, the last values are used."""

    kind: Literal["file"]
    path: Path
    column: int | None = None
    sample: Literal["gloss excluded", "gloss included", "bare"] = "gloss excluded"
    """Statement whether the measurement includes the gloss of the sample's face. `bare`: the sample had no face
    (matt powder), so the measured reflectance is also valid inside a binder."""


class MeasuredPaint(Model):
    """K and S of a paint in a file from `coupole layer` (`coupole.appearance.matter.paint_file`)."""

    kind: Literal["paint_file"]
    path: Path


class MeasuredPower(Model):
    """Measured power of a light by wavelength."""

    kind: Literal["file"]
    path: Path
    column: int | None = None


Reflectance = Annotated[Constant | Shape | Bole | Measured, Field(discriminator="kind")]
Colouring = Annotated[Constant | Shape | Bole | Measured | MeasuredPaint, Field(discriminator="kind")]
"""Colour of a paint: a reflectance, or K and S."""


class Illuminant(Model):
    """A standard illuminant of the CIE: E, A, D50, D65, FL2, ..."""

    kind: Literal["illuminant"]
    name: str


class Source(Model):
    """A light source that colour-science knows, such as 'LED-B3'."""

    kind: Literal["source"]
    name: str


class DomeLed(Model):
    """The white LED of the simulated dome (`appearance.spectra.white_led`)."""

    kind: Literal["dome_led"]


class BlackBody(Model):
    kind: Literal["black_body"]
    kelvin: Annotated[float, Field(ge=800, le=30000)]


class Values(Model):
    """81 values, 380 to 780 nm by 5 nm."""

    kind: Literal["values"]
    name: str = "given"
    """Name in pictures and pages."""
    values: Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=BANDS, max_length=BANDS)]


class LowSun(Model):
    """The sun at a refracted elevation, through clear air: computed, not measured.

    A black body of 5778 K behind Rayleigh scattering 0.008735 um^-4.08 and haze beta um^-1.3 (Leckner 1978), over
    the air mass of Kasten and Young 1989. Ozone is neglected.
    """

    kind: Literal["low_sun"]
    elevation_deg: Annotated[float, Field(ge=0, le=90)]
    haze: Annotated[float, Field(ge=0, le=0.5)] = 0.06
    """Angstrom's beta: 0.02 is clear, 0.2 is turbid."""


Power = Annotated[
    Illuminant | Source | DomeLed | BlackBody | LowSun | Values | MeasuredPower, Field(discriminator="kind")
]


def internal(spectrum: Reflectance, folder: Path, index: ArrayLike) -> InternalReflectance:
    """[81] reflectance under a face of real index `index`. A measured spectrum is converted, because it was
    measured through such a face.

    Constants, shapes and the bole are internal reflectances already. Paths are relative to `folder`. Raises
    InputError.
    """
    if isinstance(spectrum, Constant):
        return InternalReflectance(np.full(BANDS, spectrum.value))
    if isinstance(spectrum, Shape):
        return typical.reflectance(spectrum.name)
    if isinstance(spectrum, Bole):
        return typical.bole()
    measured_reflectance = _measured_reflectance(spectrum, folder)
    if spectrum.sample == "bare":
        return BARE.inside(measured_reflectance)
    try:
        return face(index, spectrum.sample).inside(measured_reflectance)
    except InputError as error:
        raise InputError(f"{folder / spectrum.path}: {error}") from error


def coefficients(paint: MeasuredPaint, folder: Path, *, needs_mm: bool) -> Pigment:
    """Return K and S [81], constant beyond the file's ends. Raises InputError, also if K and S must be per mm and
    are not."""
    paint_file = read_paint(folder / paint.path)
    if needs_mm and paint_file.unit != "per mm":
        raise InputError(
            f"{folder / paint.path}: is {paint_file.unit}; a layer of a thickness needs K and S per mm: measure "
            "the film with its thickness, or leave out thickness_mm for an opaque layer"
        )
    return paint_file.on_grid()


def matt(spectrum: Reflectance, folder: Path) -> MeasuredReflectance:
    """[81] reflectance of a material without a face. Raises InputError."""
    return BARE.reflectance_in_air(internal(spectrum, folder, 1.0))


def _measured_reflectance(spectrum: Measured, folder: Path) -> MeasuredReflectance:
    path = folder / spectrum.path
    values = resampling.fill_missing(resampling.on_grid(measured.read_spectrum(path, column=spectrum.column)))
    if values.min() < -0.02 or values.max() > 1.02:
        raise InputError(
            f"{path}: expected reflectances from 0 to 1, found {values.min():.3g} to {values.max():.3g}; "
            "give a sample without gloss or fluorescence"
        )
    return MeasuredReflectance(np.clip(values, 0.0, 1.0))


def power(spectrum: Power, folder: Path) -> Array:
    """Relative spectral power [81]. Raises InputError."""
    if isinstance(spectrum, Illuminant):
        return light.illuminant(spectrum.name)
    if isinstance(spectrum, Source):
        return light.led(spectrum.name)
    if isinstance(spectrum, DomeLed):
        return spectral_power(LedSpectrum())
    if isinstance(spectrum, BlackBody):
        return _planck(spectrum.kelvin)
    if isinstance(spectrum, LowSun):
        return _low_sun(spectrum)
    if isinstance(spectrum, Values):
        return np.array(spectrum.values)
    measured_power = measured.read_spectrum(folder / spectrum.path, unit="power", column=spectrum.column)
    return np.maximum(resampling.fill_missing(resampling.on_grid(measured_power)), 0.0)


def luminous(spectral: Array) -> Array:
    """Return cd/m^2 of W/(m^2 sr nm) [..., 81], or lux of irradiance, with V(lambda) of the CIE 1931 observer."""
    return np.asarray(LM_PER_W * STEP_NM * (spectral @ light.observer("2 deg")[1]))


def scaled_power(relative: Array, photometric: float) -> Array:
    """Return the spectral power per nm [81] with the shape `relative` and the photometric amount `photometric`."""
    return np.asarray(relative * (photometric / luminous(relative)))


def air_mass(elevation_deg: float) -> float:
    """Relative optical air mass (Kasten and Young, Appl. Opt. 28, 4735, 1989)."""
    return float(1.0 / (np.sin(np.radians(elevation_deg)) + 0.50572 * (elevation_deg + 6.07995) ** -1.6364))


def _low_sun(sun: LowSun) -> Array:
    um = WAVELENGTHS_NM * 1e-3
    depth = 0.008735 * um**-4.08 + sun.haze * um**-1.3
    return np.asarray(_planck(_SUN_K) * np.exp(-air_mass(sun.elevation_deg) * depth))


def _planck(kelvin: float) -> Array:
    """Planck's law, normalised to a maximum of 1 on the grid."""
    shape = WAVELENGTHS_NM**-5.0 / np.expm1(_C2_NM_K / (WAVELENGTHS_NM * kelvin))
    return np.asarray(shape / shape.max())
