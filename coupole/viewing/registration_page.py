"""`report.html` of a registration: the scans in their places, the mesh, how well loops close, uncertainties."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import look_at
from coupole.scan.mesh_bytes import MeshFile
from coupole.scan.mesh_ply import read_ply
from coupole.scan.registration.merging import Merged
from coupole.scan.registration.registering import Registration
from coupole.scan.registration.small_motions import moved_points
from coupole.scan.registration.summary import point_uncertainty_mm, remarks, worst_loop_mm
from coupole.viewing.page_parts import facts, link, page, picture, section, table, text
from coupole.viewing.view_canvas import Canvas, Lookout
from coupole.viewing.view_solids import Points, Solid, with_fewer_faces

REPORT = "report.html"
_SIDES = (("from the front", 15.0, -60.0), ("from the other side", 15.0, 120.0), ("from above", 75.0, -60.0))
_WIDTH_PX, _HEIGHT_PX = 560, 520
_DRAWN_FACES, _DRAWN_POINTS = 300_000, 40_000
_STONE = (0.75, 0.72, 0.66)
_LOOPS_SHOWN, _TARGETS_SHOWN = 12, 60


def write(registration: Registration, merged_mesh: Merged | None, folder: Path) -> None:
    """Write the report beside what was merged. Raises OSError."""
    body = f"<h1>{len(registration.names)} scans registered</h1><ul>"
    body += "".join(f"<li>{text(remark[0].upper() + remark[1:])}." for remark in remarks(registration)) + "</ul>"
    body += section("pictures", "Pictures", _pictures(registration, merged_mesh, folder))
    body += section("files", "Files", _files(merged_mesh))
    body += section("scans", "Scans", _scans(registration))
    body += section("loops", "Loops", _loops(registration))
    body += section("targets", "Targets", _targets(registration))
    (folder / REPORT).write_text(page("Scans registered", body), encoding="utf-8")


def _pictures(registration: Registration, merged_mesh: Merged | None, folder: Path) -> str:
    figures = _image(scans_drawn(registration), "Each scan in its place in a colour of its own, from three sides")
    if merged_mesh is not None:
        mesh = read_ply(MeshFile(folder / "mesh.ply"))
        vertices = mesh.vertices.astype(np.float64)
        solid = with_fewer_faces(Solid("mesh", vertices, mesh.triangles.astype(np.int64)), _DRAWN_FACES)
        figures += _image(solid_drawn(solid, _STONE), "The merged mesh, from three sides")
    return figures


def _image(sheet: Any, alternative: str) -> str:
    buffer = io.BytesIO()
    sheet.save(buffer, "PNG", optimize=True)
    image = picture("png", buffer.getvalue(), alternative)
    return f"<figure>{image}<figcaption>{text(alternative)}.</figcaption></figure>"


def scans_drawn(registration: Registration) -> Any:
    """The scans' coarse points, each scan in a colour of its own, as a PIL image."""
    clouds = [
        moved_points(registration.first_from_scan[k], registration.scans[k].coarse.points_mm)
        for k in registration.placed_numbers
    ]
    colours = [np.tile(_hue(k / len(clouds)), (len(cloud), 1)) for k, cloud in enumerate(clouds)]
    points, colour = np.concatenate(clouds), np.concatenate(colours)
    if len(points) > _DRAWN_POINTS:
        some = np.random.default_rng(0).choice(len(points), _DRAWN_POINTS, replace=False)
        points, colour = points[some], colour[some]
    return sheet_of_sides(points, lambda canvas: canvas.dots(points, colour, 1.5))


def solid_drawn(solid: Solid, colours: Any) -> Any:
    """A solid in one colour, or one for each face, from three sides."""
    return sheet_of_sides(solid.vertices_mm, lambda canvas: canvas.fill([solid], [colours], has_outline=False))


