"""MaterialX 1.39: a document with OpenPBR's surface model, textures, and the mesh.

A material of triangles has one texel for each triangle; a material of texels has maps, also of the normal.

OpenPBR (Academy Software Foundation, 1.1): the base colour is pi kd, plus the share that the layer takes from it
at normal incidence; roughness is the square root of GGX's alpha. The specular weight scales the reflectance of an
index of 1.5 at normal incidence to a triangle's ks; the specular colour has the hue of ks. As in glTF, the
specular part grows towards grazing, and reduces the diffuse part by what it reflects.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from coupole.errors import StorageError, reason
from coupole.exchange.atlas.flat_surface import flatten
from coupole.exchange.of_results.measured_surface import Y_UP_FROM_SUPPORT, MeasuredSurface, under_a_layer
from coupole.exchange.of_results.obj import mesh_text
from coupole.exchange.of_results.texel_layout import middles, texture
from coupole.storage.durable import write_synced

DOCUMENT, MESH = "surface.mtlx", "surface.obj"
_IOR, _F0 = 1.5, 0.04
_SURFACE, _NORMAL = "measured_surface", "normal_of_surface"


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """`surface.mtlx`, its textures (OpenEXR, float32, linear) and `surface.obj` (metres, y up). Triangles without
    a material are left out."""
    if surface.has_maps:
        flat = flatten(surface)
        mesh = mesh_text(flat.mesh, surface.remark, None)
        columns = _columns(under_a_layer(flat.kd, flat.ks), flat.ks, flat.alpha) | {
            "normal": 0.5 * flat.normals_in_frames + 0.5
        }
        textures = {name: flat.map_of(values.astype(np.float32)) for name, values in columns.items()}
    else:
        rows = np.flatnonzero(surface.has_material)
        mesh = _mesh(surface, rows)
        columns = _columns(
            under_a_layer(surface.kd[rows], surface.ks[rows]), surface.ks[rows], surface.alpha[rows]
        )
        textures = {name: texture(values).astype(np.float32) for name, values in columns.items()}
    paths = [_write_texture(folder / f"{name}.exr", texels) for name, texels in textures.items()]
    write_synced(folder / DOCUMENT, _document(surface))
    write_synced(folder / MESH, mesh)
    return [folder / DOCUMENT, folder / MESH, *paths]


def _columns(colours: NDArray[Any], ks: NDArray[Any], alpha: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Values [n, 1 or 3] of texels, by OpenPBR's names."""
    most = ks.max(axis=1, keepdims=True)
    return {
        "base_color": colours,
        "specular_color": np.where(most > 0.0, ks / np.maximum(most, 1e-12), 1.0),
        "specular_weight": most / _F0,
        "specular_roughness": np.sqrt(alpha)[:, None],
    }


def _document(surface: MeasuredSurface) -> bytes:
    head = {"version": "1.39", "colorspace": "lin_rec709"}
    root = ET.Element("materialx", head)
    root.append(ET.Comment(re.sub("-(?=-)", "- ", f" {surface.remark} ")))
    inputs = {
        "base_color": "color3",
        "specular_color": "color3",
        "specular_weight": "float",
        "specular_roughness": "float",
    }
    suffix, filtering = ("of_texels", "linear") if surface.has_maps else ("of_triangles", "closest")
    for name, kind in (inputs | ({"normal": "vector3"} if surface.has_maps else {})).items():
        image = ET.SubElement(root, "image", name=f"{name}_{suffix}", type=kind)
        ET.SubElement(image, "input", name="file", type="filename", value=f"{name}.exr")
        ET.SubElement(image, "input", name="filtertype", type="string", value=filtering)
        for axis in ("uaddressmode", "vaddressmode"):
            ET.SubElement(image, "input", name=axis, type="string", value="clamp")
    if surface.has_maps:
        frame = ET.SubElement(root, "normalmap", name=_NORMAL, type="vector3")
        ET.SubElement(frame, "input", name="in", type="vector3", nodename=f"normal_{suffix}")
    shader = ET.SubElement(root, "open_pbr_surface", name=_SURFACE, type="surfaceshader")
    for name, kind in inputs.items():
        ET.SubElement(shader, "input", name=name, type=kind, nodename=f"{name}_{suffix}")
    if surface.has_maps:
        ET.SubElement(shader, "input", name="geometry_normal", type="vector3", nodename=_NORMAL)
    ET.SubElement(shader, "input", name="specular_ior", type="float", value=str(_IOR))
    material = ET.SubElement(root, "surfacematerial", name=f"{_SURFACE}_material", type="material")
    ET.SubElement(material, "input", name="surfaceshader", type="surfaceshader", nodename=_SURFACE)
    look = ET.SubElement(root, "look", name="measured")
    ET.SubElement(look, "materialassign", name="whole", material=f"{_SURFACE}_material", geom="*")
    ET.indent(root)
    text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _mesh(surface: MeasuredSurface, known_triangles: np.ndarray[tuple[int], np.dtype[np.int64]]) -> str:
    vertices, corner = np.unique(surface.triangles[known_triangles], return_inverse=True)
    places = (surface.vertices_mm[vertices] @ Y_UP_FROM_SUPPORT.T) * 1e-3
    normals = surface.normals[known_triangles] @ Y_UP_FROM_SUPPORT.T
    texels = middles(len(known_triangles))
    number = np.arange(1, len(known_triangles) + 1)
    lines = [f"# {surface.remark}", "# metres, y up; the material is in surface.mtlx"]
    lines += [f"v {x:.8g} {y:.8g} {z:.8g}" for x, y, z in places.tolist()]
    lines += [f"vt {u:.8f} {1.0 - v:.8f}" for u, v in texels.tolist()]
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in normals.tolist()]
    for n, (a, b, c) in zip(number.tolist(), (corner.reshape(-1, 3) + 1).tolist(), strict=True):
        lines.append(f"f {a}/{n}/{n} {b}/{n}/{n} {c}/{n}/{n}")
    return "\n".join(lines) + "\n"


def _write_texture(path: Path, texels: NDArray[np.float32]) -> Path:
    channels = {"RGB": texels} if texels.shape[2] == 3 else {"Y": texels[..., 0].copy()}
    partial = path.with_name(f".{path.name}.part")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        OpenEXR.File(header, channels).write(str(partial))
        partial.replace(path)
    except (OSError, RuntimeError) as error:
        raise StorageError(f"{path}: {reason(error)}") from error
    finally:
        partial.unlink(missing_ok=True)
    return path
