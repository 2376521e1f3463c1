"""Tests every kind of material of a scene: white furnace, reciprocity, and sampling against evaluation.

    python tools/prove_materials.py [--samples N]

Each material is passed to Mitsuba as `coupole render` does, for four bands from 500 to 515 nm. Three figures are
printed, over all bands and over the cosines 0.1, 0.3, 0.6 and 0.95 of the direction to the eye:

- the largest albedo, by evaluation: f times the cosine over the hemisphere. It must not be above 1.
- the largest difference between this albedo and the mean weight of sampled directions, minus three standard errors
  of the mean.
- the largest relative difference of f when the two directions are exchanged, for values above a thousandth of the
  largest.

Glass has no f and is left out. `worn` is tested at one share. `dusty` is left out, because it is the same blend
with shares that follow the normals of a mesh. Exits with 1 if a material creates light, or if sampled directions
differ by more than 0.01, but not with `--smallest`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from pydantic import TypeAdapter  # noqa: E402

from coupole.appearance.matter import brdf  # noqa: E402
from coupole.appearance.optics import fresnel, indices  # noqa: E402
from coupole.appearance.render import bands, materials, variant  # noqa: E402
from coupole.exchange.of_results.merl import encode_reflectance  # noqa: E402
from smallest import add_smallest  # noqa: E402

GROUP = [24, 25, 26, 27]
COSINES = (0.1, 0.3, 0.6, 0.95)
HIGHEST_ALBEDO, MOST_APART = 1.0 + 2e-3, 0.01
"""Limits of the first two figures; both include the error of the quadrature."""
_FROM_ABOVE, _AROUND = 160, 160
_TURN = 0.3
"""Azimuth of the eye."""
_WHITE = {"kind": "constant", "value": 1.0}
_GLAZE = {
    "kind": "values",
    "absorption": 0.0,
    "scattering": 8.0,
    "direct_absorption": 0.0,
    "forward": 9.0,
    "backward": 2.0,
}
_LEAF = {"kind": "leaf", "roughness": 0.15}
_METAL = {"kind": "metal", "roughness": 0.2}
_DIFFUSE = {"kind": "diffuse", "reflectance": _WHITE}
MATERIALS: dict[str, dict[str, Any]] = {
    "diffuse, white": _DIFFUSE,
    "paint, white": {"kind": "paint", "pigment": _WHITE},
    "lacquer over white, rough": {"kind": "lacquer", "body": _WHITE, "roughness": 0.3},
    "lacquer over white, polished": {"kind": "lacquer", "body": _WHITE, "roughness": 0.04},
    "metal, alpha 0.2": _METAL,
    "metal, Beckmann 0.3": {"kind": "metal", "roughness": 0.3, "distribution": "beckmann"},
    "metal under lacquer": {"kind": "metal", "roughness": 0.2, "depth_mm": 0.05},
    "gilt, 25 nm on white": {"kind": "gilt", "thickness_nm": 25.0, "bole": _WHITE},
    "gilt, half uncovered": {"kind": "gilt", "uncovered": 0.5, "bole": _WHITE},
    "films over gold": {"kind": "films", "films": [{"index": 1.5, "thickness_nm": 30.0}], "roughness": 0.1},
    "four fluxes over white": {"kind": "four_flux", "coefficients": _GLAZE, "thickness_mm": 0.1, "ground": _WHITE},
    "leaf over white": {"kind": "layers", "layers": [_LEAF], "ground": _WHITE},
    "measured (MERL's format)": {"kind": "measured", "path": "gold.binary"},
    "worn, metal over white": {"kind": "worn", "over": _METAL, "under": _DIFFUSE, "share": 0.3},
}


class Loaded:
    """A material in Mitsuba, for one group of bands."""

    def __init__(self, description: dict[str, Any], folder: Path) -> None:
        self._mi = variant.mitsuba("scalar_spectral")
        material = TypeAdapter(materials.Material).validate_python(description)
        group_description = bands.for_group(materials.bsdf(material, folder), GROUP, 5, folder)
        self.bsdf = self._mi.load_dict(group_description)
        self._wavelengths = (380.0 + 5.0 * np.array(GROUP, float)).tolist()
        self._context = self._mi.BSDFContext()

    def place(self, way: np.ndarray) -> Any:
        """A point of a surface, seen from a direction."""
        mi = self._mi
        place = mi.SurfaceInteraction3f()
        place.wi, place.t = mi.Vector3f(*way.tolist()), 1.0
        place.n = mi.Normal3f(0.0, 0.0, 1.0)
        place.sh_frame = mi.Frame3f(mi.Vector3f(0.0, 0.0, 1.0))
        place.wavelengths = self._wavelengths
        return place

    def times_cosine(self, wo: np.ndarray, ways_in: np.ndarray) -> np.ndarray:
        """Return f times the cosine, for each direction of incidence [n, 4]."""
        place, mi = self.place(wo), self._mi
        return np.array(
            [np.array(self.bsdf.eval(self._context, place, mi.Vector3f(*way.tolist()))).ravel() for way in ways_in]
        )

    def drawn_weights(self, wo: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return weights [n, 4] of sampled directions."""
        place, mi = self.place(wo), self._mi
        return np.array(
            [
                np.array(self.bsdf.sample(self._context, place, u, mi.Point2f(v, w))[1]).ravel()
                for u, v, w in rng.random((count, 3)).tolist()
            ]
        )


