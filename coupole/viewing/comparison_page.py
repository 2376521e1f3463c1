"""`report.html` and `maps.ply` of a comparison: where shape and colour changed, by how much, and how surely."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.heritage.comparison.state_comparison import Comparison, Region
from coupole.viewing.page_parts import facts, link, page, picture, section, table, text
from coupole.viewing.registration_page import sheet_of_sides
from coupole.viewing.view_solids import Points, Solid

REPORT, MAPS = "report.html", "maps.ply"
_ENDS = (np.array([0.13, 0.33, 0.62]), np.array([0.93, 0.93, 0.91]), np.array([0.70, 0.35, 0.05]))
"""Colours of distances inwards, of none, and outwards; blue and orange differ to all eyes."""
_UNKNOWN = np.array([0.55, 0.55, 0.58])
_STRONG = np.array([0.35, 0.0, 0.35])
_REGIONS_SHOWN = 20
_SHOWN_QUANTILE = 0.999


def write(comparison: Comparison, folder: Path) -> None:
    """Write the maps as a PLY and the report. Raises OSError."""
    scale_mm = _scale(comparison.distance_mm, comparison.u_mm)
    shape = distance_colours(comparison.distance_mm, scale_mm)
    _write_maps(comparison, shape, folder / MAPS)
    title = f"{text(comparison.before.name)} and {text(comparison.after.name)} compared"
    body = f"<h1>{title}</h1><ul>" + "".join(f"<li>{text(remark)}." for remark in remarks(comparison)) + "</ul>"
    body += section("shape", "Shape", _shape(comparison, shape, scale_mm))
    body += section("colour", "Colour", _colour(comparison))
    files = {
        link(MAPS): "points with distance, uncertainty, colour difference and marks",
        link("comparison.json"): "the regions in figures",
    }
    body += section("files", "Files", facts(files))
    (folder / REPORT).write_text(page("States compared", body), encoding="utf-8")


def remarks(comparison: Comparison) -> Iterator[str]:
    """Yield what the reader of the report must know, one sentence each."""
    is_finite = np.isfinite(comparison.distance_mm)
    yield (
        f"shape: {int(comparison.moved_points.sum()):,} of {int(is_finite.sum()):,} points changed significantly, "
        f"in {len(comparison.shape_regions)} regions; standard uncertainty {np.nanmedian(comparison.u_mm):.2g} mm "
        "in the median"
    )
    if comparison.de00 is None or comparison.recoloured_points is None:
        yield "colour: not compared, as not both states have colours"
    else:
        yield (
            f"colour: {int(comparison.recoloured_points.sum()):,} points changed significantly, in "
            f"{len(comparison.colour_regions)} regions; dE00 {np.nanmedian(comparison.de00):.2f} in the median, "
            "with noise"
        )
    if (~is_finite).any():
        yield f"{int((~is_finite).sum()):,} points have no surface of the other state near them: not compared"
    if comparison.noise_factor > 1.5 or comparison.colour_factor > 1.5:
        yield (
            f"differences scatter {max(comparison.noise_factor, comparison.colour_factor):.1f} times more than "
            "points about their own surface: uncertainties were enlarged by that"
        )
    if comparison.before.outward is None:
        yield "without triangles it is not known which side is out: signs of distances mean nothing"


def _scale(distance_mm: Points, u_mm: Points) -> float:
    sizes_mm = np.abs(distance_mm[np.isfinite(distance_mm)])
    return max(float(np.quantile(sizes_mm, _SHOWN_QUANTILE)), 3 * float(np.nanmedian(u_mm)))


def distance_colours(distance_mm: Points, scale_mm: float) -> Points:
    """[n, 3] of distances, full at `scale_mm`; grey where there is none."""
    share = np.clip(np.nan_to_num(distance_mm / scale_mm), -1, 1)[:, None]
    inward, none, outward = _ENDS
    colours = none + np.where(share < 0, -share * (inward - none), share * (outward - none))
    return np.where(np.isfinite(distance_mm)[:, None], colours, _UNKNOWN)


def _shape(comparison: Comparison, colours: Points, scale_mm: float) -> str:
    figures = _image(comparison, colours, f"Distances: blue {scale_mm:.3g} mm inwards, orange as much outwards")
    figures += _image(comparison, _marks(comparison.moved_points), "Points whose shape changed significantly")
    return figures + _regions("Regions that changed in shape", comparison.shape_regions)


def _colour(comparison: Comparison) -> str:
    if comparison.de00 is None or comparison.recoloured_points is None:
        return ""
    most = max(3.0, float(np.nanquantile(comparison.de00, _SHOWN_QUANTILE)))
    share = np.clip(np.nan_to_num(comparison.de00 / most), 0, 1)[:, None]
    colours = np.where(np.isfinite(comparison.de00)[:, None], _ENDS[1] + share * (_STRONG - _ENDS[1]), _UNKNOWN)
    figures = _image(comparison, colours, f"Colour differences, dE00 under D65: 0 light, {most:.2g} dark")
    figures += _image(
        comparison, _marks(comparison.recoloured_points), "Points whose colour changed significantly"
    )
    return figures + _regions("Regions that changed in colour", comparison.colour_regions)


def _marks(is_marked: NDArray[np.bool_]) -> Points:
    return np.where(is_marked[:, None], _ENDS[2], _ENDS[1])


def _image(comparison: Comparison, colours: Points, caption: str) -> str:
    state = comparison.before
    if len(state.triangles):
        solid = Solid("state", state.points_mm, state.triangles)
        of_faces = colours[state.triangles].mean(axis=1)
        sheet = sheet_of_sides(state.points_mm, lambda canvas: canvas.fill([solid], [of_faces], has_outline=False))
    else:
        some = np.random.default_rng(0).permutation(len(state.points_mm))[:40_000]
        sheet = sheet_of_sides(
            state.points_mm, lambda canvas: canvas.dots(state.points_mm[some], colours[some], 1.5)
        )
    buffer = io.BytesIO()
    sheet.save(buffer, "PNG", optimize=True)
    image = picture("png", buffer.getvalue(), caption)
    return f"<figure>{image}<figcaption>{text(caption)}.</figcaption></figure>"


def _regions(caption: str, regions: Sequence[Region]) -> str:
    rows = [
        (
            ", ".join(f"{value:.1f}" for value in region.middle_mm),
            f"{region.points:,}",
            f"{region.across_mm:.1f}",
            f"{region.distance_mm:+.3f}",
            "" if np.isnan(region.de00) else f"{region.de00:.1f}",
        )
        for region in regions[:_REGIONS_SHOWN]
    ]
    return table(caption, ("middle x, y, z, mm", "points", "across, mm", "mean distance, mm", "mean dE00"), rows)


def _write_maps(comparison: Comparison, colours: Points, path: Path) -> None:
    count = len(comparison.distance_mm)
    fields: list[tuple[str, Any]] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    fields += [("distance_mm", "<f4"), ("u_mm", "<f4"), ("shape_changed", "u1")]
    if comparison.de00 is not None:
        fields += [("de00", "<f4"), ("colour_changed", "u1")]
    rows = np.zeros(count, np.dtype(fields))
    for axis, name in enumerate("xyz"):
        rows[name] = comparison.before.points_mm[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = np.round(255 * colours[:, channel])
    rows["distance_mm"], rows["u_mm"], rows["shape_changed"] = (
        comparison.distance_mm,
        comparison.u_mm,
        comparison.moved_points,
    )
    if comparison.de00 is not None and comparison.recoloured_points is not None:
        rows["de00"], rows["colour_changed"] = comparison.de00, comparison.recoloured_points
    kinds = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", "comment mm", f"element vertex {count}"]
    header += [f"property {kinds[kind]} {name}" for name, kind in fields]
    header += [f"element face {len(comparison.before.triangles)}", "property list uchar uint vertex_indices"]
    faces = np.zeros(len(comparison.before.triangles), np.dtype([("corners", "u1"), ("indices", "<u4", 3)]))
    faces["corners"], faces["indices"] = 3, comparison.before.triangles
    with path.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        rows.tofile(file)
        faces.tofile(file)
