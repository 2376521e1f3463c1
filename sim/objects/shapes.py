"""Shapes for analytic checks and for demonstrations: sphere, sculpted relief."""

from __future__ import annotations

import numpy as np

from coupole.appearance.shapes.solids import relief, unit_sphere
from coupole.errors import InputError
from sim.objects import appearance
from sim.objects.surfaces import of_material
from sim.scene.surface import Material, Surface

_ICOSAHEDRON_FACES = 20


def sphere(radius_mm: float, *, triangles: int = 20_000, material: Material = appearance.SPECTRALON) -> Surface:
    """A closed sphere standing on z = 0: its centre is (0, 0, `radius_mm`). All corners lie on the sphere.

    An icosahedron whose faces are divided into n x n: 20 n^2 triangles, the number nearest to `triangles`.
    """
    if triangles < _ICOSAHEDRON_FACES:
        raise InputError(
            f"sphere: expected at least {_ICOSAHEDRON_FACES} triangles, found {triangles}; ask for more"
        )
    n = round(np.sqrt(triangles / _ICOSAHEDRON_FACES))
    return of_material(radius_mm * unit_sphere(n) + [0.0, 0.0, radius_mm], material)


def glossy_sphere(radius_mm: float, *, triangles: int = 20_000, roughness: float = 0.1) -> Surface:
    """A red sphere under a clear coat, standing on z = 0."""
    material = appearance.glossy("red under a clear coat", (0.45, 0.06, 0.05), roughness)
    return sphere(radius_mm, triangles=triangles, material=material)


def sculpted_relief(
    size_mm: float = 120.0,
    *,
    triangles: int = 100_000,
    depth_mm: float = 18.0,
    seed: int = 1,
    material: Material = appearance.STONE,
) -> Surface:
    """`appearance.shapes.solids.relief` of one material."""
    return of_material(relief(size_mm, triangles, depth_mm, seed), material)
