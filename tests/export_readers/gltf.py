"""glTF, from its layout, under its own model of materials."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from export_readers.lit_models import Y_UP, Lit, Materials, gltf
from export_readers.ply import known_triangles

MOST_LOST = 0.03


def relit(folder: Path, lit: Lit) -> np.ndarray:
    """glTF's model of the texels of the triangles."""
    data = (folder / "surface.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]

    def block(number: int) -> bytes:
        view = document["bufferViews"][number]
        return binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

    def texels(texture: int) -> np.ndarray:
        png = block(document["images"][document["textures"][texture]["source"]]["bufferView"])
        bgr = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert bgr is not None, "a texture is no picture"
        return bgr[..., ::-1].reshape(-1, 3) / 255.0

    row = np.searchsorted(known_triangles(folder), lit.triangles)
    normals = np.frombuffer(block(1), "<f4").reshape(-1, 3, 3)[row, 0].astype(float) @ Y_UP
    specular = document["materials"][0]["extensions"]["KHR_materials_specular"]
    f0 = 0.04 * np.array(specular["specularColorFactor"]) * _linear(texels(2)[row])
    return gltf(Materials(normals, _linear(texels(0)[row]), f0, texels(1)[row, 1] ** 2), lit)


def _linear(code: np.ndarray) -> np.ndarray:
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
