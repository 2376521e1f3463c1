"""glTF 2.0, binary: the measured surface with its maps.

Colour is pi kd, and roughness is the square root of GGX's alpha. ks is stored as the reflectance at normal
incidence (KHR_materials_specular for an index of 1.5). glTF's own model differs from the fit: its specular part
grows towards grazing by Schlick's formula, and reduces the diffuse part by what it reflects. The colour
compensates this loss at normal incidence.

A material of triangles has one texel for each triangle. With texels, or with a mesh's own texture coordinates,
there are also maps of the normal and of ambient occlusion.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.atlas.flat_surface import FlatSurface, flatten
from coupole.exchange.atlas.map_codes import colour_map, normal_map, packed_map, png, specular_map
from coupole.exchange.of_results.measured_surface import Y_UP_FROM_SUPPORT, Floats, MeasuredSurface, under_a_layer
from coupole.exchange.of_results.texel_layout import middles, texture
from coupole.exchange.srgb import srgb
from coupole.storage.durable import write_synced

_F0 = 0.04
"""Reflectance at normal incidence of an index of 1.5."""
_NEAREST, _LINEAR, _LINEAR_OF_MIPMAPS, _CLAMP = 9728, 9729, 9987, 33071
_FLOAT, _UNSIGNED, _ARRAY_BUFFER, _ELEMENT_BUFFER = 5126, 5125, 34962, 34963
_JSON, _BIN = 0x4E4F534A, 0x004E4942


@dataclass(frozen=True)
class _Contents:
    """Contents of a file: vertices, triangles and pictures."""

    attributes: dict[str, Floats]
    """[v, k] values of vertices, by glTF's names."""
    triangles: NDArray[np.int64] | None
    """[m, 3] vertices of triangles; None if each three vertices are one triangle."""
    pictures: list[bytes]
    """PNG pictures: colour; occlusion, roughness, metal; specular; and normal, if there is one."""
    most_ks: float
    """Value of the brightest code of the specular picture, divided by `_F0`."""
    filters: tuple[int, int]
    """Filters for magnifying and for minifying pictures."""


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """Write `surface.glb`: metres, y up. Triangles without a material are left out."""
    contents = _of_maps(flatten(surface)) if surface.has_maps else _of_triangles(surface)
    arrays = [values.astype("<f4") for values in contents.attributes.values()]
    if contents.triangles is not None:
        arrays.append(contents.triangles.reshape(-1, 1).astype("<u4"))
    path = folder / "surface.glb"
    document = _document(surface, contents, arrays)
    write_synced(path, _glb(document, [*(values.tobytes() for values in arrays), *contents.pictures]))
    return [path]


def _of_triangles(surface: MeasuredSurface) -> _Contents:
    rows = np.flatnonzero(surface.has_material)
    gloss = np.zeros((len(rows), 3))
    gloss[:, 1] = np.sqrt(surface.alpha[rows])
    most_ks = max(float(surface.ks[rows].max(initial=0.0)) / _F0, 1e-6)
    columns = (
        srgb(under_a_layer(surface.kd[rows], surface.ks[rows])),
        gloss,
        srgb(surface.ks[rows] / (_F0 * most_ks)),
    )
    attributes = {
        "POSITION": (surface.vertices_mm[surface.triangles[rows]].reshape(-1, 3) @ Y_UP_FROM_SUPPORT.T) * 1e-3,
        "NORMAL": np.repeat(surface.normals[rows] @ Y_UP_FROM_SUPPORT.T, 3, axis=0),
        "TEXCOORD_0": np.repeat(middles(len(rows)), 3, axis=0),
    }
    return _Contents(
        attributes, None, [_png_of_triangles(values) for values in columns], most_ks, (_NEAREST, _NEAREST)
    )


