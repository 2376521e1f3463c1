"""Materials of a scene as layers for a page: spectra by angle, and their colours under each illuminant.

A layer has GGX facets over a Lambertian body. Its colours are computed here, from 81 bands, the illuminant and the
observer. The page only looks them up; it never multiplies a colour of a light by one of a material.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter import lacquer, layered
from coupole.appearance.matter.glossy_face import InternalReflectance
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.optics.thin_film import Film, stack_power
from coupole.appearance.render import materials
from coupole.appearance.render.materials import Diffuse, Films, Gilt, Glass, Lacquer, Material, Metal, Paint
from coupole.appearance.render.refraction import real_index
from coupole.appearance.render.spectra import matt
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import BANDS, WAVELENGTHS_NM, Array, Complex
from coupole.errors import InputError

ANGLES = 33
COSINES: Array = np.maximum(np.linspace(0.0, 1.0, ANGLES) ** 2, 1e-9)
"""Cosines of the angles of incidence of a table; their square roots have equal steps."""
LAYERS = 2
"""Number of layers of each material."""
COLUMNS = ANGLES + 2
PATHS = 17
"""Number of path lengths through lacquer for which a flake has values, from 0 to the longest."""
SHOWN = "gilding, metals, films, paints, lacquer, makie, nashiji, and one nashiji_slab beside opaque things"


@dataclass(frozen=True)
class Layer:
    """Facets over a body."""

    mirror: Array
    """[ANGLES, 81], reflectance of the facets at `COSINES`."""
    passing: Array
    """[ANGLES] share of light that passes the face at an angle, the same inwards and outwards."""
    body: Array
    """[81] reflectance of the body, without the loss at the face, which `passing` contains."""
    roughness: float
    """GGX's alpha."""

    def times(self, share: float) -> Layer:
        """Return a layer that covers only a share of the surface."""
        return Layer(share * self.mirror, self.passing, share * self.body, self.roughness)


def layers_of(material: Material, folder: Path) -> tuple[Layer, ...]:
    """Return the one or two layers whose sum is the material; paths are relative to `folder`. Raises
    InputError."""
    match material:
        case Diffuse():
            return (_layer_with_body(np.zeros((ANGLES, BANDS)), matt(material.reflectance, folder).values, 1.0),)
        case Paint():
            return (_coated_layer(materials.paint_inside(material, folder), material, folder),)
        case Lacquer():
            return (_coated_layer(materials.lacquer_body(material, folder), material, folder),)
        case Metal():
            return (_metal(material, folder),)
        case Films():
            films, base = materials.films_of(material, folder)
            return (_layer_with_body(_stack(films, base), np.zeros(BANDS), material.roughness),)
        case Gilt():
            return _gilt(material, folder)
        case Glass():
            raise InputError(f"material of kind glass: a page does not refract; it shows {SHOWN}")
        case _:
            raise InputError(f"material of kind {material.kind}: a page cannot show it; it shows {SHOWN}")


def flake_layers(gold: float, roughness: float, longest_mm: float) -> list[tuple[Layer, ...]]:
    """Return a metal under urushi, seen through paths of 0 to `longest_mm` of lacquer, as `PATHS` materials. The
    lacquer's face is not included, because the page refracts there."""
    index = materials.metal_index(gold) / indices.URUSHI
    mirror, absorption = fresnel.reflectance(COSINES[:, None], index), lacquer.urushi_absorption()
    ways_mm = np.linspace(0.0, longest_mm, PATHS)
    return [(_layer_with_body(mirror * np.exp(-way * absorption), np.zeros(BANDS), roughness),) for way in ways_mm]


