"""glTF 2.0, binary: the measured triangles with a texture of one texel for each.

Colour is pi kd, roughness the square root of GGX's alpha, ks stands as the reflectance at normal incidence
(KHR_materials_specular over an index of 1.5). glTF's own model differs from the fit: its specular part grows
towards grazing by Schlick's formula and takes from the diffuse one what it reflects; what it takes at normal
incidence is made up for in the colour.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from coupole.exchange.of_results.measured_surface import Y_UP_FROM_SUPPORT, Floats, MeasuredSurface
from coupole.exchange.of_results.texel_layout import middles, texture
from coupole.exchange.srgb import srgb
from coupole.storage.durable import write_synced

_F0 = 0.04
"""Reflectance at normal incidence of an index of 1.5."""
_NEAREST, _CLAMP = 9728, 33071
_FLOAT, _ARRAY_BUFFER = 5126, 34962
_JSON, _BIN = 0x4E4F534A, 0x004E4942


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """`surface.glb`: metres, y up. Triangles without a material are left out."""
    rows = np.flatnonzero(surface.has_material)
    corners = (surface.vertices_mm[surface.triangles[rows]].reshape(-1, 3) @ Y_UP_FROM_SUPPORT.T) * 1e-3
    normals = np.repeat(surface.normals[rows] @ Y_UP_FROM_SUPPORT.T, 3, axis=0)
    places = np.repeat(middles(len(rows)), 3, axis=0)
    most_ks = max(float(surface.ks[rows].max(initial=0.0)) / _F0, 1e-6)
    gloss = np.zeros((len(rows), 3))
    gloss[:, 1] = np.sqrt(surface.alpha[rows])
    pictures = [
        _png(srgb(surface.under_a_layer(rows))),
        _png(gloss),
        _png(srgb(surface.ks[rows] / (_F0 * most_ks))),
    ]
    arrays = [values.astype("<f4") for values in (corners, normals, places)]
    document = _document(surface, arrays, pictures, most_ks)
    path = folder / "surface.glb"
    write_synced(path, _glb(document, [*(values.tobytes() for values in arrays), *pictures]))
    return [path]


def _document(
    surface: MeasuredSurface, arrays: list[NDArray[np.float32]], pictures: list[bytes], most_ks: float
) -> dict[str, Any]:
    views, at = [], 0
    for block in (*(values.tobytes() for values in arrays), *pictures):
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(block)})
        at += _padded_size(len(block))
    for view in views[: len(arrays)]:
        view["target"] = _ARRAY_BUFFER
    accessors = [
        {"bufferView": n, "componentType": _FLOAT, "count": len(values), "type": f"VEC{values.shape[1]}"}
        for n, values in enumerate(arrays)
    ]
    accessors[0] |= {name: getattr(arrays[0], name)(axis=0).tolist() for name in ("min", "max")}
    specular = {"specularColorFactor": [most_ks] * 3, "specularColorTexture": {"index": 2}}
    return {
        "asset": {"version": "2.0", "generator": "Coupole", "extras": {"about": surface.remark}},
        "extensionsUsed": ["KHR_materials_specular", "KHR_materials_ior"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "measured surface"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, "material": 0}]}],
        "materials": [
            {
                "name": surface.fit,
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicFactor": 0.0,
                    "metallicRoughnessTexture": {"index": 1},
                },
                "extensions": {"KHR_materials_ior": {"ior": 1.5}, "KHR_materials_specular": specular},
            }
        ],
        "textures": [{"sampler": 0, "source": n} for n in range(3)],
        "samplers": [{"magFilter": _NEAREST, "minFilter": _NEAREST, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": [{"bufferView": len(arrays) + n, "mimeType": "image/png"} for n in range(3)],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": at}],
    }


def _png(values: Floats) -> bytes:
    """[n, 3] of 0..1 as texels."""
    texels = np.rint(255 * np.clip(texture(values), 0.0, 1.0)).astype(np.uint8)
    return cv2.imencode(".png", texels[..., ::-1])[1].tobytes()


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
