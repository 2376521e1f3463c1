"""Interreflections, computed with Mitsuba: light that meets two or more surfaces, which `sim.render` omits.

    prepared = prepare(scene, view.sides >> 1, view.towards_camera)
    radiance += indirect_radiance(prepared, emitter)

A radiance meter looks at each seen triangle's centroid from the camera's direction. It computes paths of up to
`bounces` surfaces, then those of one surface alone; the difference met at least two surfaces. Far from a small
emitter direct light has almost no noise, so little of it remains in the difference (tested: below 1e-3 of it).
Triangles are flat here (no `Scene.normals`), Schlick's Fresnel factor is replaced by that of a real index, and
LEDs are Lambertian.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.appearance.render import variant
from coupole.appearance.render.bands import Description
from sim.render.emitter import Emitter
from sim.scene.scene import Scene

_START_MM = 0.05
"""Distance of a meter from its triangle: a quarter of a scanned triangle."""
_MM2 = 1e-6
_BATCH = 20_000
_LEAST_ROUGHNESS = 0.01


@dataclass(frozen=True)
class Prepared:
    """Shapes of a scene and meters on the seen triangles; valid for all LEDs of a pose."""

    shapes: dict[str, Any]
    meters: list[Any]
    """Each a batch of at most `_BATCH` triangles."""
    origin_mm: NDArray[np.float64]
    """Origin of Mitsuba's frame, at the object, for the sake of its single precision."""


def prepare(scene: Scene, triangles: NDArray[np.integer], towards_camera: ArrayLike) -> Prepared:
    """Shapes and meters for the scene's `triangles` [seen], seen from unit directions [seen, 3].

    Takes about 50 us per triangle. Raises InputError without Mitsuba.
    """
    mi = variant.mitsuba("scalar_rgb")
    centroids = scene.corners_mm[triangles].mean(axis=1, dtype=np.float64)
    origin = centroids.mean(axis=0)
    towards = np.asarray(towards_camera, dtype=np.float64)
    starts = centroids - origin + _START_MM * towards
    meters = [
        _meters(mi, starts[first : first + _BATCH], -towards[first : first + _BATCH])
        for first in range(0, len(triangles), _BATCH)
    ]
    return Prepared(_shapes(mi, scene, origin), meters, origin)


def indirect_radiance(
    prepared: Prepared, emitter: Emitter, *, bounces: int = 4, samples: int = 64, seed: int = 1
) -> NDArray[np.float32]:
    """[seen, 3] lm/(m^2 sr), red green blue: light that met 2 to `bounces` surfaces."""
    mi = variant.mitsuba("scalar_rgb")
    light = _square(mi, emitter, prepared.origin_mm)
    sums = []
    for surfaces in (bounces, 1):
        integrator = {"type": "path", "max_depth": surfaces + 1, "rr_depth": surfaces + 2}
        whole = variant.loaded(mi, {"type": "scene", "integrator": integrator, "light": light, **prepared.shapes})
        rows = [
            np.array(mi.render(whole, sensor=meter, spp=samples, seed=seed + number), np.float64)[0]
            for number, meter in enumerate(prepared.meters)
        ]
        sums.append(np.concatenate(rows))
    radiance: NDArray[np.float32] = (sums[0] - sums[1]).astype(np.float32)
    return radiance


def _meters(mi: Any, starts_mm: NDArray[np.float64], directions: NDArray[np.float64]) -> Any:
    pixel = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    film = {**pixel, "width": len(starts_mm), "component_format": "float32"}
    meters = {
        f"meter{number:06d}": {"type": "radiancemeter", "origin": start, "direction": direction, "film": pixel}
        for number, (start, direction) in enumerate(zip(starts_mm.tolist(), directions.tolist(), strict=True))
    }
    return variant.loaded(mi, {"type": "batch", "film": film, **meters})


def _shapes(mi: Any, scene: Scene, origin_mm: NDArray[np.float64]) -> dict[str, Any]:
    """A mesh for each material, with its tint by triangle."""
    import trimesh

    shapes = {}
    with tempfile.TemporaryDirectory(prefix="coupole-shapes-") as folder:
        for row in np.unique(scene.material):
            chosen = scene.material == row
            corners = scene.corners_mm[chosen].reshape(-1, 3) - origin_mm
            path = Path(folder) / f"{row}.ply"
            trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False).export(path)
            material = scene.materials[row]
            tinted = scene.tint is not None
            mesh = mi.load_dict(
                {
                    "type": "ply",
                    "filename": str(path),
                    "face_normals": True,
                    "bsdf": {"type": "twosided", "material": _material(material, tinted=tinted)},
                }
            )
            if scene.tint is not None:
                factor = _lambert(material) * scene.tint[chosen]
                mesh.add_attribute("face_diffuse", 3, factor.astype(np.float32).ravel())
            shapes[f"shape{row}"] = mesh
    return shapes


def _material(figures: NDArray[np.float64], *, tinted: bool) -> Description:
    """Lambert and GGX for a row of `Scene.materials`, blended half and half, each at twice its strength."""
    plain = _figures(_lambert(figures))
    body = {
        "type": "diffuse",
        "reflectance": {"type": "mesh_attribute", "name": "face_diffuse"} if tinted else plain,
    }
    if not _glossy(figures):
        return body
    f0 = np.clip(figures[3:6], 0.0, 0.9999)
    index = (1.0 + np.sqrt(f0)) / (1.0 - np.sqrt(f0))
    gloss = {
        "type": "roughconductor",
        "distribution": "ggx",
        "alpha": max(float(figures[6]), _LEAST_ROUGHNESS),
        "eta": _figures(index),
        "k": _figures(np.zeros(3)),
        "specular_reflectance": _figures(np.full(3, 2.0)),
    }
    return {"type": "blendbsdf", "weight": 0.5, "gloss": gloss, "body": body}


def _lambert(figures: NDArray[np.float64]) -> NDArray[np.float64]:
    """Diffuse reflectance [3], doubled if it is one half of a blend."""
    return np.asarray(figures[:3] * (2.0 if _glossy(figures) else 1.0))


def _glossy(figures: NDArray[np.float64]) -> bool:
    return bool(figures[6] > 0.0 and figures[3:6].any())


def _figures(values: NDArray[np.float64]) -> Description:
    """Three numbers without colour conversion."""
    return {"type": "srgb", "color": values.tolist(), "unbounded": True}


def _square(mi: Any, emitter: Emitter, origin_mm: NDArray[np.float64]) -> Description:
    """The emitter as a rectangle whose sides run from -1 to 1 in its own frame."""
    place = np.eye(4)
    columns = (emitter.half_u_mm, emitter.half_v_mm, emitter.normal, emitter.centre_mm - origin_mm)
    for column, vector in enumerate(columns):
        place[:3, column] = vector
    area_m2 = 4.0 * np.linalg.norm(emitter.half_u_mm) * np.linalg.norm(emitter.half_v_mm) * _MM2
    radiance = np.full(3, emitter.flux_lm / (np.pi * area_m2))
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(place),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}},
    }