def ways(cosines: np.ndarray, turns: np.ndarray) -> np.ndarray:
    sines = np.sqrt(1.0 - cosines**2)
    return np.stack([sines * np.cos(turns), sines * np.sin(turns), cosines], axis=-1)


def hemisphere_nodes() -> tuple[np.ndarray, np.ndarray]:
    """Directions [n, 3] and their solid angles [n]: midpoints that are dense near the horizon and near the
    mirror's azimuth."""
    t = (np.arange(_FROM_ABOVE) + 0.5) / _FROM_ABOVE
    s = 2.0 * (np.arange(_AROUND) + 0.5) / _AROUND - 1.0
    cosine, turn = np.meshgrid(t**2, _TURN + np.pi + np.pi * s**3)
    area = np.outer(3.0 * np.pi * s**2 * 2.0 / _AROUND, 2.0 * t / _FROM_ABOVE)
    return ways(cosine.ravel(), turn.ravel()), area.ravel()


def figures(material: Loaded, count: int, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return the largest albedo, the largest difference of sampled directions, and the largest difference of
    exchanged ones."""
    over, area = hemisphere_nodes()
    albedos, apart, exchange_errors = [], [0.0], [0.0]
    for z in COSINES:
        wo = ways(np.array([z]), np.array([_TURN]))[0]
        weights = material.drawn_weights(wo, count, rng)
        mean_weight, error = weights.mean(axis=0), weights.std(axis=0) / np.sqrt(count)
        albedo = area @ material.times_cosine(wo, over)
        albedos.append(float(albedo.max()))
        apart.append(float((np.abs(albedo - mean_weight) - 3.0 * error).max()))
        some = ways(rng.uniform(0.1, 1.0, 200), rng.uniform(0.0, 2.0 * np.pi, 200))
        there = material.times_cosine(wo, some) / some[:, 2:]
        back = np.array([material.times_cosine(way, wo[None])[0] for way in some]) / wo[2]
        is_bright = np.maximum(there, back) > 1e-3 * there.max()
        relative = np.abs(there - back) / np.maximum(np.maximum(there, back), 1e-30)
        exchange_errors.append(float(relative[is_bright].max()))
    return max(albedos), max(apart), max(exchange_errors)


def gold(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    return brdf.ggx(wi, wo, roughness=0.3, fresnel=fresnel.of_index(indices.gold()[[54, 34, 14]]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=20_000, help="ways drawn for each cosine")
    add_smallest(parser, samples=200)
    options = parser.parse_args()
    rng, good = np.random.default_rng(1), True
    selection = dict(list(MATERIALS.items())[:1]) if options.smallest else MATERIALS
    print("material | largest albedo | drawn against evaluated | exchanged ways")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "gold.binary").write_bytes(encode_reflectance(gold))
        for name, description in selection.items():
            albedo, apart, exchange_error = figures(Loaded(description, Path(folder)), options.samples, rng)
            good &= albedo <= HIGHEST_ALBEDO and apart <= MOST_APART
            print(f"{name} | {albedo:.4f} | {max(apart, 0.0):.4f} | {100 * exchange_error:.2g} %", flush=True)
    print(f"{len(selection)} materials: {'none creates light' if good else 'a material is WRONG'}")
    return int(not options.smallest and not good)


if __name__ == "__main__":
    sys.exit(main())