def tables(
    layers_of_materials: Sequence[tuple[tuple[Layer, ...], bool]],
    powers: Mapping[str, Array],
    observer: light.Observer,
) -> NDArray[np.float32]:
    """[illuminants, materials, LAYERS, COLUMNS, 4] linear sRGB of white 1 under each illuminant.

    Columns: `mirror` at `COSINES`, with `passing` as the fourth number; body (1/sr) and roughness; then 1 if each
    triangle has its own share of the first layer (the second layer has the rest), otherwise 0; and the colour of
    white. Colours outside the gamut have numbers below 0.
    """
    numbers = np.zeros((len(powers), len(layers_of_materials), LAYERS, COLUMNS, 4), np.float32)
    numbers[..., :ANGLES, 3] = 1.0
    numbers[..., ANGLES, 3] = 1.0
    for at, power in enumerate(powers.values()):
        for number, (layers, is_drawn) in enumerate(layers_of_materials):
            for place, layer in enumerate(layers):
                here = numbers[at, number, place]
                here[:ANGLES, :3] = colours(layer.mirror, power, observer)
                here[:ANGLES, 3] = layer.passing
                here[ANGLES, :3] = colours(layer.body, power, observer) / np.pi
                here[ANGLES, 3] = layer.roughness
            numbers[at, number, :, ANGLES + 1, 0] = is_drawn
            numbers[at, number, :, ANGLES + 1, 1:] = colours(np.ones(BANDS), power, observer)
    return numbers


def colours(spectral: Array, power: Array, observer: light.Observer) -> Array:
    """Linear sRGB [..., 3] of reflectances [..., 81] under a light; Y of the perfect white is 1. There is no
    chromatic adaptation."""
    return light.linear_srgb(light.tristimulus(spectral, power, light.observer(observer)))


def chromaticity(power: Array, observer: light.Observer) -> list[float]:
    """x, y of a light."""
    xyz = light.tristimulus(np.ones(BANDS), power, light.observer(observer))
    return [float(value) for value in xyz[:2] / xyz.sum()]


def _layer_with_body(mirror: Array, body: Array, roughness: float) -> Layer:
    return Layer(mirror, np.ones(ANGLES), body, roughness)


def _coated_layer(body: InternalReflectance, material: Paint | Lacquer, folder: Path) -> Layer:
    return _under_face(body, real_index(material.index, folder), material.roughness)


def _under_face(body: InternalReflectance, index: Array, roughness: float) -> Layer:
    """A body under a glossy face, with all reflections between them (Saunderson), like `materials.coated`."""
    face = fresnel.reflectance(COSINES, indices.at_d_line(index.astype(complex)))
    reflectance = materials.under_face(body, index)
    return Layer(np.repeat(face[:, None], BANDS, axis=1), 1.0 - face, reflectance, roughness)


def _metal(material: Metal, folder: Path) -> Layer:
    index, factor = materials.metal_of(material, folder), np.ones(BANDS)
    if material.depth_mm is not None:
        index = index / indices.URUSHI
        inward = 1.0 - float(fresnel.reflectance(1.0, indices.URUSHI)) if material.face else 1.0
        factor = (inward * lacquer.transmittance(material.depth_mm, 1.0, lacquer.urushi_absorption())) ** 2
    return _layer_with_body(
        fresnel.reflectance(COSINES[:, None], index) * factor, np.zeros(BANDS), material.roughness
    )


def _stack(films: Sequence[Film], base: Complex) -> Array:
    return stack_power(COSINES, WAVELENGTHS_NM, films, substrate=base)[0]


def _gilt(material: Gilt, folder: Path) -> tuple[Layer, ...]:
    """Leaf, with the light of the bole that passes through it, and bare bole, by their shares."""
    gilding, index = materials.gilt_of(material, folder)
    bare = _under_face(gilding.bole, np.full(BANDS, indices.EGG_WHITE), material.bole_roughness)
    if material.thickness_nm < materials.THINNEST_NM or material.uncovered == 1.0:
        return (bare,)
    through = gilding.leaf.transmittance[-1] * layered.emerging(gilding.leaf, gilding.bole)
    films = [Film(index, material.thickness_nm)]
    leaf = _layer_with_body(_stack(films, indices.constant(indices.EGG_WHITE)), through, material.roughness)
    if material.uncovered == 0.0:
        return (leaf,)
    return leaf.times(1.0 - material.uncovered), bare.times(material.uncovered)
