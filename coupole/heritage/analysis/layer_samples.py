"""Reads spectra of a paint's films and their grounds as films for `layer_fit`; writes the fit's result as a paint
file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from coupole.appearance.matter.glossy_face import Face, Geometry, face
from coupole.appearance.matter.paint_file import PaintFile
from coupole.appearance.spectra import measured, resampling
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from coupole.errors import InputError
from coupole.heritage.analysis.four_flux_fit import Directional, FourFlux
from coupole.heritage.analysis.layer_fit import Coefficients, Film

_BEYOND = 5.0
"""Number of standard uncertainties above which a contradiction is not noise."""
_LEAST_BANDS = 3


class _Given(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class FilmGiven(_Given):
    """One spectrum of a film."""

    spectrum: Path
    over: Path | None = None
    """Spectrum of the ground; none for an opaque film."""
    thickness_um: Annotated[float, Field(gt=0)] | None = None
    u_thickness_um: Annotated[float, Field(ge=0)] = 0.0
    """Standard uncertainty of the thickness."""


class DirectionalGiven(_Given):
    """Spectra of the same film over the same two grounds, under light along the normal."""

    over_black: Path
    over_white: Path
    transmittance: Path
    """Collimated transmittance of the film without its faces."""


class LayerGiven(_Given):
    """Input of `coupole layer`."""

    name: str = "paint"
    binder_index: Annotated[float, Field(ge=1, le=3)] = 1.5
    """Index of the binder; 1 for a paint without glossy face."""
    geometry: Geometry = "gloss excluded"
    grounds: Literal["coated", "bare"] = "coated"
    """Measurement of the grounds: `coated` under the same glossy face, as varnished cards, or `bare` without a
    face."""
    noise: Annotated[float, Field(gt=0, le=0.1)] = 0.005
    """Standard uncertainty of a spectrum's value, as a fraction."""
    films: Annotated[tuple[FilmGiven, ...], Field(min_length=2)]
    directional: DirectionalGiven | None = None


@dataclass(frozen=True, eq=False)
class Samples:
    """Films in the bands that all spectra cover."""

    wavelengths_nm: Array
    """[n] wavelengths from 380 to 780 nm that are multiples of 5 nm."""
    films: list[Film]
    directional: Directional | None
    face: Face
    is_per_mm: bool


def read_samples(layer_file: LayerGiven, folder: Path) -> Samples:
    """Read the spectra; their paths are relative to `folder`. Raises InputError, with the file, for contradictory
    input."""
    films = layer_file.films
    has_thickness = [film.thickness_um is not None for film in films if film.over is not None]
    if any(has_thickness) != all(has_thickness):
        raise InputError(
            "thickness: expected one for every film over a ground, or for none of them; only some have one"
        )
    binder_face = face(layer_file.binder_index, layer_file.geometry)
    paths = {film.spectrum for film in films} | {film.over for film in films if film.over is not None}
    more = layer_file.directional
    if more is not None:
        paths |= {more.over_black, more.over_white, more.transmittance}
    spectra = {path: spectrum_on_grid(folder / path) for path in sorted(paths)}
    bands = np.all([np.isfinite(values) for values in spectra.values()], axis=0)
    if bands.sum() < _LEAST_BANDS:
        raise InputError(
            "the spectra have no common bands between 380 and 780 nm; measure them over the same range"
        )
    spectra = {path: values[bands] for path, values in spectra.items()}
    nm = WAVELENGTHS_NM[bands]
    for film in films:
        _check_level(spectra[film.spectrum], film.spectrum, nm, binder_face, layer_file.noise)
    film_samples = [_film(film, spectra, binder_face, layer_file) for film in films]
    _check_order(film_samples, films, nm, layer_file.noise)
    return Samples(
        nm,
        film_samples,
        _directional(layer_file, spectra, nm, binder_face),
        binder_face,
        bool(has_thickness) and all(has_thickness),
    )


def paint_file(
    layer_file: LayerGiven, samples: Samples, coefficients: Coefficients, four: FourFlux | None
) -> PaintFile:
    """Return the result as a paint file. Where the films hide their grounds, S is interpolated linearly between
    bands that determine it, with an uncertainty of 100 %. If they hide their grounds in all bands, K and S are
    relative to a scattering of 1. K below 0 is stored as 0. The head names these bands."""
    nm, sure = samples.wavelengths_nm, coefficients.determined_bands
    ratio = np.maximum(coefficients.absorption, 0.0) / coefficients.scattering
    unit: Literal["per mm", "per layer", "relative"] = "per mm" if samples.is_per_mm else "per layer"
    if sure.any():
        s = np.interp(nm, nm[sure], coefficients.scattering[sure])
        u_k, u_s = (
            np.where(sure, coefficients.u_absorption, ratio * s),
            np.where(sure, coefficients.u_scattering, s),
        )
    else:
        unit, s, u_k, u_s = "relative", np.ones(len(nm)), np.zeros(len(nm)), np.zeros(len(nm))
    provenance: dict[str, Any] = {
        "noise": layer_file.noise,
        "geometry": layer_file.geometry,
        "grounds": layer_file.grounds,
    }
    provenance["spectra"] = [film.spectrum.name for film in layer_file.films]
    if len(thicknesses := sorted({film.thickness_um for film in layer_file.films if film.thickness_um})):
        provenance["thickness_um"] = thicknesses
    if sure.any() and not sure.all():
        provenance["assumed_scattering_at_nm"] = [float(value) for value in nm[~sure]]
    if (below := coefficients.absorption < 0.0).any():
        provenance["absorption_set_to_0_at_nm"] = [float(value) for value in nm[below]]
    directional_columns = {}
    if four is not None:
        directional_columns = {"k": four.direct_absorption, "s_i": four.forward, "s_j": four.backward}
        directional_columns |= {"u_k": four.u_direct_absorption, "u_s_i": four.u_forward, "u_s_j": four.u_backward}
    return PaintFile(
        layer_file.name, unit, layer_file.binder_index, nm, ratio * s, s, u_k, u_s, provenance, directional_columns
    )


