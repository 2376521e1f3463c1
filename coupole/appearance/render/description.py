"""A scene and one of its cameras as Mitsuba's own description, with arrays [81] for spectra."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from coupole.appearance.render import bands, lights, objects, weathered_mesh
from coupole.appearance.render.bands import Description
from coupole.appearance.render.materials import Dusty, Material, Worn, bsdf
from coupole.appearance.render.materials.weathering import Weathered, needs_mesh
from coupole.appearance.render.model import unit
from coupole.appearance.render.scene_file import Camera, PlainScene
from coupole.appearance.shapes.solids import unit_sphere
from coupole.appearance.shapes.triangles import welded

Filter = float | Literal["circular"]
"""Angle in degrees of a polariser before the lens, from the picture's horizontal towards up; or one that passes
right-handed circular light."""
_BALL_PARTS = 64
"""A weathered ball has 20 times their square of triangles."""
_FILTER_MM = 1.0
"""From the projection centre to the polariser."""


def contents(scene: PlainScene, folder: Path, meshes: Path, mi: Any) -> Description:
    """Objects and lights; triangles are written into the folder `meshes`, for Mitsuba to read."""
    parts: Description = {}
    made: dict[Material, Description] = {}
    for number, thing in enumerate(scene.objects):
        for row, piece in enumerate(objects.pieces(thing, folder)):
            name = f"object{number}_{row}"
            material = piece.material
            if isinstance(material, Worn | Dusty) and needs_mesh(material):
                shape = _weathered(piece, material, meshes / f"{name}.ply")
            elif isinstance(piece, objects.Ball):
                shape = {"type": "sphere", "center": piece.centre_mm.tolist(), "radius": piece.radius_mm}
            else:
                shape = _mesh(piece, meshes / f"{name}.ply")
            if material not in made:
                made[material] = bsdf(material, folder)
            parts[name] = {**shape, "bsdf": made[material]}
    for number, light in enumerate(scene.lights):
        for row, emitter in enumerate(lights.emitters(light, folder, scene.bands.step_nm, mi)):
            parts[f"light{number}_{row}"] = emitter
    return parts


def seen(
    scene: PlainScene, camera: Camera, parts: Description, mi: Any, through: Filter | None = None
) -> Description:
    """The whole scene, seen by `camera`, optionally through a polariser."""
    look = mi.ScalarTransform4f().look_at(
        origin=list(camera.position_mm), target=list(camera.target_mm), up=list(unit(camera.up))
    )
    sensor = {
        "type": "perspective",
        "fov": camera.field_deg(),
        "fov_axis": "x",
        "near_clip": 0.1 * _FILTER_MM,
        "far_clip": 1e6,
        "to_world": look,
        "film": bands.film(camera.width_px, camera.height_px),
        "sampler": {"type": "independent"},
    }
    # Russian roulette would end paths by the brightness of four bands, so different paths in each group.
    depth = scene.depth + 1 + (through is not None)
    description = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth, "rr_depth": depth + 1},
        "camera": sensor,
        **parts,
    }
    if through is not None:
        description["polariser"] = _filter(camera, look, through, mi)
    return description


def _filter(camera: Camera, look: Any, through: Filter, mi: Any) -> Description:
    half_mm = 1.1 * _FILTER_MM * np.tan(np.radians(camera.field_deg() / 2))
    tall_mm = half_mm * camera.height_px / camera.width_px
    place = mi.ScalarTransform4f().translate([0.0, 0.0, _FILTER_MM]) @ mi.ScalarTransform4f().scale(
        [half_mm, tall_mm, 1.0]
    )
    kind: Description = {"type": "circular"} if through == "circular" else {"type": "polarizer", "theta": through}
    return {"type": "rectangle", "to_world": look @ place, "bsdf": kind}


def _weathered(piece: objects.Piece | objects.Ball, material: Weathered, path: Path) -> Description:
    if isinstance(piece, objects.Ball):
        corners_mm, smooth = piece.centre_mm + piece.radius_mm * unit_sphere(_BALL_PARTS), True
    else:
        corners_mm, smooth = piece.corners_mm, piece.smooth
    weathered_mesh.write(corners_mm, material, path, smooth=smooth)
    return {"type": "ply", "filename": str(path), "face_normals": not smooth}


def _mesh(piece: objects.Piece, path: Path) -> Description:
    import trimesh

    points, faces = welded(piece.corners_mm)
    trimesh.Trimesh(points, faces, process=False).export(path)
    return {"type": "ply", "filename": str(path), "face_normals": not piece.smooth}
