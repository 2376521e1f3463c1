"""Compares two states of an object: aligns them by the unchanged parts, then compares shape and colour at each
point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from coupole.errors import InputError
from coupole.heritage.comparison.local_surface import (
    FREEDOM,
    LocalFits,
    SurfacePoints,
    fit_locally,
)
from coupole.heritage.comparison.result_state import read_result_state
from coupole.heritage.comparison.significance import discoveries, of_lengths, of_vectors
from coupole.heritage.comparison.state_files import Colours, Floats, State, colour_library, read_state
from coupole.heritage.comparison.unchanged_alignment import Alignment, align
from coupole.scan.registration.prepared_scan import thinned_cloud
from coupole.scan.registration.small_motions import inverse_of, moved_points
from coupole.scan.registration.viewpoint import Viewpoint

Say = Callable[[str, int, int], None]
_REACH_SHARE, _REACH_SPACINGS = 0.02, 6.0
"""Largest distance of surfaces that are compared: this share of the size, or so many spacings, whichever is
larger."""
_LEAST_REGION = 3
_SMALLEST_SPREAD = 1e-4
"""Smallest spread of Lab values. It is finer than the steps of 8 bits, and gives equal colours an uncertainty
too."""


@dataclass(frozen=True)
class Region:
    """A region of connected marked points."""

    points: int
    middle_mm: Floats
    """[3] middle of the region, in the frame of the first state."""
    middle_in_after_mm: Floats
    """[3] middle of the region, in the frame of the second state."""
    across_mm: float
    """Largest extent of the region."""
    distance_mm: float
    """Mean of the surface's distances. Positive means outwards, so that material was added."""
    de00: float
    """Mean colour difference; NaN without colours."""


@dataclass(frozen=True)
class Comparison:
    """Changes from one state to another, at the points of the first."""

    before: State
    """First state: points, triangles and colours as they were read."""
    after: State
    """Second state."""
    alignment: Alignment
    """Motion [4, 4] from the second state's frame to the first's, mm, with its covariance."""
    normals: Floats
    """[n, 3] outward unit normals of the first state."""
    distance_mm: Floats
    """[n] along the normals, outwards positive. NaN where the other state has no surface with a similar normal,
    for example in a hollow with a ground that was not measured."""
    u_mm: Floats
    """[n] standard uncertainty."""
    moved_points: NDArray[np.bool_]
    """[n] True where the distance is significant."""
    noise_factor: float
    """Factor by which all uncertainties of distances were enlarged, as the scatter requires."""
    de00: Floats | None
    """[n] CIEDE2000 differences under D65."""
    recoloured_points: NDArray[np.bool_] | None
    """[n] True where the colour differs significantly; None without colours."""
    colour_factor: float
    """Factor by which all uncertainties of colours were enlarged, as the scatter requires."""
    shape_regions: tuple[Region, ...]
    """Regions of `moved_points`, the largest first."""
    colour_regions: tuple[Region, ...]
    """Regions of `recoloured_points`, the largest first."""

    @property
    def upright_axes(self) -> Floats | None:
        """[3, 3] axes x, y and z, as columns, of a state's frame with z up, in the frame of the first state; None
        if no state has such a frame."""
        if self.before.is_upright:
            return np.eye(3)
        return self.alignment.before_from_after[:3, :3] if self.after.is_upright else None


def compare(
    before_path: Path, after_path: Path, unit: str, noise_mm: float | None, *, is_aligned: bool, say: Say
) -> Comparison:
    """Compare two files, or folders of `coupole reflectance`. `noise_mm` is the standard deviation of a point;
    with None it is estimated from the scatter. With `is_aligned`, both files already have the same frame. Raises
    InputError, ExtraMissing."""
    say("reading", 0, 2)
    before = _load_state(before_path, unit)
    say("reading", 1, 2)
    after = _load_state(after_path, unit)
    say("reading", 2, 2)
    if not 0.2 < before.size_mm / after.size_mm < 5:
        raise InputError(
            f"{after_path}: {after.size_mm:.3g} mm in size, {before_path.name} is {before.size_mm:.3g} mm: "
            "is it in another unit, another object, or only a part of it?"
        )
    say("aligning", 0, 1)
    alignment = align(before, after)
    if is_aligned:
        alignment = Alignment(np.eye(4), np.zeros((6, 6)), np.zeros(3), alignment.noise_mm, True)
    say("aligning", 1, 1)
    return _compare_states(before, after, alignment, noise_mm, say)


