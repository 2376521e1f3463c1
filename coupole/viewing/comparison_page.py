"""`report.html` and `maps.ply` of a comparison: places, size and certainty of changes of shape and colour."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.heritage.comparison.state_comparison import Comparison, Region
from coupole.pages.maps import shaded_map
from coupole.pages.page_parts import Figure, Inline, Link, Page, Picture, Section, Table
from coupole.pages.page_rendering import render
from coupole.pages.palettes import ANCHORS, colours_of
from coupole.viewing.registration_page import (
    picture_of,
    sheet_of_sides,
    sides_in_words,
    solid_drawn,
    values_from_sides,
)
from coupole.viewing.view_solids import Points, Solid

REPORT, MAPS = "report.html", "maps.ply"
_ENDS = np.array(ANCHORS["signed"])
"""Colours of distances: inwards, zero, and outwards."""
_UNKNOWN = np.array([0.55, 0.55, 0.58])
_REGIONS_SHOWN = 20
_SHOWN_QUANTILE = 0.999


def write(comparison: Comparison, folder: Path) -> None:
    """Write the maps as a PLY and the report. Raises OSError."""
    scale_mm = _scale(comparison.distance_mm, comparison.u_mm)
    shape = distance_colours(comparison.distance_mm, scale_mm)
    _write_maps(comparison, shape, folder / MAPS)
    page = Page(
        title=f"{comparison.before.name} and {comparison.after.name}: compared",
        pictures=[_shape(comparison, shape, scale_mm)],
        summary=f"{int(np.isfinite(comparison.distance_mm).sum()):,} points of {comparison.before.name} were "
        f"compared with the surface of {comparison.after.name}.",
        quality=_quality(comparison),
        next_step=_next_step(comparison),
        sections=[
            Section(
                "known",
                "What must be known",
                items=[f"{remark[0].upper()}{remark[1:]}." for remark in remarks(comparison)],
            ),
            Section(
                "shape",
                "Shape",
                figures=_drawing_of_changed(comparison, comparison.moved_points, "shape"),
                figure_size="wide",
                tables=[_regions("Regions that changed in shape", comparison, comparison.shape_regions)],
                notes=[_frames(comparison)],
            ),
            _colour(comparison),
            Section("files", "Files", tables=[Table("Files", ("file", "holds"), _FILES)]),
        ],
    )
    (folder / REPORT).write_text(render(page), encoding="utf-8")


_FILES = (
    (Link(MAPS), "points with distance, uncertainty, colour difference and marks"),
    (Link("comparison.json"), "the regions in figures"),
)


def _quality(comparison: Comparison) -> str:
    u_mm = float(np.nanmedian(comparison.u_mm))
    count = len(comparison.shape_regions)
    regions = "1 region" if count == 1 else f"{count} regions"
    return (
        f"A distance has a standard uncertainty of {u_mm:.2g} mm (median): "
        f"{int(comparison.moved_points.sum()):,} points "
        f"changed significantly; connected points form {regions}."
    )


def _next_step(comparison: Comparison) -> Inline:
    regions = len(comparison.shape_regions) + len(comparison.colour_regions)
    if not regions:
        return "Nothing: keep both states, and compare the next one with the first."
    link = Link("#shape", "shape") if comparison.shape_regions else Link("#colour", "colour")
    return ["Look at the object where regions of ", link, " are named, the largest first."]


def remarks(comparison: Comparison) -> Iterator[str]:
    """Yield facts that the reader of the report must know, one sentence each."""
    is_finite = np.isfinite(comparison.distance_mm)
    yield (
        f"shape: {int(comparison.moved_points.sum()):,} of {int(is_finite.sum()):,} points changed significantly, "
        f"{_in_regions(comparison.shape_regions, comparison.moved_points)}; standard uncertainty "
        f"{np.nanmedian(comparison.u_mm):.2g} mm in the median"
    )
    if comparison.shape_regions:
        yield _largest(comparison, comparison.shape_regions[0])
    if comparison.de00 is None or comparison.recoloured_points is None:
        yield "colour: not compared, because one of the states has no colours"
    else:
        yield (
            f"colour: {int(comparison.recoloured_points.sum()):,} points changed significantly, "
            f"{_in_regions(comparison.colour_regions, comparison.recoloured_points)}; dE00 "
            f"{np.nanmedian(comparison.de00):.2f} in the median, with noise"
        )
    if (~is_finite).any():
        yield (
            f"{int((~is_finite).sum()):,} points were not compared, because no surface of the other state near "
            "them faces the same way, for example in hollows that were not seen"
        )
    if comparison.noise_factor > 1.5 or comparison.colour_factor > 1.5:
        yield (
            f"differences scatter {max(comparison.noise_factor, comparison.colour_factor):.1f} times as much as "
            "points scatter about their own surface: uncertainties were multiplied by this factor"
        )
    if comparison.before.outward is None:
        yield "without triangles it is not known which side is outside: signs of distances have no meaning"


def _in_regions(regions: Sequence[Region], is_changed: NDArray[np.bool_]) -> str:
    """Return a sentence about the changed points: how many are connected, and in how many regions. The others are
    single points."""
    points_in_regions = sum(region.points for region in regions)
    single = int(is_changed.sum()) - points_in_regions
    if not regions:
        return "none of them in a region" if single else "in no region"
    count = "1 region" if len(regions) == 1 else f"{len(regions)} regions"
    return f"{points_in_regions:,} of them in {count}" + (f", {single:,} scattered" if single else "")


def _largest(comparison: Comparison, region: Region) -> str:
    side = "lower" if region.distance_mm < 0 else "higher"
    place = ", ".join(f"{value:.0f}" for value in region.middle_mm)
    return (
        f"the largest region, {region.across_mm:.3g} mm across, is {abs(region.distance_mm):.2g} mm {side} in "
        f"{comparison.after.name}; its middle is at {place} mm in the frame of {comparison.before.name}"
    )


def _frames(comparison: Comparison) -> str:
    """Return sentences that name the coordinate frames of places and pictures."""
    before, after = comparison.before, comparison.after
    words = f"Places are in the frames of {before.name} and of {after.name}."
    sides = sides_in_words(comparison.upright_axes)
    if comparison.upright_axes is None:
        return f"{words} Pictures, from left to right: {sides}; no file says which way is up."
    upright = before if before.is_upright else after
    return f"{words} Pictures, from left to right: {sides}, by the axes of {upright.name}, in which z is up."


def _scale(distance_mm: Points, u_mm: Points) -> float:
    sizes_mm = np.abs(distance_mm[np.isfinite(distance_mm)])
    return max(float(np.quantile(sizes_mm, _SHOWN_QUANTILE)), 3 * float(np.nanmedian(u_mm)))


def distance_colours(distance_mm: Points, scale_mm: float) -> Points:
    """Return [n, 3] colours of distances, with full colour at `scale_mm`; grey where there is no distance."""
    colours = colours_of(0.5 + 0.5 * np.nan_to_num(distance_mm / scale_mm), "signed")
    return np.where(np.isfinite(distance_mm)[:, None], colours, _UNKNOWN)


def _shape(comparison: Comparison, colours: Points, scale_mm: float) -> Figure:
    title = "Distance of the later state, outwards positive"
    return _map(comparison, comparison.distance_mm, colours, (title, "mm", -scale_mm, scale_mm, "signed"))


def _colour(comparison: Comparison) -> Section:
    if comparison.de00 is None or comparison.recoloured_points is None:
        return Section("colour", "Colour")
    most = max(3.0, float(np.nanquantile(comparison.de00, _SHOWN_QUANTILE)))
    colours = np.where(
        np.isfinite(comparison.de00)[:, None], colours_of(np.nan_to_num(comparison.de00) / most), _UNKNOWN
    )
    return Section(
        "colour",
        "Colour",
        figures=[
            _map(
                comparison, comparison.de00, colours, ("Colour difference under D65", "dE00", 0.0, most, "amount")
            ),
            *_drawing_of_changed(comparison, comparison.recoloured_points, "colour"),
        ],
        figure_size="wide",
        tables=[_regions("Regions that changed in colour", comparison, comparison.colour_regions)],
    )


def _map(
    comparison: Comparison, values: Points, colours: Points, scale: tuple[str, str, float, float, str]
) -> Figure:
    """Draw values of the points [n] on the surface. Points without triangles are drawn in `colours`. `scale` has
    title, unit, lowest and highest value, and palette."""
    title, unit, low, high, palette = scale
    state = comparison.before
    if not len(state.triangles):
        return _image(comparison, colours, f"{title}: {low:.3g} to {high:.3g} {unit}")
    solid = Solid("state", state.points_mm, state.triangles)
    value_sheet, shade = values_from_sides(solid, values[state.triangles].mean(axis=1), comparison.upright_axes)
    return shaded_map(title, value_sheet, shade, unit, high, low=low, palette=palette)


def _marks(is_marked: NDArray[np.bool_]) -> Points:
    return np.asarray(np.where(is_marked[:, None], _ENDS[2], _ENDS[1]))


def _drawing_of_changed(comparison: Comparison, is_changed: NDArray[np.bool_], quantity: str) -> list[Figure]:
    """Draw the points that changed; none if there are none."""
    if not is_changed.any():
        return []
    return [_image(comparison, _marks(is_changed), f"Points whose {quantity} changed significantly are orange")]


def _image(comparison: Comparison, colours: Points, title: str) -> Picture:
    state = comparison.before
    if len(state.triangles):
        of_faces = colours[state.triangles].mean(axis=1)
        solid = Solid("state", state.points_mm, state.triangles)
        return picture_of(solid_drawn(solid, of_faces, comparison.upright_axes), title)
    some = np.random.default_rng(0).permutation(len(state.points_mm))[:40_000]
    sheet = sheet_of_sides(
        state.points_mm,
        lambda canvas: canvas.dots(state.points_mm[some], colours[some], 1.5),
        comparison.upright_axes,
    )
    return picture_of(sheet, title)


def _regions(caption: str, comparison: Comparison, regions: Sequence[Region]) -> Table:
    rows = [
        (
            _place(region.middle_mm),
            _place(region.middle_in_after_mm),
            f"{region.points:,}",
            f"{region.across_mm:.1f}",
            f"{region.distance_mm:+.3f}",
            "" if np.isnan(region.de00) else f"{region.de00:.1f}",
        )
        for region in regions[:_REGIONS_SHOWN]
    ]
    places = (f"middle in {state.name}: x, y, z, mm" for state in (comparison.before, comparison.after))
    return Table(caption, (*places, "points", "across, mm", "mean distance, mm", "mean dE00"), rows)


def _place(point_mm: Points) -> str:
    return ", ".join(f"{value:.1f}" for value in point_mm)


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
