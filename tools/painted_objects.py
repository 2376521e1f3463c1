"""Five small objects with painted detail of 0.1 to 1 mm on meshes of 0.3 mm triangles, and what their pixels see.

The camera has 256 x 192 pixels of 0.05 mm on the object, a crop of what a sensor of 12 megapixels sees at the same
distance. 45 of the dome's LEDs are lit, in two views. Paint and bumps are layers of the simulator that the meshes
do not have. `plain` has no paint: with it, texels must not be worse than triangles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cells
import numpy as np
import trimesh
from cells import CellFolder
from numpy.typing import NDArray
from relief_cells import SIDE

from coupole.reflectance.new_light.pictured_surface import surface_of_view
from coupole.reflectance.run_result import RunResult, ViewSamples
from coupole.reflectance.texels.pixel_file import ViewTexels
from drawn_records import Scale, draw_records
from sim.optics.blur import defocus_blur_px, through
from sim.optics.objective import Objective
from sim.scene.surface import Layer

Floats = NDArray[np.float64]

SIZE_PX, PITCH_UM, EDGE_MM = (256, 192), 5.8, 0.3
EXTENT_MM, HEIGHT_MM = (14.1, 10.8), 30.0
"""Width and depth of the objects, and the height of their ground above the support, where the views look."""
LENS = Objective(35.0, 335.0, 8.0)
BAYER = np.array([[1, 2], [0, 1]])
LINES_PER_MM = 5.0
LINES = {"period_mm": 1.0 / LINES_PER_MM, "texture": 0.3, "along": (1.0, 0.0, 0.0)}


@dataclass(frozen=True)
class Painted:
    """A shape, its material, and the detail that its mesh does not have."""

    height_mm: Callable[[Floats, Floats], Floats]
    material: dict[str, Any]
    detail: tuple[dict[str, Any], ...] = ()


def _ridge(x: Floats, y: Floats) -> Floats:
    """A bar of 1 mm height whose walls cast shadows."""
    return np.asarray(1.0 / (1.0 + np.exp(-8.0 * (1.2 - np.abs(x + 0.3 * y)))))


def _folds(x: Floats, y: Floats) -> Floats:
    """Grooves with walls of 40 degrees, every 4 mm."""
    return np.asarray(np.tan(np.radians(40.0)) * np.abs((x + 0.2 * y) % 4.0 - 2.0) - 0.8)


def _dome(x: Floats, y: Floats) -> Floats:
    """A cap of a ball of 8 mm radius; its rim is steep."""
    return np.asarray(np.sqrt(np.maximum(64.0 - np.minimum(x**2 + y**2, 59.0), 0.0)) - 5.5)


def _mounds(x: Floats, y: Floats) -> Floats:
    """Hills and pits of 1 mm, 5 mm apart."""
    return np.asarray(0.6 * np.sin(2.0 * np.pi * x / 5.0) * np.cos(2.0 * np.pi * (y - 0.3 * x) / 5.0))


OBJECTS = {
    "ridge": Painted(
        _ridge,
        {"diffuse": (0.5, 0.35, 0.2), "f0": (0.04, 0.04, 0.04), "roughness": 0.4},
        (LINES, {"period_mm": 1.0, "texture": 0.5, "seed": 2}),
    ),
    "folds": Painted(
        _folds,
        {"diffuse": (0.55, 0.5, 0.4), "f0": (0.04, 0.04, 0.04), "roughness": 0.35},
        (LINES, {"period_mm": 0.6, "texture": 0.5, "seed": 3}, {"period_mm": 1.0, "slope_deg": 4.0, "seed": 4}),
    ),
    "dome": Painted(
        _dome,
        {"diffuse": (0.4, 0.3, 0.2), "f0": (0.05, 0.05, 0.05), "roughness": 0.25},
        (LINES, {"period_mm": 0.5, "texture": 0.4, "seed": 5}, {"period_mm": 0.8, "slope_deg": 3.0, "seed": 6}),
    ),
    "mounds": Painted(
        _mounds,
        {"diffuse": (0.3, 0.2, 0.15), "f0": (0.05, 0.05, 0.05), "roughness": 0.3},
        (LINES, {"period_mm": 0.3, "texture": 0.4, "seed": 7}, {"period_mm": 0.9, "slope_deg": 6.0, "seed": 8}),
    ),
    "plain": Painted(_mounds, {"diffuse": (0.45, 0.35, 0.25), "f0": (0.05, 0.05, 0.05), "roughness": 0.3}),
}


def painted_cell(folder: Path, painted_object: Painted, *, every: int, seed: int) -> CellFolder:
    """Write a cell with an object, and its records, which have no errors, to a folder. The arm repeats its places
    exactly: 10 um are a fifth of a pixel, and the truth would be that of other places than the pixels see."""
    cell = CellFolder(folder, speed=10.0)
    mesh_of(painted_object.height_mm).export(folder / "object.ply")
    cell.plan_data["object"]["mesh"] = str(folder / "object.ply")
    cell.rig_data["sensor"] |= {"width_px": SIZE_PX[0], "height_px": SIZE_PX[1], "pixel_pitch_um": PITCH_UM}
    cell.world_settings["robot"] = {
        **cell.world_settings.get("robot", {}),
        "repeatability_um": 0,
        "repeatability_deg": 0,
    }
    cell.world_settings.update(
        white_at_us=8000,
        material=painted_object.material,
        shading="pixel",
        detail=list(painted_object.detail),
        seed=seed,
    )
    cell.write(views=[cells.TOP, SIDE], lights={"kind": "every", "every": every}, darks_per_view=2)
    draw_records(folder / "records", None, Scale(pitch_um=PITCH_UM, size_px=SIZE_PX))
    return cell


def mesh_of(height_mm: Callable[[Floats, Floats], Floats], edge_mm: float = EDGE_MM) -> trimesh.Trimesh:
    """Return the surface over a grid of `edge_mm`, in the support frame. All vertices are on the surface; the
    grid is as large as the object, up to half an edge."""
    columns, rows = (round(extent / edge_mm) for extent in EXTENT_MM)
    x, y = np.meshgrid(
        (np.arange(columns + 1) - columns / 2) * edge_mm, (np.arange(rows + 1) - rows / 2) * edge_mm
    )
    points = np.stack([x, y, HEIGHT_MM + height_mm(x, y)], axis=-1).reshape(-1, 3)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    faces = [[corner, corner + 1, corner + columns + 2], [corner, corner + columns + 2, corner + columns + 1]]
    return trimesh.Trimesh(points, np.concatenate([np.stack(part, axis=1) for part in faces]), process=False)


@dataclass(frozen=True)
class Truth:
    """Paint and normals that the pixels of a view see, through its lens."""

    paint: Floats
    """[h, w] factor of the diffuse reflectance."""
    normals: Floats
    """[h, w, 3] unit, base frame."""
    lines: Floats
    """[h, w] the part of `paint` that is the pattern of lines."""


def truth_of(
    result: RunResult, view: ViewSamples, base_from_camera: Floats, detail: tuple[dict[str, Any], ...]
) -> Truth:
    """Evaluate the layers where the pixels' rays meet the mesh, and blur them as the simulator blurs light."""
    surface, base_from_support = surface_of_view(result, view), result.base_from_support
    is_seen = surface.triangle_of_pixel >= 0
    triangle = surface.triangle_of_pixel[is_seen]
    mesh_normals = surface.normals[triangle]
    row, column = np.nonzero(is_seen)
    focal_px = 1e3 / PITCH_UM * LENS.focal_length_mm * LENS.focus_distance_mm
    focal_px /= LENS.focus_distance_mm - LENS.focal_length_mm
    tangents = [(column - (SIZE_PX[0] - 1) / 2) / focal_px, (row - (SIZE_PX[1] - 1) / 2) / focal_px]
    ways = np.stack([*tangents, np.ones(len(row))], axis=1) @ base_from_camera[:3, :3].T
    ahead_mm = np.sum((surface.centres_mm[triangle] - base_from_camera[:3, 3]) * mesh_normals, axis=1)
    depths_mm = ahead_mm / np.sum(ways * mesh_normals, axis=1)
    places_mm = base_from_camera[:3, 3] + depths_mm[:, None] * ways
    local_mm = (places_mm - base_from_support[:3, 3]) @ base_from_support[:3, :3]
    paint, lines, slope = np.ones(len(local_mm)), np.zeros(len(local_mm)), np.zeros((len(local_mm), 3))
    for layer in detail:
        for *way, phase, texture, height_mm in Layer(**layer).waves():
            angle = local_mm @ np.array(way) + phase
            paint += texture * np.cos(angle)
            lines += texture * np.cos(angle) * (layer is LINES)
            slope -= height_mm * np.sin(angle)[:, None] * (base_from_support[:3, :3] @ np.array(way))
    normals = mesh_normals - slope + np.sum(slope * mesh_normals, axis=1, keepdims=True) * mesh_normals
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    depth_mm = np.full(is_seen.shape, LENS.focus_distance_mm, np.float32)
    depth_mm[is_seen] = depths_mm
    spread_px = defocus_blur_px(LENS, depth_mm, PITCH_UM)

    def blur(values: Floats) -> Floats:
        """The blur is of light, which is not below 0: so 4 is added before it."""
        picture = np.zeros((*is_seen.shape, 3), np.float32)
        picture[is_seen] = (values + 4.0)[:, None]
        sums = through(LENS, picture, spread_px, BAYER, pixel_pitch_um=PITCH_UM).astype(float)
        return np.where(is_seen, sums / np.maximum(weight, 1e-6) - 4.0, 0.0)

    seen_mask = np.repeat(is_seen[..., None], 3, axis=2).astype(np.float32)
    weight = through(LENS, seen_mask, spread_px, BAYER, pixel_pitch_um=PITCH_UM).astype(float)
    seen_normals = np.stack([blur(column) for column in normals.T], axis=-1)
    seen_normals /= np.maximum(np.linalg.norm(seen_normals, axis=-1, keepdims=True), 1e-9)
    return Truth(blur(paint), seen_normals, blur(lines))


def means_of(texels: ViewTexels, truth: Truth) -> tuple[Floats, Floats]:
    """Return the mean paint [n] and normals [n, 3] of the pixels of each texel."""
    number = texels.in_picture(truth.paint.shape).reshape(-1)
    pixels = np.flatnonzero(number >= 0)
    counts = np.bincount(number[pixels])
    paint = np.bincount(number[pixels], truth.paint.reshape(-1)[pixels]) / counts
    sums = [np.bincount(number[pixels], column[pixels]) for column in truth.normals.reshape(-1, 3).T]
    normals = np.stack(sums, axis=1)
    return paint, normals / np.linalg.norm(normals, axis=1, keepdims=True)