def spectrum_on_grid(path: Path) -> Array:
    """[81] spectrum, NaN outside the measurement. Raises InputError for gaps."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a spectrum")
    values = resampling.on_grid(measured.read_spectrum(path)).values
    known_rows = np.flatnonzero(np.isfinite(values))
    missing = known_rows[0] + np.flatnonzero(np.isnan(values[known_rows[0] : known_rows[-1]]))
    if len(missing):
        nm = WAVELENGTHS_NM[missing]
        raise InputError(f"{path}: has a gap of more than 20 nm about {nm[0]:g} nm; measure it there, too")
    return np.asarray(values)


def _film(film: FilmGiven, spectra: dict[Path, Array], binder_face: Face, layer_file: LayerGiven) -> Film:
    reflectance = spectra[film.spectrum]
    if film.over is None:
        return Film(reflectance, None)
    ground = spectra[film.over]
    u_ground: Array | float = layer_file.noise
    if layer_file.grounds == "coated":
        below = ground - binder_face.gloss
        u_ground = layer_file.noise * binder_face.passing / (binder_face.passing + binder_face.inner * below) ** 2
        ground = below / (binder_face.passing + binder_face.inner * below)
    if ground.min() < -_BEYOND * layer_file.noise or ground.max() > 1.0 + _BEYOND * np.max(u_ground):
        raise InputError(
            f"{film.over}: as a ground under a glossy face it would reflect {ground.min():.3g} to "
            f"{ground.max():.3g} inside; expected 0 to 1: check `grounds` (bare), and whether gloss is included"
        )
    h, u_h = 1.0, 0.0
    if film.thickness_um is not None:
        h, u_h = 1e-3 * film.thickness_um, 1e-3 * film.u_thickness_um
    return Film(reflectance, np.clip(ground, 0.0, 1.0), str(film.over), u_ground, h, u_h)


def _check_level(reflectance: Array, path: Path, nm: Array, binder_face: Face, noise: float) -> None:
    low, high = (
        np.broadcast_to(binder_face.gloss, reflectance.shape),
        np.broadcast_to(binder_face.brightest, reflectance.shape),
    )
    wrong = np.flatnonzero((reflectance < low - _BEYOND * noise) | (reflectance > high + _BEYOND * noise))
    if len(wrong):
        at = wrong[0]
        raise InputError(
            f"{path}: the reflectance is {reflectance[at]:.3g} at {nm[at]:g} nm; a paint under this face can "
            f"have a reflectance of {low[at]:.3g} to {high[at]:.3g}; check whether gloss is included, the "
            "binder's index, and whether values are percent or fractions"
        )


def _check_order(films: Sequence[Film], film_entries: Sequence[FilmGiven], nm: Array, noise: float) -> None:
    """Raise InputError for a film that is darker over the lighter of two grounds."""
    for (a, told_a), (b, told_b) in combinations(zip(films, film_entries, strict=True), 2):
        if a.ground is None or b.ground is None or a.thickness_mm != b.thickness_mm:
            continue
        lighter = np.sign(b.ground - a.ground)
        wrong = np.flatnonzero(
            (lighter * (b.reflectance - a.reflectance) < -_BEYOND * np.sqrt(2.0) * noise)
            & (np.abs(b.ground - a.ground) > 0.05)
        )
        if len(wrong):
            at = wrong[0]
            light, dark = (told_b, told_a) if lighter[at] > 0 else (told_a, told_b)
            raise InputError(
                f"{light.spectrum}: is darker over the lighter ground {light.over} than {dark.spectrum} over "
                f"{dark.over} at {nm[at]:g} nm; check whether the spectra are exchanged, and whether they are "
                "percent or fractions"
            )


def _directional(
    layer_file: LayerGiven, spectra: dict[Path, Array], nm: Array, binder_face: Face
) -> Directional | None:
    directional = layer_file.directional
    if directional is None:
        return None
    grounds = [film.over for film in layer_file.films]
    thicknesses = {film.thickness_um for film in layer_file.films}
    if len(layer_file.films) != 2 or None in grounds or len(thicknesses) != 1:
        raise InputError(
            "directional: expected `films` to be one film over black, then over white, by diffuse light"
        )
    black, white = (spectra[ground] for ground in grounds if ground is not None)
    if not np.all(white > black):
        raise InputError(
            "directional: expected `films` to be over black first, then over white; found white first"
        )
    for path in (directional.over_black, directional.over_white):
        _check_level(spectra[path], path, nm, binder_face, layer_file.noise)
    through = spectra[directional.transmittance]
    if through.min() < -_BEYOND * layer_file.noise or through.max() > 1.0 + _BEYOND * layer_file.noise:
        raise InputError(
            f"{directional.transmittance}: expected a transmittance of 0 to 1, found up to {through.max():.3g}"
        )
    return Directional(spectra[directional.over_black], spectra[directional.over_white], through)
