"""A picture of the back wall of a scene's arcature under its sun, with light by photons (`caustic`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from coupole.appearance.matter import layered
from coupole.appearance.render import arcature, caustic, colour
from coupole.appearance.render.lights import Distant
from coupole.appearance.render.materials import Gilt, gilt_of
from coupole.appearance.render.model import unit
from coupole.appearance.render.objects import Arcature
from coupole.appearance.render.pictures import SYNTHETIC, write_png
from coupole.appearance.render.scene_file import Caustic, PlainScene
from coupole.appearance.render.spectra import luminous, power, scaled_power
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

_PART = 500_000


def write_wall(
    scene: PlainScene, folder: Path, stem: Path, white_power: Array, progress: Callable[[int, int], None]
) -> dict[str, Any]:
    """Write `stem`.png, the colour of a white wall, with the brightest 0.5 % of the cells shown as white. Return
    figures.

    The light is sunlight only, without sky and without inter-reflection between stones. Raises InputError,
    OSError.
    """
    assert scene.caustic is not None
    thing = next(thing for thing in scene.objects if isinstance(thing, Arcature))
    light = next(light for light in scene.lights if isinstance(light, Distant))
    sun = _sun(light, thing, folder, scene.name)
    lit, share_by_gold = _lit(scene.caustic, scene.seed, thing, _niche(thing, folder), sun, progress)
    eye = colour.eye(scene.observer, sun.irradiance, white_power, 5)
    xyz = eye.tristimulus(lit / np.pi)
    brightest = float(np.quantile(xyz[..., 1], 0.995))
    picture, _ = colour.displayed_srgb(colour.adapted_xyz(xyz / brightest, eye.white, scene.display.adaptation))
    about = f"{scene.name}, light on the back wall: {SYNTHETIC}; {scene.caustic.photons} photons"
    write_png(stem.with_suffix(".png"), picture, about)
    return {
        "file": stem.with_suffix(".png").name,
        "photons": scene.caustic.photons,
        "direct_lux": round(float(luminous(sun.irradiance) * sun.direction[1]), 3),
        "greatest_lux": round(float(luminous(lit).max()), 3),
        "share_by_gold": round(share_by_gold, 5),
    }


def _lit(
    settings: Caustic,
    seed: int,
    thing: Arcature,
    niche: caustic.Niche,
    sun: caustic.Sun,
    progress: Callable[[int, int], None],
) -> tuple[Array, float]:
    """Return the irradiance [rows, columns, 81] of the wall, and the luminous share of the light that reached
    stone by way of gold.

    It is computed in parts, because a photon takes 324 bytes.
    """
    sides, top_mm = (-thing.radius_mm, thing.radius_mm), thing.height_mm + thing.radius_mm
    counts = [min(_PART, settings.photons - first) for first in range(0, settings.photons, _PART)]
    lit: Array | float = 0.0
    by_gold = 0.0
    for part, count in enumerate(counts):
        progress(part, len(counts))
        weight = count / settings.photons
        photons = caustic.photons(niche, sun, (*sides, top_mm), count, (seed, part))
        lit = lit + weight * caustic.irradiance(photons, sides, top_mm, settings.cell_mm, thing.depth_mm)
        on_stone = luminous(photons.power[photons.bounces > 0].sum(axis=0, dtype=float))
        by_gold += weight * float(on_stone / luminous(photons.started_power))
    progress(len(counts), len(counts))
    return np.asarray(lit), by_gold


def gold_reflectance(gilt: Gilt, folder: Path) -> caustic.Reflectance:
    """Return the reflectance of the covered share, by cosine; the bole's light is neglected."""
    leaf = _leaf(gilt, folder)
    return lambda cosines: layered.at_cosine(leaf, cosines)


def _sun(light: Distant, thing: Arcature, folder: Path, scene_name: str) -> caustic.Sun:
    """Return the sun in the niche's frame."""
    direction = thing.scene_from_thing()[:3, :3].T @ np.array(unit(light.direction))
    if direction[1] <= 0.0:
        raise InputError(
            f"{scene_name}: expected a sun that shines into the arcature, found the sun behind the wall; turn "
            "the arcature, or move the sun"
        )
    return caustic.Sun(
        direction, light.width_deg, scaled_power(power(light.spectrum, folder), light.illuminance_lux)
    )


def _niche(thing: Arcature, folder: Path) -> caustic.Niche:
    parts = arcature.arcature(thing.radius_mm, thing.height_mm, thing.depth_mm)
    reflectance = gold_reflectance(thing.gilt, folder)
    return caustic.Niche(parts.gilded_mm, parts.stone_mm, reflectance, thing.gilt.roughness)


def _leaf(gilt: Gilt, folder: Path) -> Array:
    """Specular part of the covered share, as in `layered.Sheet`."""
    gilding, _ = gilt_of(gilt, folder)
    return np.asarray((1.0 - gilt.uncovered) * gilding.leaf.reflectance)
