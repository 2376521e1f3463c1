"""Surfaces of one material, joined and moved: building blocks of the objects' generators.

Everything is in the object's own frame, mm, z up; triangles are counter-clockwise seen from outside.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.shapes.triangles import Array, flat_normals
from sim.scene.surface import Material, Surface


def joined_surface(parts: Sequence[Surface]) -> Surface:
    """One surface from several, with all their materials."""
    first = np.cumsum([0, *(len(part.materials) for part in parts)])
    has_tint = any(part.tint is not None for part in parts)
    has_normals = any(part.normals is not None for part in parts)
    return Surface(
        np.concatenate([part.corners_mm for part in parts]),
        tuple(material for part in parts for material in part.materials),
        np.concatenate([part.material + n for part, n in zip(parts, first, strict=False)]).astype(np.int32),
        np.concatenate([tint_of(part) for part in parts]) if has_tint else None,
        np.concatenate([normals_of(part) for part in parts]) if has_normals else None,
    )


def of_material(corners_mm: Array, material: Material) -> Surface:
    """A surface [triangles, 3, 3] of one material."""
    return Surface(corners_mm, (material,), np.zeros(len(corners_mm), np.int32))


def tint_of(surface: Surface) -> NDArray[np.float32]:
    """[triangles, 3]; ones if the surface has no tint."""
    return np.ones((len(surface.corners_mm), 3), np.float32) if surface.tint is None else surface.tint


def normals_of(surface: Surface) -> Array:
    """[triangles, 3] shading normals; the flat ones if the surface has no others."""
    return flat_normals(surface.corners_mm) if surface.normals is None else surface.normals


def moved_surface(surface: Surface, frame_from_surface: Array) -> Surface:
    """The surface transformed by a rigid 4x4, mm."""
    rotation, origin = frame_from_surface[:3, :3], frame_from_surface[:3, 3]
    normals = None if surface.normals is None else surface.normals @ rotation.T
    return Surface(
        surface.corners_mm @ rotation.T + origin, surface.materials, surface.material, surface.tint, normals
    )
