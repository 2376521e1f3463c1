"""The page of a suggested plan: the expected uncertainty over the object, and the plan's cost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.geometry import direction
from coupole.pages.maps import shaded_map
from coupole.pages.page_parts import Code, Map, Page, Section, Table
from coupole.pages.page_rendering import write_page
from coupole.reflectance.suggestion.plan_suggestion import Suggestion
from coupole.reflectance.suggestion.rehearsal import NORMAL_DEG, Rehearsal

Floats = NDArray[np.float64]

_SIDES = {"from the front and above": (-90.0, 40.0), "from behind and above": (90.0, 40.0)}
"""Directions from which the object is drawn: azimuth and elevation, degrees."""
_WIDTH_PX, _HEIGHT_PX = 720, 480
_NEVER_MM = 1e29
_HIGH_QUANTILE = 0.95
_KEYS = ("kd", "ks", "alpha")


def write(path: Path, name: str, suggestion: Suggestion) -> None:
    """Write the page. Raises StorageError."""
    write_page(path, _page(name, suggestion))


def sentences(suggestion: Suggestion) -> list[str]:
    """Say what was chosen, the promised uncertainty, and the cost."""
    report = suggestion.report
    views = f"{len(suggestion.views)} view{'s' if len(suggestion.views) > 1 else ''}"
    exposures = ", ".join(f"{exposure_us / 1000:g}" for exposure_us in suggestion.exposures_us)
    lines = [
        f"{views}, each under {suggestion.leds} LEDs at {exposures} ms: {report.frames:,} frames in "
        f"{report.duration_s / 60:.1f} min, {report.dose_lux_h:.2f} lux h",
        f"{suggestion.known_share:.0%} of the triangles get a normal and a material{_too_fine(suggestion)}",
    ]
    for name, medians in suggestion.medians().items():
        if medians["normal_deg"] is not None:
            shares = ", ".join(f"{key} to {medians[f'{key}_percent']:.2g} %" for key in _KEYS)
            lines.append(f"if {name}: normals to {medians['normal_deg']:.2g} degrees, {shares} (median, standard)")
    return lines


def _too_fine(suggestion: Suggestion) -> str:
    if (count := suggestion.coarser_mesh) is None:
        return ""
    words = "its triangles are smaller than the camera's pixels. Simplify the mesh to about"
    return f": {words} {count:,} triangles, or fit texels"


def _page(name: str, suggestion: Suggestion) -> Page:
    choice_line, share_line, *material_lines = (f"{line[0].upper()}{line[1:]}." for line in sentences(suggestion))
    return Page(
        title=f"{name}: a plan of {len(suggestion.views)} views, before anything is measured",
        pictures=[_map_of_normals(suggestion, name, *side) for name, side in _SIDES.items()],
        summary=choice_line,
        quality=material_lines[0] if material_lines else share_line,
        next_step=[
            "Look at the plan and change what you want, then run ",
            Code(f"coupole check {name}.yaml"),
            ".",
        ],
        remark="Expected, not measured.",
        sections=[
            Section(
                "known",
                "What to expect",
                words=[share_line],
                tables=[_expectation_table(suggestion)],
                notes=_LIMITS,
            ),
            Section("views", "Views, the most informative one first", tables=[_views(suggestion)]),
            Section("warnings", "Preflight's warnings", items=suggestion.report.warnings),
        ],
    )


_LIMITS = (
    "The figures come from the fits themselves, applied to drawn samples that include the frames' "
    "noise, each LED's own power "
    "and place, the noise of the arm's poses, and a highlight with Fresnel's term.",
    "The figures do not include: light from surface to surface, edges of shadows, translucency, errors of the "
    "mesh, the light of two triangles in one pixel, and materials that are not a sum of a matt part and a "
    "highlight. "
    "Where these matter, the uncertainties will be larger.",
)


def _expectation_table(suggestion: Suggestion) -> Table:
    rows = []
    for name, rehearsal in suggestion.rehearsals.items():
        for words, share in (("half of the triangles", 0.5), ("19 of 20", _HIGH_QUANTILE)):
            values = {key: _quantile(values, share) for key, values in rehearsal.uncertainty.items()}
            percents = (_percent(values[f"{key}_percent"]) for key in _KEYS)
            rows.append((name, words, f"{values['normal_deg']:.2g}", *percents))
    return Table("Standard uncertainty, not more than", ("if", "for", "normal, degrees", *_KEYS), rows)


def _percent(value: float) -> str:
    return f"{value:.2g} %" if value <= 100.0 else "not told"


def _quantile(values: Floats, share: float) -> float:
    is_known = np.isfinite(values)
    return float(np.quantile(values[is_known], share)) if is_known.any() else np.nan


def _views(suggestion: Suggestion) -> Table:
    rows = [
        (
            view.name,
            ", ".join(f"{value:g}" for value in view.target_mm),
            f"{view.azimuth_deg:g}",
            f"{view.elevation_deg:g}",
        )
        for view in suggestion.views
    ]
    return Table("Views", ("view", "target, mm", "azimuth, degrees", "elevation, degrees"), rows)


def _map_of_normals(suggestion: Suggestion, title: str, azimuth_deg: float, elevation_deg: float) -> Map:
    """Return the object in a parallel projection, with the expected uncertainty of its normals. The material with
    the least certain normals is shown."""
    least_certain = max(suggestion.rehearsals.values(), key=Rehearsal.normal_deg)
    per_triangle = least_certain.uncertainty[NORMAL_DEG]
    corners_mm, mesh = suggestion.job.shape.corners_mm, suggestion.job.motion.occlusions.mesh
    to_eye = direction(azimuth_deg, elevation_deg)
    right = np.cross([0.0, 0.0, 1.0], to_eye)
    right /= np.linalg.norm(right)
    up = np.cross(to_eye, right)
    points_mm = corners_mm.reshape(-1, 3)
    middle_mm = (points_mm.min(axis=0) + points_mm.max(axis=0)) / 2.0
    across_mm, along_mm = (np.abs((points_mm - middle_mm) @ axis).max() for axis in (right, up))
    pixel_mm = 2.1 * max(across_mm / _WIDTH_PX, along_mm / _HEIGHT_PX)
    reach_mm = 2.0 * float(np.linalg.norm(points_mm - middle_mm, axis=1).max())
    x = (np.arange(_WIDTH_PX) - 0.5 * (_WIDTH_PX - 1)) * pixel_mm
    y = (0.5 * (_HEIGHT_PX - 1) - np.arange(_HEIGHT_PX)) * pixel_mm
    starts_mm = (middle_mm + reach_mm * to_eye + x[None, :, None] * right + y[:, None, None] * up).reshape(-1, 3)
    ways = np.tile(-to_eye, (len(starts_mm), 1)).astype(np.float32)
    hit = np.asarray(mesh.run(starts_mm.astype(np.float32), ways, query="INTERSECT"))
    depth_mm = np.asarray(mesh.run(starts_mm.astype(np.float32), ways, query="DISTANCE"), np.float64)
    is_object = depth_mm < _NEVER_MM
    values, shade = np.full((2, len(starts_mm)), np.nan)
    places_mm = starts_mm[is_object] - depth_mm[is_object, None] * to_eye
    values[is_object] = per_triangle[cKDTree(least_certain.triangles.points_mm).query(places_mm)[1]]
    across = np.cross(*(corners_mm[hit[is_object], k] - corners_mm[hit[is_object], 0] for k in (1, 2)))
    facing = across @ to_eye / np.maximum(np.linalg.norm(across, axis=1), 1e-12)
    shade[is_object] = 0.35 + 0.65 * np.clip(facing, 0.0, 1.0)
    shape = (_HEIGHT_PX, _WIDTH_PX)
    high = float(np.nanquantile(per_triangle, _HIGH_QUANTILE)) if np.isfinite(per_triangle).any() else 1.0
    return shaded_map(
        f"Normals, standard uncertainty, {title}", values.reshape(shape), shade.reshape(shape), "degrees", high
    )
