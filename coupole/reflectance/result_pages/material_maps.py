"""Maps of fitted normals and materials with their uncertainty, in the pixels of a view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.pages.maps import eye_map, normal_map, value_map
from coupole.pages.page_parts import Map
from coupole.reflectance.result_pages import lobes_told

Floats = NDArray[np.floating]
_MOST_U_NORMAL_DEG, _MOST_U_PERCENT, _MOST_U_LOBE_PERCENT = 10.0, 10.0, 50.0
_ROUND_ENDS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


@dataclass(frozen=True)
class MapValues:
    """Materials that are drawn, one row for each triangle."""

    pixel_rows: NDArray[np.int32]
    """[h, w] row of the triangle that a pixel sees; below 0 for none."""
    normals: Floats
    """[n, 3]"""
    kd: Floats
    """[n, channels] 1/sr."""
    ks: Floats
    alpha: Floats
    uncertain: Floats
    """[n, 5] standard uncertainties of `ggx.UNKNOWNS`: tilts of the normal, rad; relative, of kd, ks, alpha."""


@dataclass(frozen=True)
class MaterialMaps:
    """Maps of one view."""

    normals: Map
    u_normals: Map
    kd: Map
    u_kd: Map
    lobe: tuple[Map, ...]
    """ks and its uncertainty, alpha and its uncertainty; empty if no lobe is determined."""
    medians: Mapping[str, float]
    """Median over the triangles, by the map's title, of maps of one value."""
    lobe_words: str
    """Sentence about the share of the view where the lobe is determined."""


def material_maps(values: MapValues, *, has_own_scales: bool = False) -> MaterialMaps:
    """Return the maps of a view. A value that is nearly nothing is stated in words, not drawn. Scales of
    uncertainties are the same for all results, or with `has_own_scales` end at a round number above nearly all
    values."""
    pixel_rows, uncertain = values.pixel_rows, values.uncertain
    medians: dict[str, float] = {}

    def one_value(title: str, of_triangles: Floats, unit: str, usual_end: float, *, is_fixed: bool = False) -> Map:
        known_values = of_triangles[np.isfinite(of_triangles)]
        if len(known_values):
            medians[title] = float(np.median(known_values))
        end = _round_end(known_values) if has_own_scales and not is_fixed else usual_end
        return value_map(title, picture_of(pixel_rows, of_triangles), unit, end)

    lobe: tuple[Map, ...] = ()
    is_told = lobes_told.is_told_by_uncertainty(values.ks, uncertain[:, 3])
    share = float(is_told.mean()) if len(is_told) else 0.0
    limit = f"{lobes_told.MOST_RELATIVE_U:.0%}"
    if share < lobes_told.LEAST_SHARE:
        reason = f"ks has a standard uncertainty of more than {limit}"
        words = lobes_told.no_lobe_in_words(share, reason)
    else:
        u_percent = np.where(is_told[:, None], 100 * uncertain[:, 3:5], np.nan)
        ks, alpha = np.where(is_told[:, None], values.ks, np.nan), np.where(is_told, values.alpha, np.nan)
        lobe = (
            eye_map("specular ks", in_three(picture_of(pixel_rows, ks))),
            one_value("standard uncertainty of specular", u_percent[:, 0], "%", _MOST_U_LOBE_PERCENT),
            one_value("roughness alpha", alpha, "", 1.0, is_fixed=True),
            one_value("standard uncertainty of roughness", u_percent[:, 1], "%", _MOST_U_LOBE_PERCENT),
        )
        words = (
            f"The lobe is drawn where ks has a standard uncertainty of at most {limit}: in {share:.0%} of the "
            "triangles."
        )
    u_normals_deg = np.degrees(np.hypot(uncertain[:, 0], uncertain[:, 1]))
    return MaterialMaps(
        normals=normal_map("fitted normals", picture_of(pixel_rows, values.normals)),
        u_normals=one_value(
            "standard uncertainty of fitted normals", u_normals_deg, "degrees", _MOST_U_NORMAL_DEG
        ),
        kd=eye_map("diffuse kd", in_three(picture_of(pixel_rows, values.kd)), unit="1/sr"),
        u_kd=one_value("standard uncertainty of diffuse", 100 * uncertain[:, 2], "%", _MOST_U_PERCENT),
        lobe=lobe,
        medians=medians,
        lobe_words=words,
    )


def _round_end(values: Floats) -> float:
    """Return the smallest round number above 98 % of the values; 100 at most."""
    most = float(np.quantile(values, 0.98)) if len(values) else 0.0
    return next((end for end in _ROUND_ENDS if end >= most), _ROUND_ENDS[-1])


def in_three(values: Floats) -> Floats:
    """Repeat a single channel three times."""
    return values if values.shape[-1] == 3 else np.repeat(values, 3, axis=-1)


def picture_of(triangle_rows: NDArray[np.int32], values: Floats) -> NDArray[np.float32]:
    """[h, w, ...] picture of values [triangles, ...]; NaN where no triangle is seen."""
    picture = np.full((*triangle_rows.shape, *values.shape[1:]), np.nan, np.float32)
    picture[triangle_rows >= 0] = values[triangle_rows[triangle_rows >= 0]]
    return picture
