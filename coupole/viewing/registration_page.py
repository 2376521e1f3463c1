"""`report.html` of a registration: the scans in their places, the mesh, the closing errors of loops,
uncertainties."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import look_at
from coupole.pages.page_parts import Code, Inline, Link, Page, Picture, Section, Table
from coupole.pages.page_rendering import render
from coupole.scan.mesh_bytes import MeshFile
from coupole.scan.mesh_ply import read_ply
from coupole.scan.registration.merging import Merged
from coupole.scan.registration.registering import Registration
from coupole.scan.registration.small_motions import moved_points
from coupole.scan.registration.summary import frame_of_mesh, point_uncertainty_mm, remarks, worst_loop_mm
from coupole.viewing.view_canvas import Canvas, Lookout, seen_faces
from coupole.viewing.view_solids import Points, Solid, with_fewer_faces

REPORT = "report.html"
_SIDES = (("from -y", 15.0, -90.0), ("from +y", 15.0, 90.0), ("from above", 75.0, -90.0))
_UNKNOWN_SIDES = (
    ("from one side", 15.0, -60.0),
    ("from the other side", 15.0, 120.0),
    ("along its width", 75.0, -60.0),
)
"""Views of an object for which the upward direction is not known. The shortest extent is taken for depth."""
_WIDTH_PX, _HEIGHT_PX = 560, 520
_DRAWN_FACES, _DRAWN_POINTS = 300_000, 40_000
_STONE = (0.75, 0.72, 0.66)
_LOOPS_SHOWN, _TARGETS_SHOWN = 12, 60


def write(registration: Registration, merged_mesh: Merged | None, folder: Path, name: str) -> None:
    """Write the report beside the merged scans. The folder gets its `name` when everything is written. Raises
    OSError."""
    placed_count = len(registration.placed_numbers)
    page = Page(
        title=f"{name}: {placed_count} of {len(registration.names)} scans registered",
        pictures=_pictures(registration, merged_mesh, folder),
        summary=f"{len(registration.names)} scans were brought into one frame by {registration.pairs} overlapping "
        "pairs.",
        quality=_quality(registration),
        next_step=_next_step(registration, merged_mesh, name),
        sections=[
            Section(
                "known",
                "What must be known",
                items=[f"{remark[0].upper()}{remark[1:]}." for remark in remarks(registration)],
            ),
            _scans(registration),
            _loops(registration),
            Section("targets", "Targets", tables=[_targets(registration)]),
            Section("files", "Files", tables=[_files(registration, merged_mesh)]),
        ],
    )
    (folder / REPORT).write_text(render(page), encoding="utf-8")


def _quality(registration: Registration) -> str:
    surfaces = f"Overlapping surfaces agree within {registration.fit.rms_mm:.3g} mm"
    if not registration.loops:
        return f"{surfaces}; no loop of pairs closes, so that a wrong pair would not be noticed."
    return f"{surfaces}; loops of pairs close within {worst_loop_mm(registration):.3g} mm at worst."


def _next_step(registration: Registration, merged_mesh: Merged | None, name: str) -> Inline:
    if registration.unplaced_numbers:
        return "For scans that were not placed, scan again with more overlap, or give targets."
    if merged_mesh is None:
        return "Give the command again without --no-mesh to merge the scans."
    return ["Look at the mesh from all sides, then plan its views: ", Code(f"{name}/mesh.ply"), "."]


def _pictures(registration: Registration, merged_mesh: Merged | None, folder: Path) -> list[Picture]:
    points, colours = _scan_points(registration, merged_mesh)
    is_on_site = merged_mesh is not None and registration.is_merged_on_site(merged_mesh.cell_mm)
    axes = np.eye(3) if is_on_site else None
    scans = picture_of(
        sheet_of_sides(points, lambda canvas: canvas.dots(points, colours, 1.5), axes),
        "Each scan in its place in a colour of its own, from three sides",
    )
    if merged_mesh is None:
        return [scans]
    mesh = read_ply(MeshFile(folder / "mesh.ply"))
    vertices = mesh.vertices.astype(np.float64)
    solid = with_fewer_faces(Solid("mesh", vertices, mesh.triangles.astype(np.int64)), _DRAWN_FACES)
    sheet = sheet_of_sides(points, lambda canvas: canvas.fill([solid], [_STONE], has_outline=False), axes)
    return [picture_of(sheet, "The merged mesh, from the same three sides as the scans"), scans]


def picture_of(sheet: Any, title: str) -> Picture:
    """Return a PIL image as a picture as wide as the page."""
    buffer = io.BytesIO()
    sheet.save(buffer, "PNG", optimize=True)
    return Picture(title, buffer.getvalue(), is_broad=True)


def _scan_points(registration: Registration, merged_mesh: Merged | None) -> tuple[Points, Points]:
    """Return the scans' coarse points [n, 3], mm, and their colours, one for each scan. They are in the frame of
    the mesh, or otherwise of the first scan."""
    if merged_mesh is None:
        poses = [registration.first_from_scan[k] for k in registration.placed_numbers]
    else:
        poses = registration.merged_from_scan(merged_mesh.cell_mm)
    clouds = [
        moved_points(pose, registration.scans[k].coarse.points_mm)
        for k, pose in zip(registration.placed_numbers, poses, strict=True)
    ]
    colours = [np.tile(_hue(k / len(clouds)), (len(cloud), 1)) for k, cloud in enumerate(clouds)]
    points, colour = np.concatenate(clouds), np.concatenate(colours)
    if len(points) > _DRAWN_POINTS:
        some = np.random.default_rng(0).choice(len(points), _DRAWN_POINTS, replace=False)
        points, colour = points[some], colour[some]
    return points, colour


def solid_drawn(solid: Solid, colours: Any, axes: Points | None) -> Any:
    """A solid with a colour for each face, from three sides."""
    return sheet_of_sides(
        solid.vertices_mm, lambda canvas: canvas.fill([solid], [colours], has_outline=False), axes
    )


def sheet_of_sides(points: Points, draw: Callable[[Canvas], None], axes: Points | None) -> Any:
    """Return a PIL image from three sides. Each side shows all of the points; `draw` draws on a canvas.

    `axes` [3, 3] are x, y and z of the frame in which z is up, as columns; None if this frame is not known."""
    from PIL import Image, ImageDraw

    sheet = Image.new("RGB", (len(_SIDES) * _WIDTH_PX, _HEIGHT_PX), "white")
    for place, (name, lookout) in enumerate(_lookouts(points, axes)):
        canvas = Canvas(lookout)
        draw(canvas)
        sheet.paste(canvas.image(), (place * _WIDTH_PX, 0))
        ImageDraw.Draw(sheet).text((place * _WIDTH_PX + 10, 8), name, fill="black", font_size=16)
    return sheet


def values_from_sides(solid: Solid, values: Points, axes: Points | None) -> tuple[Points, Points]:
    """Return values [faces] of a solid as seen from three sides, and its brightness, both [h, w]; NaN beside the
    solid.

    `axes` as for `sheet_of_sides`."""
    sheets, shades = [], []
    for _, lookout in _lookouts(solid.vertices_mm, axes):
        face, brightness = seen_faces(lookout, solid)
        sheets.append(np.where(face >= 0, values[face], np.nan))
        shades.append(np.where(face >= 0, brightness[face].astype(np.float64), np.nan))
    return np.concatenate(sheets, axis=1), np.concatenate(shades, axis=1)


def sides_in_words(axes: Points | None) -> str:
    """The three sides, from left to right."""
    return ", ".join(name for name, _, _ in (_UNKNOWN_SIDES if axes is None else _SIDES))


def _lookouts(points: Points, axes: Points | None) -> Iterator[tuple[str, Lookout]]:
    """Yield three sides, with a viewpoint for each from which all points can be seen."""
    low, high = points.min(axis=0), points.max(axis=0)
    size_mm = float(np.linalg.norm(high - low))
    turn = _axes_by_extent(points) if axes is None else axes
    for name, elevation_deg, azimuth_deg in _UNKNOWN_SIDES if axes is None else _SIDES:
        eye = look_at((0, 0, 0), 3 * size_mm, azimuth_deg, elevation_deg)
        eye[:3] = turn @ eye[:3]
        eye[:3, 3] += (low + high) / 2
        yield name, Lookout(eye, 1.1 * _HEIGHT_PX / size_mm, _WIDTH_PX, _HEIGHT_PX, perspective=False)


def _axes_by_extent(points: Points) -> NDArray[np.float64]:
    """Return [3, 3], axes as columns: the longest extent; the shortest, which is taken for depth; and the
    third."""
    _, _, axes = np.linalg.svd(points[:: max(1, len(points) // 5000)] - points.mean(axis=0), full_matrices=False)
    turn = axes[[0, 2, 1]].T
    return np.asarray(turn * np.sign(np.linalg.det(turn)))


def _hue(share: float) -> NDArray[np.float64]:
    thirds = 2 * np.pi * (share + np.array([0, 1 / 3, 2 / 3]))
    return np.asarray(0.5 + 0.35 * np.cos(thirds))


def _files(registration: Registration, merged_mesh: Merged | None) -> Table:
    rows: list[Sequence[Inline]] = [(Link("registration.json"), "poses with covariances, loops, rejected pairs")]
    if merged_mesh is not None:
        frame = frame_of_mesh(registration, merged_mesh)
        cells = f"{merged_mesh.triangles:,} triangles, from cells of {merged_mesh.cell_mm:.3g} mm; frame: {frame}"
        rows.append((Link("mesh.ply"), cells))
        rows += [(Link(name), f"{count:,} points") for name, count in merged_mesh.levels.items()]
    return Table("Files", ("file", "holds"), rows)


def _scans(registration: Registration) -> Section:
    rows = []
    for number, scan in enumerate(registration.scans):
        is_placed = number in registration.placed_numbers
        rows.append(
            (
                scan.name,
                f"{scan.survey.count:,}",
                f"{scan.survey.spacing_mm:.3g}",
                scan.viewpoint.stand,
                f"{point_uncertainty_mm(registration, number):.3g}" if is_placed else "not placed",
            )
        )
    head = ("scan", "points", "spacing, mm", "seen from", "u of its points, mm")
    control = ", or of the control points" if registration.site_from_first is not None else ""
    note = (
        "u: standard uncertainty (68 %) of the points of a scan from its pose, in the frame of the first scan"
        f"{control}."
    )
    return Section("scans", "Scans", tables=[Table("Scans", head, rows)], notes=[note])


def _loops(registration: Registration) -> Section:
    rows = [
        (" - ".join(registration.names[k] for k in loop.scans), f"{loop.error_mm:.3g}", f"{loop.error_deg:.3g}")
        for loop in registration.loops[:_LOOPS_SHOWN]
    ]
    if not rows:
        return Section("loops", "Loops", words=["No pairs form a ring."])
    count = len(registration.loops)
    words = (
        f"{count} ring{'s' if count > 1 else ''} of pairs, each pair adjusted by itself. The worst closing "
        "error is "
        f"{worst_loop_mm(registration):.3g} mm. All uncertainties include a factor of "
        f"{registration.loop_factor:.2f} from the loops."
    )
    table = Table("The worst loops", ("scans in a ring", "mm", "degrees"), rows)
    return Section("loops", "Loops", words=[words], tables=[table])


def _targets(registration: Registration) -> Table:
    sightings = sorted(registration.fit.sightings, key=lambda entry: -entry.left_mm / entry.u_mm)
    rows = [
        (
            sighting.name,
            registration.names[registration.placed_numbers[sighting.scan]],
            f"{sighting.u_mm:.3g}",
            f"{sighting.left_mm:.3g}",
        )
        for sighting in sightings[:_TARGETS_SHOWN]
    ]
    return Table("Targets", ("target", "scan", "stated u, mm", "off, mm"), rows)
