"""PLY, by trimesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from export_readers.lit_models import Lit, Materials, ggx

MOST_LOST = 1e-4


def relit(folder: Path, lit: Lit) -> np.ndarray:
    """GGX of the faces' properties."""
    faces = _faces(folder / "surface.ply")
    names = ("kd_r", "kd_g", "kd_b", "ks_r", "ks_g", "ks_b", "alpha", "nx", "ny", "nz")
    columns = {name: np.ravel(faces[name]).astype(float)[lit.triangles] for name in names}
    kd, ks = (np.stack([columns[f"{name}_{c}"] for c in "rgb"], axis=1) for name in ("kd", "ks"))
    return ggx(Materials(np.stack([columns[f"n{c}"] for c in "xyz"], 1), kd, ks, columns["alpha"]), lit)


def known_triangles(folder: Path) -> np.ndarray:
    """Triangles that have a material, by the PLY that was exported beside `folder`."""
    return np.flatnonzero(np.isfinite(np.ravel(_faces(folder.parent / "ply/surface.ply")["alpha"])))


def _faces(path: Path) -> np.ndarray:
    return np.asarray(trimesh.load(path, process=False).metadata["_ply_raw"]["face"]["data"])
