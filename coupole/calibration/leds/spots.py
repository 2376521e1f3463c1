"""Lit LEDs in RAW frames: centres of bright spots, with covariance.

A camera that looks into an LED receives some 1e5 times the light of a white target: even at the shortest exposure
the spot is saturated to its rim, and as wide as the LED and the blur of defocus together. Only the rim has
information on its position. So the signal is clipped to a narrow band about half of white, and the spot's centre
is the centroid of the result:

    w = clip((signal / white - 1/4) / (1/2), 0, 1)

Blur of a round aperture and glare widen the spot symmetrically, which does not shift a centroid. The rim has
another radius in each colour, but the pixels of each colour are distributed evenly about the centre, so all are
used alike. The effect of perspective within the LED itself is corrected by `outline_offsets`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration import optics
from coupole.calibration.rotations import Floats

LOW, HIGH = 0.25, 0.75
"""Levels as shares of white: a pixel below the first has weight 0, and a pixel above the second has weight 1."""
LEAST_AREA_PX = 9.0
"""Least area of a spot: smaller regions are hot pixels or sparks."""
LEAST_FILL, MOST_FILL, MOST_STRETCH = 0.935, 1.04, 4.0
"""Limits of a spot's fill and of the ratio of its axes. The fill of a disk is 1, that of a square 3/pi = 0.955;
two spots that touch have less. An LED seen at 75 degrees is four times as wide as high."""
MOST_SPOTS = 12
"""Largest number of bright regions: a frame with more has another source of light."""
_COARSE = 0.4
"""Error of the fill of a small spot, multiplied by the width of the spot. The error arises because the spot
consists of whole pixels."""
_MARGIN_PX = 8
_CROSSING = 0.25
"""Variance of the covered share of a rim pixel: half a pixel either way, as errors along a straight side are
alike."""


@dataclass(frozen=True)
class Spot:
    """One bright spot."""

    pixel: Floats
    """[2] px; the centre of the first pixel is (0, 0)."""
    covariance: Floats
    """[2, 2], px^2."""
    area_px: float
    fill: float
    """Area, divided by the area of the ellipse with the same second moments."""


@dataclass(frozen=True)
class Spots:
    """Bright spots that a frame shows."""

    good: tuple[Spot, ...]
    """Largest first."""
    rejection_reasons: tuple[str, ...]
    """Reasons why other bright regions are not spots."""
    brightest: float
    """Largest green signal divided by white."""


def find_spots(frame: NDArray[np.uint16], dark: Floats | float, pattern: str, white_dn: float) -> Spots:
    """Spots in a RAW frame [H, W] with a dark frame [H, W] (or the black level) of the same exposure, DN."""
    import cv2

    row, column = _green_place(pattern)
    at_green = frame[row::2, column::2]
    black = dark[row::2, column::2] if isinstance(dark, np.ndarray) else dark
    white = float(white_dn - np.mean(black))
    lit = (at_green > np.min(black) + LOW * white) & (at_green - black > LOW * white)
    count, _, boxes, _ = cv2.connectedComponentsWithStats(lit.astype(np.uint8), connectivity=8)
    brightest = float(np.max(at_green - black)) / white
    places = sorted(range(1, count), key=lambda label: -int(boxes[label, cv2.CC_STAT_AREA]))
    good, rejections = [], []
    for label in [p for p in places if 4 * boxes[p, cv2.CC_STAT_AREA] > LEAST_AREA_PX][:MOST_SPOTS]:
        x, y, width, height = (2 * int(v) for v in boxes[label, :4])
        rows = slice(max(y - _MARGIN_PX, 0), min(y + height + _MARGIN_PX, frame.shape[0]))
        columns = slice(max(x - _MARGIN_PX, 0), min(x + width + _MARGIN_PX, frame.shape[1]))
        black = dark[rows, columns] if isinstance(dark, np.ndarray) else dark
        spot = _spot(np.asarray((frame[rows, columns] - black) / white, dtype=np.float64))
        if isinstance(spot, str):
            rejections.append(f"at ({x + width // 2}, {y + height // 2}): {spot}")
        else:
            corner = np.array([columns.start, rows.start], dtype=np.float64)
            good.append(Spot(spot.pixel + corner, spot.covariance, spot.area_px, spot.fill))
    return Spots(tuple(good), tuple(rejections), brightest)


def outline_offsets(
    base_from_board: Floats, centres_mm: Floats, camera_from_base: Floats, lens: Floats, side_mm: float
) -> Floats:
    """Return the offset [n, 2], px, of the centroid of each LED's outline from the image of its centre.

    LEDs are squares of `side_mm` about `centres_mm` [n, 3] (base frame) in the plane of their boards [n, 4, 4].
    The centroid of a quadrangle is the mean of the centroids of its two triangles, weighted by area.
    """
    half = side_mm / 2 * np.array([(0, 0, 0), (-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], dtype=np.float64)
    in_base = centres_mm[:, None] + half @ np.swapaxes(base_from_board[:, :3, :3], 1, 2)
    in_camera = np.einsum("nij,nkj->nki", camera_from_base[:, :3, :3], in_base) + camera_from_base[:, None, :3, 3]
    pixels = optics.project(in_camera.reshape(-1, 3), lens).pixels.reshape(-1, 5, 2)
    centre, corners = pixels[:, 0], pixels[:, 1:]
    parts = [corners[:, [0, k, k + 1]] for k in (1, 2)]
    areas = [np.abs(_cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])) for p in parts]
    middles = [p.mean(axis=1) for p in parts]
    whole = (areas[0] + areas[1])[:, None]
    return np.asarray((areas[0][:, None] * middles[0] + areas[1][:, None] * middles[1]) / whole - centre)


def _spot(signal: Floats) -> Spot | str:
    """Return the largest spot in a part of a frame (signal divided by white), or the reason why it is not a spot.

    A rim pixel is white if any part of it is covered, so the covered share is not known. The covariance of the
    centroid is propagated from this over the whole rim.
    """
    import cv2

    weight = np.clip((signal - LOW) / (HIGH - LOW), 0.0, 1.0)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats((weight > 0).astype(np.uint8), connectivity=8)
    if count < 2:
        return "too faint at full resolution"
    label = 1 + int(np.argmax(boxes[1:, cv2.CC_STAT_AREA]))
    column, row, width, height = (int(v) for v in boxes[label, :4])
    if column == 0 or row == 0 or column + width == weight.shape[1] or row + height == weight.shape[0]:
        return "cut by the frame's edge"
    weight = np.where(labels == label, weight, 0.0)
    area = float(weight.sum())
    if area < LEAST_AREA_PX:
        return f"too small: {area:.0f} px"
    inner = cv2.erode((weight > 0).astype(np.uint8), np.ones((3, 3), np.uint8))
    y, x = np.nonzero(weight)
    w, at_rim = weight[y, x], inner[y, x] == 0
    places = np.stack([x, y], axis=1).astype(np.float64)
    centre = w @ places / area
    about = places - centre
    moments = (about * w[:, None]).T @ about / area
    widths = np.linalg.eigvalsh(moments)
    if widths[0] <= 0 or widths[1] > MOST_STRETCH**2 * widths[0]:
        return "a streak, not an LED"
    fill = area / (4 * np.pi * float(np.sqrt(widths[0] * widths[1])))
    coarse = _COARSE / np.sqrt(area)
    if not LEAST_FILL - coarse < fill < MOST_FILL + coarse:
        return f"not like a square or disk (fill {fill:.2f}): spots that touch, or partly occluded"
    covariance = _CROSSING * about[at_rim].T @ about[at_rim] / area**2
    return Spot(centre, covariance, area, fill)


def _green_place(pattern: str) -> tuple[int, int]:
    """Return row and column of a green pixel in the 2 x 2 pattern; for `MONO`, row and column of the first
    pixel."""
    place = max(pattern.find("G"), 0) if pattern != "MONO" else 0
    return place // 2, place % 2


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
