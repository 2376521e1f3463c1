"""MaterialX, by its makers' library, under OpenPBR's model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR

from export_readers.lit_models import Y_UP, Lit, Materials, openpbr
from export_readers.ply import known_triangles

MOST_LOST = 0.1


def relit(folder: Path, lit: Lit) -> np.ndarray:
    """OpenPBR of the texels of the triangles."""
    import MaterialX

    document = MaterialX.createDocument()
    MaterialX.readFromXmlFile(document, str(folder / "surface.mtlx"))
    (shader,) = document.getNodes("open_pbr_surface")

    def texels(name: str) -> np.ndarray:
        file = document.getNode(shader.getInput(name).getNodeName()).getInput("file").getValue()
        ((_, channel),) = OpenEXR.File(str(folder / file)).channels().items()
        return np.asarray(channel.pixels, float).reshape(channel.pixels.shape[0] ** 2, -1)

    uv, normals = _first_corners((folder / "surface.obj").read_text())
    side = round(len(texels("specular_roughness")) ** 0.5)
    place = np.floor((1 - uv[:, 1]) * side).astype(int) * side + np.floor(uv[:, 0] * side).astype(int)
    row = np.searchsorted(known_triangles(folder), lit.triangles)
    normals = normals[row] @ Y_UP
    names = ("base_color", "specular_color", "specular_weight", "specular_roughness")
    base, tint, weight, roughness = (texels(name)[place[row]] for name in names)
    ior = shader.getInput("specular_ior").getValue()
    f0 = ((ior - 1.0) / (ior + 1.0)) ** 2 * weight[:, 0]
    return openpbr(Materials(normals, base, tint, roughness[:, 0] ** 2), lit, f0)


def _first_corners(obj: str) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinate and normal of each face's first corner."""
    lines = [line.split() for line in obj.splitlines()]
    uv, normals = (np.array([line[1:] for line in lines if line[0] == key], float) for key in ("vt", "vn"))
    corners = np.array([line[1].split("/") for line in lines if line[0] == "f"], int) - 1
    return uv[corners[:, 1]], normals[corners[:, 2]]