def _load_state(path: Path, unit: str) -> State:
    return read_result_state(path) if path.is_dir() else read_state(path, unit)


def _compare_states(
    before: State, after: State, alignment: Alignment, noise_mm: float | None, say: Say
) -> Comparison:
    spacing_mm = max(before.spacing_mm, after.spacing_mm)
    reach_mm = max(_REACH_SHARE * before.size_mm, _REACH_SPACINGS * spacing_mm)
    surface = _surface_points(before, np.eye(4))
    other_surface = _surface_points(after, alignment.before_from_after)
    normals, after_mm = surface.normals, other_surface.points_mm
    colours = None
    if before.colours is not None and after.colours is not None:
        colours = before.colours, after.colours
    say("fitting surfaces", 0, 2)
    before_fits = _fits(surface, colours and colours[0], before.points_mm, normals, reach_mm)
    say("fitting surfaces", 1, 2)
    after_fits = _fits(other_surface, colours and colours[1], before.points_mm, normals, reach_mm)
    say("fitting surfaces", 2, 2)
    differences = after_fits.values - before_fits.values
    covariance = before_fits.covariance + after_fits.covariance
    variance = (
        covariance[:, 0, 0]
        if noise_mm is None
        else noise_mm**2 * (before_fits.leverage + after_fits.leverage)[:, 0]
    )
    least_mm = 1e-6 * before.size_mm  # what float32 coordinates tell
    u_mm = np.sqrt(variance + alignment.uncertainty_mm(before.points_mm, normals) ** 2 + least_mm**2)
    p, factor = of_lengths(differences[:, 0], u_mm, 2 * FREEDOM if noise_mm is None else 1e9)
    is_seen = before_fits.is_seen & after_fits.is_seen
    is_moved = discoveries(np.where(is_seen, p, np.nan))
    de00, is_recoloured, colour_factor = None, None, 1.0
    if colours is not None:
        colour_covariance = covariance[:, 1:, 1:] + np.eye(3) * _SMALLEST_SPREAD
        for points_mm, of_state in zip((before.points_mm, after_mm), colours, strict=True):
            colour_covariance = colour_covariance + _of_result(points_mm, of_state, before.points_mm)
        p, colour_factor = of_vectors(differences[:, 1:], colour_covariance, 2 * FREEDOM)
        is_recoloured = discoveries(np.where(is_seen, p, np.nan))
        de00 = np.where(is_seen, de00_of(before_fits.values[:, 1:], after_fits.values[:, 1:]), np.nan)
    comparison = Comparison(
        before, after, alignment, normals, np.where(is_seen, differences[:, 0], np.nan),
        np.where(is_seen, u_mm * factor, np.nan), is_moved, factor, de00, is_recoloured, colour_factor, (), (),
    )  # fmt: skip
    shape = _regions(comparison, is_moved)
    colour = () if is_recoloured is None else _regions(comparison, is_recoloured)
    return Comparison(**{**comparison.__dict__, "shape_regions": shape, "colour_regions": colour})


def _surface_points(state: State, motion: Floats) -> SurfacePoints:
    """A state's points and normals, moved by `motion` [4, 4]."""
    points_mm, normals = moved_points(motion, state.points_mm), _normals(state) @ motion[:3, :3].T
    return SurfacePoints(points_mm, normals, _has_outward(state), state.spacing_mm)


def _has_outward(state: State) -> bool:
    return state.outward is not None and bool(np.linalg.norm(state.outward, axis=1).min() > 0)


def _fits(
    surface: SurfacePoints, colours: Colours | None, places_mm: Floats, normals: Floats, reach_mm: float
) -> LocalFits:
    """Return local fits of shape from all points of a state, and of colour from the points that have one."""
    if colours is None:
        return fit_locally(surface, None, places_mm, normals, reach_mm)
    there = np.asarray(np.isfinite(colours.lab).all(axis=1))
    if there.all():
        return fit_locally(surface, colours.lab, places_mm, normals, reach_mm)
    shape = fit_locally(surface, None, places_mm, normals, reach_mm)
    fits = fit_locally(surface.only(there), colours.lab[there], places_mm, normals, reach_mm)
    for fit_array, of_shape in ((fits.values, shape.values), (fits.leverage, shape.leverage)):
        fit_array[:, 0] = of_shape[:, 0]
    fits.scatter[:, 0, 0] = shape.scatter[:, 0, 0]
    return replace(fits, is_seen=shape.is_seen)