def sheet_of_sides(points: Points, draw: Callable[[Canvas], None]) -> Any:
    """A PIL image from three sides; `draw` draws on a canvas."""
    from PIL import Image, ImageDraw

    low, high = points.min(axis=0), points.max(axis=0)
    size_mm = float(np.linalg.norm(high - low))
    up = _upright(points)
    sheet = Image.new("RGB", (len(_SIDES) * _WIDTH_PX, _HEIGHT_PX), "white")
    for place, (name, elevation_deg, azimuth_deg) in enumerate(_SIDES):
        eye = look_at((0, 0, 0), 3 * size_mm, azimuth_deg, elevation_deg)
        eye[:3] = up @ eye[:3]
        eye[:3, 3] += (low + high) / 2
        canvas = Canvas(Lookout(eye, 1.1 * _HEIGHT_PX / size_mm, _WIDTH_PX, _HEIGHT_PX, perspective=False))
        draw(canvas)
        sheet.paste(canvas.image(), (place * _WIDTH_PX, 0))
        ImageDraw.Draw(sheet).text((place * _WIDTH_PX + 10, 8), name, fill="black", font_size=16)
    return sheet


def _upright(points: Points) -> NDArray[np.float64]:
    """Axes to look along: scans know no upright, so the shortest extent is taken for depth."""
    _, _, axes = np.linalg.svd(points[:: max(1, len(points) // 5000)] - points.mean(axis=0), full_matrices=False)
    turn = axes[[0, 2, 1]].T
    return np.asarray(turn * np.sign(np.linalg.det(turn)))


def _hue(share: float) -> NDArray[np.float64]:
    thirds = 2 * np.pi * (share + np.array([0, 1 / 3, 2 / 3]))
    return np.asarray(0.5 + 0.35 * np.cos(thirds))


def _files(merged_mesh: Merged | None) -> str:
    rows = {link("registration.json"): "poses with covariances, loops, rejected pairs"}
    if merged_mesh is not None:
        rows[link("mesh.ply")] = f"{merged_mesh.triangles:,} triangles, from cells of {merged_mesh.cell_mm:.3g} mm"
        rows |= {link(name): f"{count:,} points" for name, count in merged_mesh.levels.items()}
    return facts(rows)


def _scans(registration: Registration) -> str:
    rows = []
    for number, scan in enumerate(registration.scans):
        is_placed = number in registration.placed_numbers
        rows.append(
            (
                text(scan.name),
                f"{scan.survey.count:,}",
                f"{scan.survey.spacing_mm:.3g}",
                text(scan.viewpoint.stand),
                f"{point_uncertainty_mm(registration, number):.3g}" if is_placed else "not placed",
            )
        )
    head = ("scan", "points", "spacing, mm", "seen from", "u of its points, mm")
    note = (
        "<p>u: standard uncertainty (68 %) of where a scan's pose puts its points, in the frame of the first scan"
    )
    note += ", or of the control points." if registration.site_from_first is not None else "."
    return table("Scans", head, rows) + note


def _loops(registration: Registration) -> str:
    rows: Sequence[Sequence[str]] = [
        (
            text(" - ".join(registration.names[k] for k in loop.scans)),
            f"{loop.error_mm:.3g}",
            f"{loop.error_deg:.3g}",
        )
        for loop in registration.loops[:_LOOPS_SHOWN]
    ]
    if not rows:
        return "<p>No pairs form a ring."
    summary = f"<p>{len(registration.loops)} rings of pairs, each pair adjusted by itself. The worst misses by "
    summary += (
        f"{worst_loop_mm(registration):.3g} mm. All uncertainties hold a factor of {registration.loop_factor:.2f} "
        "by the loops."
    )
    return summary + table("The worst loops", ("scans in a ring", "mm", "degrees"), rows)


def _targets(registration: Registration) -> str:
    rows = [
        (
            text(sighting.name),
            text(registration.names[registration.placed_numbers[sighting.scan]]),
            f"{sighting.u_mm:.3g}",
            f"{sighting.left_mm:.3g}",
        )
        for sighting in sorted(registration.fit.sightings, key=lambda entry: -entry.left_mm / entry.u_mm)[
            :_TARGETS_SHOWN
        ]
    ]
    return table("Targets", ("target", "scan", "stated u, mm", "off, mm"), rows)
