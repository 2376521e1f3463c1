"""PLY, binary: the mesh with each triangle's material, normal and uncertainties as properties of faces."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coupole.exchange.of_results.measured_surface import MeasuredSurface
from coupole.exchange.srgb import srgb
from coupole.storage.durable import write_synced

_COLOURS = ("red", "green", "blue")
_VALUES = (
    *("nx", "ny", "nz", "kd_r", "kd_g", "kd_b", "ks_r", "ks_g", "ks_b", "alpha"),
    *("u_kd", "u_ks", "u_alpha", "u_normal"),
)
_FACE = np.dtype(
    [
        ("count", "u1"),
        ("vertex_indices", "<i4", 3),
        *((name, "u1") for name in _COLOURS),
        *((name, "<f4") for name in _VALUES),
    ]
)


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """Write `surface.ply`: mm, z up; kd in 1/sr, f = kd + ks D V. Red, green and blue are sRGB of pi kd, for
    viewers. If no material is known, values are NaN and colours are grey 128."""
    faces = np.zeros(len(surface.triangles), _FACE)
    faces["count"], faces["vertex_indices"] = 3, surface.triangles
    colours = np.where(surface.has_material[:, None], np.rint(255 * srgb(np.pi * np.nan_to_num(surface.kd))), 128)
    columns = {"alpha": surface.alpha, **surface.uncertain}
    columns |= dict(zip(_COLOURS, colours.T, strict=True))
    columns |= dict(zip(("nx", "ny", "nz"), surface.normals.T, strict=True))
    columns |= {f"kd_{c}": column for c, column in zip("rgb", surface.kd.T, strict=True)}
    columns |= {f"ks_{c}": column for c, column in zip("rgb", surface.ks.T, strict=True)}
    for name, values in columns.items():
        faces[name] = values
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {surface.remark}",
        "comment mm, z up; kd 1/sr, f = kd + ks D V (GGX); u_ are standard uncertainties: relative, u_normal rad",
        f"element vertex {len(surface.vertices_mm)}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        *(f"property uchar {name}" for name in _COLOURS),
        *(f"property float {name}" for name in _VALUES),
        "end_header\n",
    ]
    path = folder / "surface.ply"
    content = [
        "\n".join(head).encode("ascii", "replace"),
        surface.vertices_mm.astype("<f4").tobytes(),
        faces.tobytes(),
    ]
    write_synced(path, b"".join(content))
    return [path]
