"""A stored scan: in mm, in one folder with its facts; plans and calibrations refer to the mesh in this folder.

The folder holds `mesh.ply` (binary, float32 mm), `targets.csv`, `scan.json`, and a picture, `scan.png`.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import coupole
from coupole.errors import InputError, StorageError
from coupole.scan.mesh import Mesh
from coupole.scan.scanner_export import Scan
from coupole.storage.line_file import utc_now

UNITS = ("mm", "cm", "m", "um", "in")
_PLY_FACE = np.dtype([("corners", "u1"), ("indices", "<u4", (3,))])
_CHUNK = 4_000_000
_SAMPLE = 1_000_000


@contextmanager
def new_scan_folder(folder: Path) -> Iterator[Path]:
    """Make a temporary folder, which is renamed to `folder` on success and removed otherwise.

    Raises InputError if `folder` exists, StorageError if nothing can be written.
    """
    if folder.exists():
        raise InputError(f"--out {folder}: exists already; name a new folder")
    partial = folder.with_name(folder.name + ".part")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        yield partial
        partial.rename(folder)
    except OSError as error:
        raise StorageError(
            f"{folder}: {error.strerror or error}. Choose another folder, or free space."
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_scan(scan: Scan, sources: Sequence[Path], unit: str, folder: Path) -> dict[str, Any]:
    """Write `mesh.ply`, `targets.csv` and `scan.json` into a folder; return the content of `scan.json`.

    `sources` are the scanner's files; `unit` is the unit of the mesh in them. Raises OSError.
    """
    summary = {
        "schema_version": 1,
        "software": f"coupole {coupole.__version__}",
        "imported": utc_now(),
        "sources": [{"name": path.name, "sha256": _sha256(path)} for path in sources],
        "unit_of_mesh": unit,
        **_figures(scan),
    }
    _write_ply(folder / "mesh.ply", scan.mesh.vertices, scan.mesh.triangles)
    if len(scan.targets_mm):
        _write_targets(folder / "targets.csv", scan)
    (folder / "scan.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    return summary


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _figures(scan: Scan) -> dict[str, Any]:
    mesh, defects = scan.mesh, scan.defects
    lengths_mm = edges_mm(mesh)
    figures: dict[str, Any] = {
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "size_mm": np.round(np.ptp(mesh.vertices, axis=0).astype(float), 3).tolist(),
        "low_mm": np.round(mesh.vertices.min(axis=0).astype(float), 3).tolist(),
        "median_edge_mm": round(float(np.median(lengths_mm)), 4),
        "open_edges": defects.open_edges,
        "non_manifold_edges": defects.non_manifold_edges,
        "flipped_edges": defects.flipped_edges,
        "triangles_without_area": defects.degenerate,
        "targets": len(scan.targets_mm),
    }
    if len(scan.targets_mm) > 1:
        nearest_mm, pairs_mm = target_distances_mm(scan.targets_mm)
        counts, borders_mm = np.histogram(pairs_mm, 20)
        figures |= {
            "nearest_targets_mm": [round(float(nearest_mm.min()), 3), round(float(np.median(nearest_mm)), 3)],
            "target_distances": {"borders_mm": np.round(borders_mm, 2).tolist(), "pairs": counts.tolist()},
        }
    return figures


def edges_mm(mesh: Mesh) -> NDArray[np.float64]:
    """Return the lengths of the edges of at most a million triangles."""
    some = mesh.triangles[:: max(1, len(mesh.triangles) // _SAMPLE)]
    corners = mesh.vertices[some].astype(np.float64)
    lengths: NDArray[np.float64] = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).reshape(-1)
    return lengths


def target_distances_mm(targets_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distances from each target to the nearest other one [n], and between all pairs [n (n - 1) / 2]."""
    from scipy.spatial.distance import pdist, squareform

    pairs_mm: NDArray[np.float64] = pdist(targets_mm)
    square = squareform(pairs_mm)
    np.fill_diagonal(square, np.inf)
    return square.min(axis=1), pairs_mm


def _write_ply(path: Path, vertices_mm: NDArray[np.float32], triangles: NDArray[np.uint32]) -> None:
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment mm, the scanner's frame\n"
        f"element vertex {len(vertices_mm)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar uint vertex_indices\nend_header\n"
    )
    with path.open("wb") as file:
        file.write(header.encode())
        vertices_mm.astype("<f4", copy=False).tofile(file)
        for first in range(0, len(triangles), _CHUNK):
            part = triangles[first : first + _CHUNK]
            faces = np.empty(len(part), _PLY_FACE)
            faces["corners"], faces["indices"] = 3, part
            faces.tofile(file)
        file.flush()
        os.fsync(file.fileno())


def _write_targets(path: Path, scan: Scan) -> None:
    columns = ["name", "x_mm", "y_mm", "z_mm"] + (["nx", "ny", "nz"] if scan.target_normals is not None else [])
    rows = [",".join(columns)]
    for row, name in enumerate(scan.target_names):
        numbers = [f"{value:.6f}" for value in scan.targets_mm[row]]
        if scan.target_normals is not None:
            numbers += [f"{value:.8f}" for value in scan.target_normals[row]]
        rows.append(",".join([name, *numbers]))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
