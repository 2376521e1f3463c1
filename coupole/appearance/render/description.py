"""A scene and one of its cameras as Mitsuba's own description, with arrays [81] for spectra."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from coupole.appearance.render import absorption, bands, lights, objects
from coupole.appearance.render.bands import Description
from coupole.appearance.render.materials import Glass, Material, bsdf
from coupole.appearance.render.model import unit
from coupole.appearance.render.pieces import Ball, Piece
from coupole.appearance.render.scene_file import Camera, PlainScene
from coupole.appearance.shapes.triangles import welded
from coupole.errors import InputError

Filter = float | Literal["circular"]
"""Angle in degrees of a polariser before the lens, from the picture's horizontal towards up; or one that passes
right-handed circular light."""
_FILTER_MM = 1.0
"""From the projection centre to the polariser."""


def contents(scene: PlainScene, folder: Path, meshes: Path, mi: Any) -> Description:
    """Objects and lights; triangles are written into the folder `meshes`, for Mitsuba to read."""
    parts: Description = {}
    for number, thing in enumerate(scene.objects):
        for row, piece in enumerate(objects.pieces(thing, folder)):
            name = f"object{number}_{row}"
            if isinstance(piece, Ball):
                shape = {"type": "sphere", "center": piece.centre_mm.tolist(), "radius": piece.radius_mm}
            else:
                shape = _mesh(piece, meshes / f"{name}.ply")
            parts[name] = {**shape, "bsdf": bsdf(piece.material, folder), **_inside(piece.material, folder)}
    for number, light in enumerate(scene.lights):
        for row, emitter in enumerate(lights.emitters(light, folder, scene.bands.step_nm, mi)):
            parts[f"light{number}_{row}"] = emitter
    return parts


def seen(
    scene: PlainScene, camera: Camera, parts: Description, mi: Any, through: Filter | None = None
) -> Description:
    """The whole scene, seen by `camera`, optionally through a polariser. Raises InputError."""
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
        "integrator": {
            "type": _integrator(parts, polarised=scene.polarisation),
            "max_depth": depth,
            "rr_depth": depth + 1,
        },
        "camera": sensor,
        **parts,
    }
    if through is not None:
        description["polariser"] = _filter(camera, look, through, mi)
    return description


def _inside(material: Material, folder: Path) -> Description:
    """The medium of a body, if it absorbs."""
    if not isinstance(material, Glass) or material.absorption is None:
        return {}
    taken = absorption.per_mm(material.absorption, material.index, folder)
    return {"interior": {"type": "homogeneous", "sigma_t": taken, "albedo": 0.0}}


def _integrator(parts: Description, *, polarised: bool) -> str:
    """For media, that which weighs a way by all bands of a group: their absorption may differ by far.

    Raises InputError for media and polarisation together.
    """
    if not any(isinstance(part, dict) and "interior" in part for part in parts.values()):
        return "path"
    if polarised:
        raise InputError(
            "polarisation: expected no absorbing body (glass with absorption, nashiji), through which Mitsuba "
            "has no Stokes vectors; leave out either"
        )
    return "volpathmis"


def _filter(camera: Camera, look: Any, through: Filter, mi: Any) -> Description:
    half_mm = 1.1 * _FILTER_MM * np.tan(np.radians(camera.field_deg() / 2))
    tall_mm = half_mm * camera.height_px / camera.width_px
    place = mi.ScalarTransform4f().translate([0.0, 0.0, _FILTER_MM]) @ mi.ScalarTransform4f().scale(
        [half_mm, tall_mm, 1.0]
    )
    kind: Description = {"type": "circular"} if through == "circular" else {"type": "polarizer", "theta": through}
    return {"type": "rectangle", "to_world": look @ place, "bsdf": kind}


def _mesh(piece: Piece, path: Path) -> Description:
    import trimesh

    points, faces = welded(piece.corners_mm)
    trimesh.Trimesh(points, faces, process=False).export(path)
    return {"type": "ply", "filename": str(path), "face_normals": not piece.smooth}
