"""Woven cloth: warp and weft as normal detail on a sheet."""

from __future__ import annotations

import numpy as np

from coupole.appearance.shapes.triangles import Array, cells_for, rectangle
from sim.objects.surfaces import of_material
from sim.scene.surface import Material, Surface

LINEN = Material("linen", (0.55, 0.47, 0.34), (0.04, 0.04, 0.04), 0.5)
"""Material of undyed cloth; all figures are assumed."""
_BULGE_DEG = 50.0
"""Slope at the edge of a thread."""
_DIP_DEG = 25.0
"""Greatest slope along a thread, where it passes under its neighbour."""


def fabric(
    width_mm: float = 60.0,
    depth_mm: float = 60.0,
    *,
    triangles: int = 200_000,
    thread_mm: float = 1.2,
    material: Material = LINEN,
) -> Surface:
    """A flat sheet in z = 0 about the origin, in plain weave: threads are visible in normals and tint.

    Threads are `thread_mm` wide. About six triangles across resolve a thread: a thread of 1.2 mm at 200,000
    triangles on 60 mm has nine.
    """
    columns, rows = cells_for(triangles, width_mm, depth_mm)
    corners = rectangle(width_mm, depth_mm, columns, rows)
    normals, shade = weave(corners.mean(axis=1)[:, :2], thread_mm)
    sheet = of_material(corners, material)
    tint = np.repeat(shade[:, None], 3, axis=1).astype(np.float32)
    return Surface(sheet.corners_mm, sheet.materials, sheet.material, tint, normals)


def weave(places_mm: Array, thread_mm: float) -> tuple[Array, Array]:
    """Normals [n, 3] and shade [n], 0 to 1, of plain weave at places [n, 2].

    If column and row of a thread add up to an even number, the warp (along y) is on top, otherwise the weft (along
    x). Across a thread the normal varies as on a flattened cylinder. Along a thread it varies as on a wave of two
    threads' length.
    """
    cell = np.floor(places_mm / thread_mm)
    within = 2.0 * (places_mm / thread_mm - cell) - 1.0
    warp_on_top = (cell.sum(axis=1) % 2 == 0)[:, None]
    across, along = np.where(warp_on_top, within, within[:, ::-1]).T
    slope_across = np.tan(np.radians(_BULGE_DEG)) * across
    slope_along = np.tan(np.radians(_DIP_DEG)) * np.sin(0.5 * np.pi * along)
    slopes = np.stack([slope_across, slope_along], axis=1)
    slopes = np.where(warp_on_top, slopes, slopes[:, ::-1])
    normals = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals, 1.0 - 0.5 * across**6
