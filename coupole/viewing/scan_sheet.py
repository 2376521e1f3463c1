"""Imports a scanner's mesh and targets, with a picture of the result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from coupole.geometry import look_at
from coupole.scan.scan import edges_mm, new_scan_folder, target_distances_mm, write_scan
from coupole.scan.scanner_export import Scan, read_scan
from coupole.viewing.view_canvas import Canvas, Lookout
from coupole.viewing.view_solids import Solid, with_fewer_faces

Progress = Callable[[str], None]

_WIDTH_PX, _HEIGHT_PX = 640, 560
_DRAWN_FACES = 400_000
_SIDES = (("from above", 90.0, 0.0), ("from the front", 12.0, -90.0), ("from the right", 12.0, 0.0))
_STONE, _STICKER = (0.75, 0.72, 0.66), (0.85, 0.1, 0.1)


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
    """Read and check a scan, write and draw it into a new folder; returns the content of `scan.json`.

    Raises InputError for invalid files, StorageError if the folder cannot be written.
    """
    with new_scan_folder(folder) as partial:
        scan = read_scan(
            mesh_path,
            targets_path,
            unit=unit,
            targets_unit=targets_unit,
            accept_defects=accept_defects,
            progress=progress,
        )
        progress("writing")
        sources = [path for path in (mesh_path, targets_path) if path is not None]
        document = write_scan(scan, sources, unit, partial)
        progress("drawing")
        picture(scan).save(partial / "scan.png")
    return document


def picture(scan: Scan) -> Any:
    """Return a PIL image with the mesh from three sides, its targets as red dots, and the distances between
    these."""
    from PIL import Image, ImageDraw

    mesh = scan.mesh
    low, high = mesh.vertices.min(axis=0).astype(float), mesh.vertices.max(axis=0).astype(float)
    middle, size_mm = (low + high) / 2, float(np.linalg.norm(high - low))
    solid = Solid("mesh", mesh.vertices.astype(np.float64), mesh.triangles.astype(np.int64))
    solid = with_fewer_faces(solid, _DRAWN_FACES)
    sheet = Image.new("RGB", (2 * _WIDTH_PX, 2 * _HEIGHT_PX), "white")
    for place, (name, elevation_deg, azimuth_deg) in enumerate(_SIDES):
        eye = look_at(tuple(middle), 3 * size_mm, azimuth_deg, elevation_deg)
        canvas = Canvas(Lookout(eye, 0.9 * _HEIGHT_PX / size_mm, _WIDTH_PX, _HEIGHT_PX, perspective=False))
        canvas.fill([solid], [_STONE], has_outline=False)
        canvas.dots(scan.targets_mm, _STICKER, 3.0)
        corner = (place % 2 * _WIDTH_PX, place // 2 * _HEIGHT_PX)
        sheet.paste(canvas.image(), corner)
        ImageDraw.Draw(sheet).text((corner[0] + 12, corner[1] + 10), name, fill="black", font_size=18)
    _write_facts(ImageDraw.Draw(sheet), scan, (_WIDTH_PX + 24, _HEIGHT_PX + 10))
    return sheet


def _write_facts(draw: Any, scan: Scan, at: tuple[int, int]) -> None:
    size_mm = " x ".join(f"{value:.1f}" for value in np.ptp(scan.mesh.vertices, axis=0))
    lines = [
        f"{len(scan.mesh.triangles):,} triangles, median edge {np.median(edges_mm(scan.mesh)):.3f} mm",
        f"{size_mm} mm",
        f"{scan.defects.open_edges:,} open edges, {scan.defects.degenerate:,} triangles without area",
        f"{len(scan.targets_mm)} targets",
    ]
    draw.text(at, "\n".join(lines), fill="black", font_size=18)
    if len(scan.targets_mm) < 2:
        return
    _, pairs_mm = target_distances_mm(scan.targets_mm)
    counts, borders_mm = np.histogram(pairs_mm, 40)
    left_px, bottom, width, height = at[0], 2 * _HEIGHT_PX - 60, _WIDTH_PX - 80, _HEIGHT_PX - 240
    for k, count in enumerate(counts):
        x = left_px + width * k / len(counts)
        top = bottom - height * count / counts.max()
        draw.rectangle([x, top, x + width / len(counts) - 2, bottom], fill=(120, 130, 150))
    draw.line([(left_px, bottom), (left_px + width, bottom)], fill="black")
    draw.text((left_px, bottom + 8), f"{borders_mm[0]:.1f} mm", fill="black", font_size=16)
    draw.text((left_px + width, bottom + 8), f"{borders_mm[-1]:.1f} mm", fill="black", font_size=16, anchor="ra")
    draw.text((left_px, bottom + 28), "distances between targets", fill="black", font_size=16)
