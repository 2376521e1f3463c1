"""KTX 2.0: the maps as textures with mip levels, as graphics cards take them; and the mesh as OBJ.

glTF takes such files only with Basis Universal inside (KHR_texture_basisu), which these do not have: they are for
programs that load textures by themselves.
"""

from __future__ import annotations

import importlib
from pathlib import Path

from coupole.exchange.atlas.flat_surface import FlatSurface, flatten
from coupole.exchange.atlas.ktx2_file import TexelFormat, encode_ktx2
from coupole.exchange.atlas.map_codes import colour_map, normal_map, packed_map, specular_map
from coupole.exchange.atlas.mip_levels import COLOUR, DIRECTION, SHARE, Codes, Meaning, mip_levels
from coupole.exchange.of_results.measured_surface import MeasuredSurface
from coupole.exchange.of_results.obj import MESH, mesh_text
from coupole.storage.durable import write_synced


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """`surface.obj` (metres, y up), `base_color.ktx2` and `specular.ktx2` (BC7, sRGB),
    `occlusion_roughness.ktx2` (BC5: the open sky in red, roughness in green), `normal.ktx2` (8 bits a channel; red
    along the map, green up, blue outwards). Raises ImportError without the packages etcpak and zstandard."""
    for package in ("etcpak", "zstandard"):
        importlib.import_module(package)  # before the work
    flat = flatten(surface)
    most_ks = max(float(flat.ks.max()), 1e-6)
    write_synced(folder / MESH, mesh_text(flat.mesh, surface.remark, None))
    paths = [folder / MESH]

    def add(name: str, codes: Codes, meaning: Meaning, texel_format: TexelFormat, values: str) -> None:
        levels = list(mip_levels(codes, flat.texel_of_place >= 0, meaning))
        notes = _notes(surface, flat, values)
        paths.append(folder / f"{name}.ktx2")
        write_synced(paths[-1], encode_ktx2(levels, texel_format, notes))

    add("base_color", colour_map(flat), COLOUR, TexelFormat.BC7_SRGB, "sRGB of pi kd (kd in 1/sr)")
    specular = specular_map(flat, most_ks)
    add("specular", specular, COLOUR, TexelFormat.BC7_SRGB, f"sRGB of ks / {most_ks:.6g}")
    shares = "red: share of the open sky; green: roughness, the square root of GGX's alpha"
    add("occlusion_roughness", packed_map(flat), SHARE, TexelFormat.BC5, shares)
    normals = normal_map(flat, 8).astype("uint8")
    axes = "(n + 1) / 2; red along the map's columns, green up, blue outwards (MikkTSpace)"
    add("normal", normals, DIRECTION, TexelFormat.RGBA8, axes)
    return paths


def _notes(surface: MeasuredSurface, flat: FlatSurface, values: str) -> dict[str, str]:
    return {
        "KTXorientation": "rd",
        "KTXwriter": f"Coupole {surface.about['software']['coupole']}",
        "coupole.about": surface.remark,
        "coupole.texel_mm": f"{flat.texel_mm:.6g}",
        "coupole.values": values,
    }
