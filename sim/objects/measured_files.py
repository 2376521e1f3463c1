"""Materials from files, measured or exported, in MERL's, RGL's and ALTA's formats.

Red, green and blue of a file are used as the simulated camera's red, green and blue. Spectra are converted to the
camera's channels under its LEDs. The renderer's materials are isotropic; an anisotropic material is replaced by
its mean over turns of the surface.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from coupole.appearance.matter.alta_samples import interpolated_brdf, read_alta
from coupole.appearance.matter.brdf import Brdf
from coupole.appearance.matter.hemisphere import albedo
from coupole.appearance.matter.merl_table import read_merl
from coupole.appearance.matter.rgl_table import read_bsdf
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from coupole.errors import InputError
from sim.optics.led_light import LedModel, camera_weights
from sim.scene.brdf_table import tabulate
from sim.scene.surface import Material

_TURNS = 16
"""Number of turns over which an anisotropic surface is averaged."""
_NODES = 24
"""Nodes of each integral over the hemisphere."""


@cache
def merl_material(path: Path) -> Material:
    """Raises InputError for another kind of file."""
    return _scene_material(path.stem, read_merl(path))


@cache
def bsdf_material(path: Path) -> Material:
    """Raises InputError for another kind of file."""
    table = read_bsdf(path)
    if table.wavelengths_nm is not None:
        table = table.seen_with(_weights_of(table.wavelengths_nm))
    return _scene_material(path.stem, table if table.isotropic else _turned_to_all_sides(table))


@cache
def alta_material(paths: tuple[Path, ...]) -> Material:
    """Read one file of one channel, which is grey, or of three channels; or one file for each of red, green and
    blue. Raises InputError for other files, and for samples that cannot be interpolated."""
    parts = [interpolated_brdf(read_alta(path)) for path in paths]

    def whole(wi: Array, wo: Array) -> Array:
        brdf = np.concatenate([part(wi, wo) for part in parts], axis=-1)
        return np.repeat(brdf, 3, axis=-1) if brdf.shape[-1] == 1 else brdf

    up = np.array([0.0, 0.0, 1.0])
    if (channels := whole(up, up).shape[-1]) != 3:
        raise InputError(f"{paths[0]}: expected one or three values in each sample; found {channels} in all")
    return _scene_material(paths[0].stem, whole)


def _scene_material(name: str, reflectance: Brdf) -> Material:
    """Return a material of the scene, with its diffuse reflectance as in `specimens.specimen`."""
    red, green, blue = np.clip(albedo(reflectance, np.array([np.sqrt(0.5)]), nodes=_NODES)[0], 1e-6, 1.0).tolist()
    return Material(name, (red, green, blue), table=tabulate(reflectance, np.eye(3)))


def _weights_of(wavelengths_nm: Array) -> Array:
    """Return [3, n] weights of spectra at these wavelengths, linear between them, as the camera sees them under
    its LEDs."""
    between = np.stack(
        [np.interp(WAVELENGTHS_NM, wavelengths_nm, unit_vector) for unit_vector in np.eye(len(wavelengths_nm))]
    )
    return np.asarray(camera_weights(LedModel(), light.camera()) @ between.T)


def _turned_to_all_sides(reflectance: Brdf) -> Brdf:
    angles = 2.0 * np.pi * (np.arange(_TURNS) + 0.5) / _TURNS
    turns = [np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]]) for a in angles]

    def mean(wi: Array, wo: Array) -> Array:
        return np.asarray(sum(reflectance(wi @ turn, wo @ turn) for turn in turns) / len(turns))

    return mean