def _of_result(points_mm: Floats, colours: Colours, places_mm: Floats) -> Floats:
    """[n, 3, 3] covariance of a result's colour at places, from the nearest point that has one. The covariance is
    not divided by the number of points around, because these points share most of it."""
    if colours.covariance is None:
        return np.zeros((len(places_mm), 3, 3))
    there = np.isfinite(colours.lab).all(axis=1)
    nearest = cKDTree(points_mm[there]).query(places_mm)[1]
    return np.asarray(colours.covariance[there][nearest])


def _normals(state: State) -> Floats:
    """[n, 3] normals from the triangles. If a state has no triangles, its normals come from neighbouring points,
    and their sign is unknown.
    """
    if state.outward is not None and _has_outward(state):
        return state.outward
    cloud = thinned_cloud(state.points_mm, state.spacing_mm, Viewpoint("none"), state.outward)
    return np.asarray(cloud.normals[cloud.tree.query(state.points_mm)[1]])


def de00_of(lab: Floats, other_lab: Floats) -> Floats:
    """[n] CIEDE2000 between CIELAB values [n, 3] (Luo, Cui, Rigg, Color Res. Appl. 26(5), 2001). Raises
    ExtraMissing."""
    return np.asarray(colour_library().deltaE_ciede2000(lab, other_lab), np.float64)


def _regions(comparison: Comparison, point_mask: NDArray[np.bool_]) -> tuple[Region, ...]:
    """Return the regions, the largest first; single points and groups of a few points are left out."""
    numbers = np.flatnonzero(point_mask)
    if not len(numbers):
        return ()
    points = comparison.before.points_mm[numbers]
    pairs = cKDTree(points).query_pairs(3 * comparison.before.spacing_mm, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), (len(numbers), len(numbers)))
    count, of_point = connected_components(graph, directed=False)
    regions = []
    for number in range(count):
        in_region = of_point == number
        if in_region.sum() < _LEAST_REGION:
            continue
        region_rows = numbers[in_region]
        middle_mm = points[in_region].mean(axis=0)
        regions.append(
            Region(
                len(region_rows),
                middle_mm,
                moved_points(inverse_of(comparison.alignment.before_from_after), middle_mm[None])[0],
                float(np.ptp(points[in_region], axis=0).max()),
                float(np.nanmean(comparison.distance_mm[region_rows])),
                float("nan") if comparison.de00 is None else float(np.nanmean(comparison.de00[region_rows])),
            )
        )
    return tuple(sorted(regions, key=lambda region: -region.points))


def about(comparison: Comparison) -> dict[str, Any]:
    """Return the content of `comparison.json`."""

    def region_entries(regions: tuple[Region, ...]) -> list[dict[str, Any]]:
        return [
            {
                "points": region.points,
                "middle_mm": region.middle_mm.tolist(),
                "middle_in_after_mm": region.middle_in_after_mm.tolist(),
                "across_mm": region.across_mm,
                "distance_mm": region.distance_mm,
                "de00": None if np.isnan(region.de00) else region.de00,
            }
            for region in regions
        ]

    is_known = np.isfinite(comparison.distance_mm)
    colours = None
    if comparison.de00 is not None and comparison.recoloured_points is not None:
        colours = {
            "changed": int(comparison.recoloured_points.sum()),
            "median_de00": float(np.nanmedian(comparison.de00)),
            "largest_de00": float(np.nanmax(comparison.de00)),
            "factor_by_scatter": comparison.colour_factor,
            "regions": region_entries(comparison.colour_regions),
        }
    return {
        "before": comparison.before.name,
        "after": comparison.after.name,
        "before_from_after": comparison.alignment.before_from_after.tolist(),
        "after_from_before": inverse_of(comparison.alignment.before_from_after).tolist(),
        "points": len(is_known),
        "not_comparable": int((~is_known).sum()),
        "shape": {
            "changed": int(comparison.moved_points.sum()),
            "median_mm": float(np.median(np.abs(comparison.distance_mm[is_known]))),
            "largest_mm": float(np.abs(comparison.distance_mm[is_known]).max()),
            "median_u_mm": float(np.nanmedian(comparison.u_mm)),
            "factor_by_scatter": comparison.noise_factor,
            "regions": region_entries(comparison.shape_regions),
        },
        "colour": colours,
    }
