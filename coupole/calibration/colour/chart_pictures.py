"""The chart in plain linear pictures of any camera: its place, its orientation, and the signals of its patches.

The middles of the corner patches are given, or searched for (`chart_search`). The colours identify the corners.
All orders of the corners are tried, and the order is taken for which a matrix converts the patches best into the
chart's colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.colour.chart import Chart, KnownChart
from coupole.calibration.colour.chart_search import search_corners
from coupole.calibration.colour.chart_signals import Reading, pixels_inside
from coupole.calibration.colour.colorimetry import de00, lab_of
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

_LARGEST_MISS = 15.0
"""Largest mean CIEDE2000 of the patches, after conversion by the best matrix alone, with which the chart counts as
found."""
_BETTER = 1.25
"""Least ratio of the error of the second best order of corners to the error of the best order. Above this ratio
the best order is certain."""
_LEAST_PIXELS = 36
_SIDE_TILES = 6
"""Greatest number of tiles along a patch's side. The tiles show the noise and evenness of the patch."""
_TILE_PIXELS = 4
_UNEVEN = 0.05
"""Root mean square of a patch's tiles about a plane, beyond noise, as a share of the patch's mean. Above it the
patch is uneven."""
_FULL_SHARE = 1e-3
"""Share of a patch's pixels that may be saturated, because some pixels are hot."""
_STUCK_SHARE = 0.3
"""Share of a patch's pixels that have the largest value of the picture. Above it, a converter has cut off the
values there."""
_LEVELS_FOR_STUCK = 4096
_MOST_UNEVEN = 1.0 / 3.0
"""Share of uneven patches above which the chart's place must be wrong."""


@dataclass(frozen=True)
class PlainPicture:
    """A linear picture in three colours."""

    name: str
    values: NDArray[np.float32]
    """[H, W, 3] red, green, blue in any unit; NaN where the value is not known."""
    full: NDArray[np.bool_]
    """[H, W] True where a channel is saturated."""
    levels: int | None = None
    """Number of levels of a value; None for floating point."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.values.shape[1], self.values.shape[0]

    @cached_property
    def largest(self) -> Floats:
        """[3] largest value of each channel."""
        return np.asarray(np.nanmax(self.values, axis=(0, 1)))


@dataclass(frozen=True)
class PlacedChart:
    """The chart in one picture."""

    corners_px: Floats
    """[4, 2] middles of the chart's own patches at the top left, top right, bottom right and bottom left."""
    is_turned: bool
    """True if the corners were given in another order, or the chart is not upright in the picture."""

    def polygons_px(self, chart: Chart, polygons_mm: Floats) -> Floats:
        """Return [n, 4, 2] px for polygons [n, 4, 2] mm of the chart's face."""
        flat = polygons_mm.reshape(1, -1, 2).astype(np.float64)
        if not flat.size:
            return polygons_mm
        at = cv2.perspectiveTransform(flat, _projection(chart, self.corners_px))
        return np.asarray(at, np.float64).reshape(-1, 4, 2)


def place_chart(picture: PlainPicture, known_chart: KnownChart, corners_px: Floats | None = None) -> PlacedChart:
    """Find the chart. `corners_px` [4, 2] are the middles of its corner patches in turn, beginning at any of them.

    Raises InputError if there is no chart or another one, if the picture is mirrored, or if the chart looks the
    same from several sides.
    """
    chart = known_chart.chart
    if min(chart.rows, chart.columns) < 2:
        raise InputError("colour: pictures need a chart of two rows and two columns or more; found one line")
    if corners_px is None:
        places = search_corners(picture.values, chart.rows, chart.columns)
        if not places:
            raise InputError(
                f"{picture.name}: the chart was not found: expected a sharp picture of the whole chart, "
                f"{chart.rows} rows of {chart.columns} even patches, each at least 10 pixels wide if the picture "
                "has 900; or give the middles of the corner patches with --corners"
            )
    else:
        places = [corners_px]
    turned_places = [np.roll(place, shift, axis=0) for place in places for shift in range(4)]
    both_ways = [corners for place in turned_places for corners in (place, place[::-1])]
    ways = [(_miss(picture, known_chart, corners), corners) for corners in both_ways]
    ahead = sorted((way for way in ways if _area(way[1]) > 0.0), key=lambda way: way[0])
    mirrored_miss = min((way[0] for way in ways if _area(way[1]) < 0.0), default=np.inf)
    least_miss = min(ahead[0][0] if ahead else np.inf, mirrored_miss)
    if not ahead or least_miss > _LARGEST_MISS:
        _refuse_miss(picture, least_miss, is_given=corners_px is not None)
    miss, corners = ahead[0]
    if mirrored_miss * _BETTER < miss:
        raise InputError(
            f"{picture.name}: the chart is seen mirrored: turn the picture over; or, if the letters of the "
            "patches' names count columns, describe the chart in YAML with `names`"
        )
    step = np.linalg.norm(corners[1] - corners[0]) / max(chart.columns - 1, 1)
    other_misses = [way[0] for way in ahead if np.abs(way[1] - corners).max() > 0.5 * step]
    if other_misses and other_misses[0] < _BETTER * miss:
        raise InputError(
            f"{picture.name}: the chart's patches fit in two ways (mean CIEDE2000 {miss:.1f} and "
            f"{other_misses[0]:.1f}); light it more evenly, or give --corners and patches of more hues"
        )
    upright = corners[0] if corners_px is None else corners_px[0]
    is_turned = bool(np.abs(corners[0] - upright).max() > 0.5 * step) or (
        corners_px is None and not corners[1, 0] - corners[0, 0] > abs(corners[1, 1] - corners[0, 1])
    )
    return PlacedChart(corners, is_turned)


