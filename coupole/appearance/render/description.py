"""A scene and one of its cameras as Mitsuba's own description, with arrays [81] for spectra."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from coupole.appearance.render import absorption, bands, candle, lights, objects, panes, weathered_mesh
from coupole.appearance.render.bands import Description
from coupole.appearance.render.materials import Diffuse, Dusty, Glass, Material, Worn, bsdf
from coupole.appearance.render.materials.weathering import Weathered, needs_mesh
from coupole.appearance.render.model import unit
from coupole.appearance.render.panes import Pane
from coupole.appearance.render.pieces import Ball, Piece
from coupole.appearance.render.scene_file import Camera, PlainScene
from coupole.appearance.render.spectra import Constant
from coupole.appearance.shapes.solids import unit_sphere
from coupole.appearance.shapes.triangles import weld_corners
from coupole.errors import InputError

Filter = float | Literal["circular"]
"""Angle in degrees of a polariser before the lens, from the picture's horizontal towards up; or a polariser that
passes right-handed circular light."""
_BLACK = Diffuse(kind="diffuse", reflectance=Constant(kind="constant", value=0.0))
_BALL_PARTS = 64
"""Number of parts n into which edges of a weathered ball are divided; the ball has 20 n^2 triangles."""
_FILTER_MM = 1.0
"""Distance from the projection centre to the polariser."""


def contents(scene: PlainScene, folder: Path, meshes: Path, mi: Any, more: Sequence[Piece] = ()) -> Description:
    """Return objects, `more` pieces and lights; triangles are written into the folder `meshes`, from which Mitsuba
    reads them."""
    parts: Description = {}
    reach_mm = 0.0
    surfaces: dict[Material | Pane, Description] = {}
    of_objects = [objects.pieces(thing, folder) for thing in scene.objects]
    for number, pieces in enumerate([*of_objects, more]):
        for row, piece in enumerate(pieces):
            name = f"object{number}_{row}"
            material = piece.material
            reach_mm = max(reach_mm, _reach_mm(piece))
            if isinstance(material, Worn | Dusty) and needs_mesh(material):
                shape = _weathered_shape(piece, material, meshes / f"{name}.ply")
            elif isinstance(piece, Ball):
                shape = {"type": "sphere", "center": piece.centre_mm.tolist(), "radius": piece.radius_mm}
            else:
                shape = _mesh(piece, meshes / f"{name}.ply")
            if material not in surfaces:
                surfaces[material] = _surface(material, folder)
            parts[name] = {**shape, "bsdf": surfaces[material], **_inside(material, folder)}
    step_nm = scene.bands.step_nm
    in_units = lights.radiance_unit(scene.lights, folder, step_nm)
    setting = lights.Setting(folder, step_nm, in_units, reach_mm)
    for number, light in enumerate(scene.lights):
        emitters = lights.emitters(light, setting, mi)
        if isinstance(light, candle.Candle):
            parts |= _candle(light, emitters[0], f"light{number}", folder, meshes)
        else:
            parts |= {f"light{number}_{row}": emitter for row, emitter in enumerate(emitters)}
    return parts


def _reach_mm(piece: Piece | Ball) -> float:
    """Return the distance from the origin to the farthest point of a piece."""
    if isinstance(piece, Ball):
        return float(np.linalg.norm(piece.centre_mm)) + piece.radius_mm
    return float(np.linalg.norm(piece.corners_mm, axis=2).max())


def _candle(light: candle.Candle, emitter: Description, name: str, folder: Path, meshes: Path) -> Description:
    """Return the candle's flame, and its wax if it has any."""
    bodies = {f"{name}_flame": Piece(candle.flame(light), _BLACK)}
    if light.wax_height_mm > 0.0:
        bodies[f"{name}_wax"] = Piece(candle.stem(light), light.wax)
    parts = {
        key: {**_mesh(piece, meshes / f"{key}.ply"), "bsdf": _surface(piece.material, folder)}
        for key, piece in bodies.items()
    }
    parts[f"{name}_flame"]["emitter"] = emitter
    return parts


def _surface(material: Material | Pane, folder: Path) -> Description:
    return panes.bsdf(material, folder) if isinstance(material, Pane) else bsdf(material, folder)


def scene_description(
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
        "far_clip": 1e8,
        "to_world": look,
        "film": bands.film(camera.width_px, camera.height_px),
        "sampler": {"type": "independent"},
    }
    # Russian roulette would end paths by the brightness of four bands, so different paths in each group.
    depth = scene.depth + 1 + (through is not None)
    description = {
        "type": "scene",
        "integrator": {
            "type": _integrator(parts, is_polarised=scene.polarisation),
            "max_depth": depth,
            "rr_depth": depth + 1,
        },
        "camera": sensor,
        **parts,
    }
    if through is not None:
        description["polariser"] = _filter(camera, look, through, mi)
    return description


def _inside(material: Material | Pane, folder: Path) -> Description:
    """Return the medium of a body that absorbs."""
    if not isinstance(material, Glass) or material.absorption is None:
        return {}
    absorption_per_mm = absorption.per_mm(material.absorption, material.index, folder)
    return {"interior": {"type": "homogeneous", "sigma_t": absorption_per_mm, "albedo": 0.0}}


def _integrator(parts: Description, *, is_polarised: bool) -> str:
    """Choose the integrator. The integrator for media weights a path by all bands of a group, because their
    absorption may differ widely. The integrator for panes searches for light through panes.

    Raises InputError for media and polarisation together.
    """
    bodies = [part for part in parts.values() if isinstance(part, dict)]
    if not any("interior" in part for part in bodies):
        has_panes = any(part.get("bsdf", {}).get("type") == panes.PLUGIN for part in bodies)
        return "volpath" if has_panes else "path"
    if is_polarised:
        raise InputError(
            "polarisation: expected no absorbing body (glass with absorption, nashiji), because Mitsuba computes "
            "no Stokes vectors through it; leave out one of the two"
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


def _weathered_shape(piece: Piece | Ball, material: Weathered, path: Path) -> Description:
    if isinstance(piece, Ball):
        corners_mm, smooth = piece.centre_mm + piece.radius_mm * unit_sphere(_BALL_PARTS), True
    else:
        corners_mm, smooth = piece.corners_mm, piece.smooth
    weathered_mesh.write(corners_mm, material, path, smooth=smooth)
    return {"type": "ply", "filename": str(path), "face_normals": not smooth}


def _mesh(piece: Piece, path: Path) -> Description:
    import trimesh

    points, faces = weld_corners(piece.corners_mm)
    normals = None
    if piece.normals is not None:
        normals = np.empty_like(points)
        normals[faces.ravel()] = piece.normals.reshape(-1, 3)
    trimesh.Trimesh(points, faces, vertex_normals=normals, process=False).export(path)
    return {"type": "ply", "filename": str(path), "face_normals": not piece.smooth}