def _of_maps(flat: FlatSurface) -> _Contents:
    mesh = flat.mesh
    most_ks = max(float(flat.ks.max()) / _F0, 1e-6)
    attributes = {
        "POSITION": (mesh.places_mm @ Y_UP_FROM_SUPPORT.T) * 1e-3,
        "NORMAL": mesh.normals @ Y_UP_FROM_SUPPORT.T,
        "TANGENT": np.column_stack([mesh.tangents @ Y_UP_FROM_SUPPORT.T, mesh.handedness]),
        "TEXCOORD_0": mesh.map_places,
    }
    maps = (colour_map(flat), packed_map(flat), specular_map(flat, _F0 * most_ks), normal_map(flat, 8))
    return _Contents(
        attributes, mesh.triangles, [png(picture) for picture in maps], most_ks, (_LINEAR, _LINEAR_OF_MIPMAPS)
    )


def _document(surface: MeasuredSurface, contents: _Contents, arrays: list[NDArray[Any]]) -> dict[str, Any]:
    views, at = [], 0
    for block in (*(values.tobytes() for values in arrays), *contents.pictures):
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(block)})
        at += _padded_size(len(block))
    for view in views[: len(arrays)]:
        view["target"] = _ARRAY_BUFFER
    primitive = {"attributes": {name: n for n, name in enumerate(contents.attributes)}, "material": 0}
    if contents.triangles is not None:
        primitive["indices"] = len(arrays) - 1
        views[len(arrays) - 1]["target"] = _ELEMENT_BUFFER
    return {
        "asset": {"version": "2.0", "generator": "Coupole", "extras": {"about": surface.remark}},
        "extensionsUsed": ["KHR_materials_specular", "KHR_materials_ior"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "measured surface"}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_material(surface.fit, contents)],
        "textures": [{"sampler": 0, "source": n} for n in range(len(contents.pictures))],
        "samplers": [
            {"magFilter": contents.filters[0], "minFilter": contents.filters[1], "wrapS": _CLAMP, "wrapT": _CLAMP}
        ],
        "images": [
            {"bufferView": len(arrays) + n, "mimeType": "image/png"} for n in range(len(contents.pictures))
        ],
        "accessors": _accessors(arrays),
        "bufferViews": views,
        "buffers": [{"byteLength": at}],
    }


def _accessors(arrays: list[NDArray[Any]]) -> list[dict[str, Any]]:
    accessors: list[dict[str, Any]] = [
        {
            "bufferView": n,
            "componentType": _FLOAT if values.dtype.kind == "f" else _UNSIGNED,
            "count": len(values),
            "type": "SCALAR" if values.shape[1] == 1 else f"VEC{values.shape[1]}",
        }
        for n, values in enumerate(arrays)
    ]
    accessors[0] |= {name: getattr(arrays[0], name)(axis=0).tolist() for name in ("min", "max")}
    return accessors


def _material(name: str, contents: _Contents) -> dict[str, Any]:
    specular = {"specularColorFactor": [contents.most_ks] * 3, "specularColorTexture": {"index": 2}}
    material: dict[str, Any] = {
        "name": name,
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicFactor": 0.0,
            "metallicRoughnessTexture": {"index": 1},
        },
        "extensions": {"KHR_materials_ior": {"ior": 1.5}, "KHR_materials_specular": specular},
    }
    if len(contents.pictures) > 3:
        material |= {"normalTexture": {"index": 3}, "occlusionTexture": {"index": 1}}
    return material


def _png_of_triangles(values: Floats) -> bytes:
    """Values [n, 3] of 0 to 1 as texels."""
    return png(np.rint(255 * np.clip(texture(values), 0.0, 1.0)).astype(np.uint8))


def _glb(document: dict[str, Any], blocks: list[bytes]) -> bytes:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (_padded_size(len(text)) - len(text))
    binary = b"".join(block + bytes(_padded_size(len(block)) - len(block)) for block in blocks)
    total = 12 + 8 + len(text) + 8 + len(binary)

    def words(*numbers: int) -> bytes:
        return b"".join(number.to_bytes(4, "little") for number in numbers)

    head = b"glTF" + words(2, total)
    return head + words(len(text), _JSON) + text + words(len(binary), _BIN) + binary


def _padded_size(size: int) -> int:
    return -(-size // 4) * 4