def _refuse_miss(picture: PlainPicture, miss: float, *, is_given: bool) -> None:
    where = "at --corners" if is_given else "found on a grid"
    how = (
        f"miss the chart's colours by {miss:.0f} CIEDE2000 in the mean"
        if np.isfinite(miss)
        else "leave the picture or are saturated"
    )
    raise InputError(
        f"{picture.name}: the patches {where} {how}, in every orientation of the chart; expected the chart of "
        f"the description, and linear values. {'Check the corners' if is_given else 'Give --corners'}: the "
        "middles of the four corner patches"
    )


def _projection(chart: Chart, corners_px: Floats) -> Floats:
    """Return [3, 3], from mm of the chart's face to px."""
    chart_corners, picture_corners = chart.corners_mm.astype(np.float32), corners_px.astype(np.float32)
    return np.asarray(cv2.getPerspectiveTransform(chart_corners, picture_corners), np.float64)


def _area(corners_px: Floats) -> float:
    """Return twice the signed area. It is positive for corners that run clockwise in the picture."""
    x, y = corners_px.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def _miss(picture: PlainPicture, known_chart: KnownChart, corners_px: Floats) -> float:
    """Return the mean CIEDE2000 of the patches by the best matrix, for these corners of the chart. It is infinite
    if patches are outside the picture or dark."""
    chart = known_chart.chart
    half = 0.25 * chart.used * np.array(chart.patch_mm)
    around = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 2), axis=-1).reshape(-1, 2) * half
    points = (chart.centres_mm[:, None] + around).reshape(1, -1, 2)
    at = np.rint(cv2.perspectiveTransform(points, _projection(chart, corners_px))[0])
    width, height = picture.size_px
    if not (np.isfinite(at).all() and (at >= 0).all() and (at < (width, height)).all()):
        return float("inf")
    x, y = at.astype(int).T
    signal = np.median(picture.values[y, x].reshape(len(chart.centres_mm), -1, 3), axis=1).astype(np.float64)
    is_full = picture.full[y, x].reshape(len(signal), -1).mean(axis=1) > 0.1
    good = ~is_full & np.isfinite(signal).all(axis=1)
    if good.sum() < max(8, len(signal) // 2):
        return float("inf")
    signal, xyz = signal[good], known_chart.xyz[good]
    weight = 1.0 / (0.01 + xyz[:, 1:2]) ** (2.0 / 3.0)
    matrix, *_ = np.linalg.lstsq(signal * weight, xyz * weight)
    return float(de00(lab_of(signal @ matrix), lab_of(xyz)).mean())


# -- signals --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlainReading:
    """The patches in a plain picture."""

    reading: Reading
    uneven: NDArray[np.bool_]
    """[patches] True if parts of the patch differ by more than noise and a slope of light."""


def read_plain_patches(picture: PlainPicture, polygons_px: Floats, names: Sequence[str]) -> PlainReading:
    """Return means of the patches inside polygons [patches, 4, 2]. The uncertainty comes from the scatter of tiles
    of each patch about a plane. So noise that neighbouring pixels share (interpolated colours, compression) counts
    fully.

    Raises InputError if patches are outside the picture or too small in it, or if the place is not the chart's.
    """
    count = len(names)
    mean, u, sd = (np.zeros((count, 3)) for _ in range(3))
    full, uneven, stuck, constant = (np.zeros(count, np.bool_) for _ in range(4))
    for patch, polygon in enumerate(polygons_px):
        inside = pixels_inside(polygon, picture.values.shape)
        if inside is None:
            raise InputError(
                f"{picture.name}: the patch {names[patch]} is outside the picture; show the whole chart"
            )
        if len(inside[0]) < _LEAST_PIXELS:
            raise InputError(
                f"{picture.name}: the patch {names[patch]} has {len(inside[0])} pixels, expected {_LEAST_PIXELS} "
                "or more; go nearer"
            )
        values = picture.values[inside].astype(np.float64)
        is_unknown = picture.full[inside] | ~np.isfinite(values).all(axis=1)
        full[patch] = is_unknown.mean() > _FULL_SHARE
        if full[patch]:
            continue
        values = values[~is_unknown]
        stuck[patch] = ((values >= picture.largest).mean(axis=0) > _STUCK_SHARE).any()
        constant[patch] = (np.ptp(values, axis=0) == 0.0).all()
        pixels = np.column_stack([inside[1], inside[0]])[~is_unknown].astype(np.float64)
        tiles, sides = _tiles(pixels, polygon, len(values))
        mean[patch] = values.mean(axis=0)
        u[patch], sd[patch], uneven[patch] = _scatter(values, tiles, sides)
    if (picture.levels is None or picture.levels >= _LEVELS_FOR_STUCK) and not constant[~stuck & ~full].all():
        full |= stuck  # by a converter; what is even everywhere was drawn
    uneven &= ~full
    if uneven.mean() > _MOST_UNEVEN:
        patch_list = ", ".join(names[n] for n in np.flatnonzero(uneven)[:8])
        raise InputError(
            f"{picture.name}: {int(uneven.sum())} patches are not even where they are expected ({patch_list}); "
            "check --corners, and `patch_mm`, `pitch_mm` and `used` of the chart; perhaps the picture is not sharp"
        )
    return PlainReading(Reading(mean, u, sd, full), uneven)


def _tiles(pixels: Floats, polygon: Floats, count: int) -> tuple[NDArray[np.intp], int]:
    """Return the number of each pixel's tile, and the number of tiles along a side."""
    sides = int(np.clip(np.sqrt(count / _TILE_PIXELS), 3, _SIDE_TILES))
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    to_square = cv2.getPerspectiveTransform(polygon.astype(np.float32), square)
    at = cv2.perspectiveTransform(pixels[None], to_square)[0]
    column, row = np.clip((at * sides).astype(np.intp), 0, sides - 1).T
    return row * sides + column, sides


def _scatter(values: Floats, tiles: NDArray[np.intp], sides: int) -> tuple[Floats, Floats, bool]:
    """Return the standard uncertainty [3] of the mean, the standard deviation [3] of pixels about a plane, and
    whether the patch is uneven."""
    sizes = np.bincount(tiles, minlength=sides**2)
    filled_tiles = np.flatnonzero(sizes > 0)
    sums = np.stack([np.bincount(tiles, channel, minlength=sides**2) for channel in values.T], axis=1)
    means = sums[filled_tiles] / sizes[filled_tiles, None]
    plane = np.column_stack([np.ones(len(filled_tiles)), filled_tiles % sides, filled_tiles // sides])
    slope, *_ = np.linalg.lstsq(plane, means)
    rest = means - plane @ slope
    tile_sd = np.sqrt((rest**2).sum(axis=0) / (len(filled_tiles) - 3))
    by_tile = np.column_stack([np.ones(len(values)), tiles % sides, tiles // sides]) @ slope
    pixel_sd = np.sqrt(((values - by_tile) ** 2).sum(axis=0) / (len(values) - 3))
    expected_sd = pixel_sd / np.sqrt(len(values) / len(filled_tiles))
    u = np.maximum(tile_sd / np.sqrt(len(filled_tiles)), pixel_sd / np.sqrt(len(values)))
    level = np.abs(values.mean(axis=0)).max()
    is_uneven = bool((tile_sd > np.maximum(_UNEVEN * level, 3.0 * np.minimum(expected_sd, level))).any())
    return u, pixel_sd, is_uneven
