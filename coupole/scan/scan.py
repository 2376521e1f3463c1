"""Takes a scanner's mesh and targets in: checked, in mm, in one folder with what was found and a picture.

The folder holds `mesh.ply` (binary, float32 mm), `targets.csv`, `scan.json` and `scan.png`; plans and calibrations
name the mesh from there.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import coupole
from coupole.errors import InputError, StorageError
from coupole.plan.rig import load_class
from coupole.storage import journal

DRIVER = "coupole.scan.scanner_export:read_scan"
UNITS = ("mm", "cm", "m", "um", "in")
_PLY_FACE = np.dtype([("corners", "u1"), ("indices", "<u4", (3,))])
_CHUNK = 4_000_000
_SAMPLE = 1_000_000

Progress = Callable[[str], None]


def import_scan(
    mesh_path: Path,
    targets_path: Path | None,
    folder: Path,
    *,
    unit: str,
    targets_unit: str | None,
    accept_defects: bool,
    progress: Progress,
) -> dict[str, Any]:
    """Read, check and write a scan into a new folder; returns what `scan.json` says.

    Raises InputError for what is wrong with the files, StorageError if the folder cannot be written.
    """
    if folder.exists():
        raise InputError(f"--out {folder}: stands here already; name a new folder")
    read_scan: Any = load_class(DRIVER)
    scan = read_scan(
        mesh_path,
        targets_path,
        unit=unit,
        targets_unit=targets_unit,
        accept_defects=accept_defects,
        progress=progress,
    )
    progress("computing checksums")
    sources = [path for path in (mesh_path, targets_path) if path is not None]
    found = {
        "schema_version": 1,
        "software": f"coupole {coupole.__version__}",
        "imported": journal.utc_now(),
        "sources": [{"name": path.name, "sha256": _sha256(path)} for path in sources],
        "unit_of_mesh": unit,
        **_figures(scan),
    }
    partial = folder.with_name(folder.name + ".part")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        progress("writing")
        _write_ply(partial / "mesh.ply", scan.mesh.vertices, scan.mesh.triangles)
        if len(scan.targets_mm):
            _write_targets(partial / "targets.csv", scan)
        (partial / "scan.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        progress("drawing")
        picture(scan).save(partial / "scan.png")
        partial.rename(folder)
    except OSError as error:
        raise StorageError(
            f"{folder}: {error.strerror or error}. Choose another folder, or free space."
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return found


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _figures(scan: Any) -> dict[str, Any]:
    mesh, defects = scan.mesh, scan.defects
    edges_mm = _edges_mm(mesh)
    figures: dict[str, Any] = {
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "size_mm": np.round(np.ptp(mesh.vertices, axis=0).astype(float), 3).tolist(),
        "low_mm": np.round(mesh.vertices.min(axis=0).astype(float), 3).tolist(),
        "median_edge_mm": round(float(np.median(edges_mm)), 4),
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


def _edges_mm(mesh: Any) -> NDArray[np.float64]:
    """Lengths of the edges of at most a million triangles."""
    some = mesh.triangles[:: max(1, len(mesh.triangles) // _SAMPLE)]
    corners = mesh.vertices[some].astype(np.float64)
    lengths: NDArray[np.float64] = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).reshape(-1)
    return lengths


def target_distances_mm(targets_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """From each target to the next [n], and between all pairs [n (n - 1) / 2]."""
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


def _write_targets(path: Path, scan: Any) -> None:
    columns = ["name", "x_mm", "y_mm", "z_mm"] + (["nx", "ny", "nz"] if scan.target_normals is not None else [])
    rows = [",".join(columns)]
    for row, name in enumerate(scan.target_names):
        numbers = [f"{value:.6f}" for value in scan.targets_mm[row]]
        if scan.target_normals is not None:
            numbers += [f"{value:.8f}" for value in scan.target_normals[row]]
        rows.append(",".join([name, *numbers]))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


# -- the picture ------------------------------------------------------------------------------------------

_WIDTH_PX, _HEIGHT_PX = 640, 560
_DRAWN_FACES = 400_000
_SIDES = (("from above", 90.0, 0.0), ("from the front", 12.0, -90.0), ("from the right", 12.0, 0.0))
_STONE, _STICKER = (0.75, 0.72, 0.66), (0.85, 0.1, 0.1)


def picture(scan: Any) -> Any:
    """The mesh from three sides, its targets as red dots, and how far these are from each other; a PIL image."""
    from PIL import Image, ImageDraw

    from coupole.geometry import look_at
    from coupole.viewing.view_canvas import Canvas, Lookout
    from coupole.viewing.view_solids import Solid, simplified

    mesh = scan.mesh
    low, high = mesh.vertices.min(axis=0).astype(float), mesh.vertices.max(axis=0).astype(float)
    middle, size_mm = (low + high) / 2, float(np.linalg.norm(high - low))
    solid = Solid("mesh", mesh.vertices.astype(np.float64), mesh.triangles.astype(np.int64))
    solid = simplified(solid, _DRAWN_FACES)
    sheet = Image.new("RGB", (2 * _WIDTH_PX, 2 * _HEIGHT_PX), "white")
    for place, (name, elevation_deg, azimuth_deg) in enumerate(_SIDES):
        eye = look_at(tuple(middle), 3 * size_mm, azimuth_deg, elevation_deg)
        canvas = Canvas(Lookout(eye, 0.9 * _HEIGHT_PX / size_mm, _WIDTH_PX, _HEIGHT_PX, perspective=False))
        canvas.fill([solid], [_STONE], outlined=False)
        canvas.dots(scan.targets_mm, _STICKER, 3.0)
        corner = (place % 2 * _WIDTH_PX, place // 2 * _HEIGHT_PX)
        sheet.paste(canvas.image(), corner)
        ImageDraw.Draw(sheet).text((corner[0] + 12, corner[1] + 10), name, fill="black", font_size=18)
    _write_facts(ImageDraw.Draw(sheet), scan, (_WIDTH_PX + 24, _HEIGHT_PX + 10))
    return sheet


def _write_facts(draw: Any, scan: Any, at: tuple[int, int]) -> None:
    size_mm = " x ".join(f"{value:.1f}" for value in np.ptp(scan.mesh.vertices, axis=0))
    lines = [
        f"{len(scan.mesh.triangles):,} triangles, median edge {np.median(_edges_mm(scan.mesh)):.3f} mm",
        f"{size_mm} mm",
        f"{scan.defects.open_edges:,} open edges, {scan.defects.degenerate:,} triangles without area",
        f"{len(scan.targets_mm)} targets",
    ]
    draw.text(at, "\n".join(lines), fill="black", font_size=18)
    if len(scan.targets_mm) < 2:
        return
    _, pairs_mm = target_distances_mm(scan.targets_mm)
    counts, borders_mm = np.histogram(pairs_mm, 40)
    left, bottom, width, height = at[0], 2 * _HEIGHT_PX - 60, _WIDTH_PX - 80, _HEIGHT_PX - 240
    for k, count in enumerate(counts):
        x = left + width * k / len(counts)
        top = bottom - height * count / counts.max()
        draw.rectangle([x, top, x + width / len(counts) - 2, bottom], fill=(120, 130, 150))
    draw.line([(left, bottom), (left + width, bottom)], fill="black")
    draw.text((left, bottom + 8), f"{borders_mm[0]:.1f} mm", fill="black", font_size=16)
    draw.text((left + width, bottom + 8), f"{borders_mm[-1]:.1f} mm", fill="black", font_size=16, anchor="ra")
    draw.text((left, bottom + 28), "distances between targets", fill="black", font_size=16)
