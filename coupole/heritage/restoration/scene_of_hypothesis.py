"""Each hypothesis as a scene for `coupole show` and `coupole render`, with all files that the scene names.

`parts/PART.ply` has the triangles of a part in the mesh's frame, and `files/` has copies of spectra, paints and
maps. `HYPOTHESIS/scene.yaml` names them by relative paths, so that the folder can be moved and sent.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel
from ruamel.yaml import YAML

from coupole.appearance.render.scene_file import files
from coupole.errors import StorageError, reason
from coupole.heritage.restoration.restoration_file import Hypothesis
from coupole.heritage.restoration.restoring import Restoration

SCENE = "scene.yaml"
PARTS, FILES = "parts", "files"


def write_scenes(restoration: Restoration, white_cd_m2: float, out: Path) -> None:
    """Write all scenes and files into `out`; scenes have the white of the restoration's pictures. Raises
    StorageError."""
    try:
        for name, triangles in _triangles_of_parts(restoration):
            (out / PARTS).mkdir(exist_ok=True)
            _write_part(out / PARTS / f"{name}.ply", restoration.mesh.vertices_mm, triangles)
        for hypothesis in restoration.hypotheses:
            text = _scene_text(restoration, hypothesis, white_cd_m2, _Copies(restoration.folder, out))
            (out / hypothesis.name / SCENE).write_text(text, encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{out}: {reason(error)}. Choose another folder, or free space.") from error


# -- helpers --------------------------------------------------------------------------------------------------


class _Copies:
    """Files that scenes name, each copied once into `FILES` under a unique name."""

    def __init__(self, folder: Path, out: Path) -> None:
        self._folder, self._out = folder, out
        self._names: dict[Path, str] = {}

    def relative(self, named_path: Path) -> str:
        """Return the path of a file's copy, relative to the scene in a hypothesis's folder."""
        path = (self._folder / named_path).resolve()
        if path not in self._names:
            used_names = set(self._names.values())
            stems = [path.name, *(f"{number}-{path.name}" for number in range(2, len(used_names) + 3))]
            self._names[path] = next(name for name in stems if name not in used_names)
            (self._out / FILES).mkdir(exist_ok=True)
            copy = self._out / FILES / self._names[path]
            if not (copy.exists() and copy.samefile(path)):
                shutil.copyfile(path, copy)
        return f"../{FILES}/{self._names[path]}"


def _triangles_of_parts(restoration: Restoration) -> Iterator[tuple[str, NDArray[np.int64]]]:
    for row, name in enumerate(restoration.parts.names):
        yield name, restoration.mesh.triangles[restoration.parts.labels == row]


def _write_part(path: Path, vertices_mm: NDArray[np.float64], triangles: NDArray[np.int64]) -> None:
    used_rows, corners = np.unique(triangles, return_inverse=True)
    faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<u4", 3)])
    faces["count"], faces["corners"] = 3, corners.reshape(-1, 3)
    head = (
        f"ply\nformat binary_little_endian 1.0\ncomment mm\nelement vertex {len(used_rows)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar uint vertex_indices\nend_header\n"
    )
    path.write_bytes(head.encode() + vertices_mm[used_rows].astype("<f4").tobytes() + faces.tobytes())


def _scene_text(restoration: Restoration, hypothesis: Hypothesis, white_cd_m2: float, copies: _Copies) -> str:
    """Return the scene as YAML, with the hypothesis and its sources as comments."""
    pose = restoration.restoration_file.object.model_dump(mode="json", exclude_defaults=True)
    stage = _named_anew(restoration.stage, copies) | {
        "schema_version": 1,
        "name": f"{restoration.restoration_file.name}-{hypothesis.name}"[:64],
    }
    parts = [
        {
            "kind": "mesh",
            "path": f"../{PARTS}/{name}.ply",
            "smooth": restoration.restoration_file.smooth,
            "material": _named_anew(hypothesis.materials[name], copies),
            **pose,
        }
        for name in restoration.parts.names
    ]
    stage["objects"] = [*parts, *stage.get("objects", [])]
    stage["display"] = stage.get("display", {}) | {"white_cd_m2": white_cd_m2}
    yaml, stream = YAML(), io.StringIO()
    yaml.width = 1000
    yaml.dump(stage, stream)
    lines = [
        f"Hypothesis {hypothesis.name}: {hypothesis.title}",
        "Computed, not measured. Made by coupole restore; sources:",
        *map(str, hypothesis.sources),
    ]
    return "".join(f"# {' '.join(line.split())}\n" for line in lines) + stream.getvalue()


def _named_anew(model: BaseModel, copies: _Copies) -> dict[str, Any]:
    """Return a model as plain data without its defaults; its paths are replaced by the paths of the copies."""
    plain = model.model_dump(mode="json", exclude_defaults=True)
    for at, path in files(model):
        holder: Any = plain
        for key in at[:-1]:
            holder = holder[key]
        holder[at[-1]] = copies.relative(path)
    return plain
