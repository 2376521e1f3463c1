"""Wavefront OBJ with a material library: the mesh with smooth normals, and maps as PNG.

The library has the keywords of the format's authors, and later ones for roughness and normals (`map_Pr`, `norm`).
Programs that do not know the later ones show only the colour.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coupole.exchange.atlas.flat_surface import FlatMesh, FlatSurface, flatten
from coupole.exchange.atlas.map_codes import (
    colour_map,
    normal_map,
    roughness_map,
    sky_map,
    specular_map,
    write_png,
)
from coupole.exchange.of_results.measured_surface import Y_UP_FROM_SUPPORT, MeasuredSurface
from coupole.storage.durable import write_synced

MESH, LIBRARY = "surface.obj", "surface.mtl"
MATERIAL = "measured_surface"


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """`surface.obj` (metres, y up), `surface.mtl`, and its maps: `base_color.png` and `specular.png` (sRGB),
    `roughness.png`, `occlusion.png` and `normal.png` (16 bits; red along the map, green up, blue outwards)."""
    flat = flatten(surface)
    most_ks = max(float(flat.ks.max()), 1e-6)
    write_synced(folder / MESH, mesh_text(flat.mesh, surface.remark, LIBRARY))
    write_synced(folder / LIBRARY, _library(surface.remark, most_ks))
    return [folder / MESH, folder / LIBRARY, *write_maps(flat, folder, most_ks)]


def write_maps(flat: FlatSurface, folder: Path, most_ks: float) -> list[Path]:
    """Write the maps; the brightest code of `specular.png` means a ks of `most_ks`."""
    return [
        write_png(folder / "base_color.png", colour_map(flat)),
        write_png(folder / "specular.png", specular_map(flat, most_ks)),
        write_png(folder / "roughness.png", roughness_map(flat)),
        write_png(folder / "occlusion.png", sky_map(flat)),
        write_png(folder / "normal.png", normal_map(flat, 16)),
    ]


def mesh_text(mesh: FlatMesh, remark: str, library: str | None) -> str:
    """Return the mesh as OBJ: metres, y up."""
    places = (mesh.places_mm @ Y_UP_FROM_SUPPORT.T) * 1e-3
    normals = mesh.normals @ Y_UP_FROM_SUPPORT.T
    lines = [f"# {remark}", "# metres, y up"]
    if library:
        lines += [f"mtllib {library}", f"usemtl {MATERIAL}"]
    lines += [f"v {x:.8g} {y:.8g} {z:.8g}" for x, y, z in places.tolist()]
    lines += [f"vt {u:.8f} {1.0 - v:.8f}" for u, v in mesh.map_places.tolist()]
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in normals.tolist()]
    lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in (mesh.triangles + np.int64(1)).tolist()]
    return "\n".join(lines) + "\n"


def _library(remark: str, most_ks: float) -> str:
    return (
        f"# {remark}\n"
        f"# specular.png times {most_ks:.6g} is ks; roughness is the square root of GGX's alpha\n"
        f"newmtl {MATERIAL}\n"
        "Kd 1 1 1\n"
        "map_Kd base_color.png\n"
        f"Ks {most_ks:.6g} {most_ks:.6g} {most_ks:.6g}\n"
        "map_Ks specular.png\n"
        "map_Pr roughness.png\n"
        "map_Ka occlusion.png\n"
        "norm normal.png\n"
        "illum 2\n"
    )
