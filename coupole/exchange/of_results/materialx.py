"""MaterialX 1.39: a document with OpenPBR's surface model, textures of one texel for each triangle, and the mesh.

OpenPBR (Academy Software Foundation, 1.1): colour of the base is pi kd and what the layer keeps from it at normal
incidence, roughness the square root of GGX's alpha. The specular weight scales the reflectance of an index of 1.5
at normal incidence to a triangle's ks, of which the specular colour has the hue. Like glTF's, its specular part
grows towards grazing and takes from the diffuse one what it reflects.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import OpenEXR

from coupole.errors import StorageError, reason
from coupole.exchange.of_results.measured_surface import Y_UP_FROM_SUPPORT, Floats, MeasuredSurface
from coupole.exchange.of_results.texel_layout import middles, texture
from coupole.storage.durable import write_synced

DOCUMENT, MESH = "surface.mtlx", "surface.obj"
_IOR, _F0 = 1.5, 0.04
_SURFACE = "measured_surface"


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """`surface.mtlx`, its textures (OpenEXR, float32, linear) and `surface.obj` (metres, y up, one texture
    coordinate and one normal for each triangle). Triangles without a material are left out."""
    rows = np.flatnonzero(surface.has_material)
    ks = surface.ks[rows]
    most = ks.max(axis=1, keepdims=True)
    textures = {
        "base_color": surface.under_a_layer(rows),
        "specular_color": np.where(most > 0.0, ks / np.maximum(most, 1e-12), 1.0),
        "specular_weight": most / _F0,
        "specular_roughness": np.sqrt(surface.alpha[rows])[:, None],
    }
    paths = [_write_texture(folder / f"{name}.exr", values) for name, values in textures.items()]
    write_synced(folder / DOCUMENT, _document(surface))
    write_synced(folder / MESH, _mesh(surface, rows))
    return [folder / DOCUMENT, folder / MESH, *paths]


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
    for name, kind in inputs.items():
        image = ET.SubElement(root, "image", name=f"{name}_of_triangles", type=kind)
        ET.SubElement(image, "input", name="file", type="filename", value=f"{name}.exr")
        ET.SubElement(image, "input", name="filtertype", type="string", value="closest")
        for axis in ("uaddressmode", "vaddressmode"):
            ET.SubElement(image, "input", name=axis, type="string", value="clamp")
    shader = ET.SubElement(root, "open_pbr_surface", name=_SURFACE, type="surfaceshader")
    for name, kind in inputs.items():
        ET.SubElement(shader, "input", name=name, type=kind, nodename=f"{name}_of_triangles")
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


def _write_texture(path: Path, values: Floats) -> Path:
    texels = texture(values).astype(np.float32)
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
