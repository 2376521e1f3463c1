"""Views of the tile as observations of the LEDs' power: one row for each LED in each view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.irradiance import LED_SIDE_MM, Emission, irradiance_per_flux
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.rotations import Floats

_DEAD_SIGMA = 5.0
_DEAD_SHARE = 0.01
"""Least power of an LED that counts as lit, as a share of the median LED's power. A smaller signal counts as dark.
"""
_SHADED = 0.03
"""Greatest relative departure of a part of the tile that noise does not explain. A larger one counts as shadow."""
_SHADED_SIGMA = 6.0
_FEW_LEDS = 8
"""Least number of LEDs of a view from which a pattern of the tile is distinguished from shadows."""
_LOWEST_COSINE = 0.05
"""Least cosine of incidence on the tile. For LEDs within 3 degrees of its horizon, the signal depends mostly on
the tile's tilt."""
_STEP, _STEP_MM = 1e-4, 0.05
OF_PLACE = 3
"""Number of figures of each place of the tile: two tilts and its height."""


@dataclass(frozen=True)
class TileView:
    """The tile in one view, under many LEDs."""

    name: str
    place: int
    """Views with the tile in the same place share its tilt."""
    base_from_tile: Floats
    """[4, 4] mm, as described."""
    points_mm: Floats
    """[m, 3] centres of the tile's patches, in the base frame."""
    camera_mm: Floats
    """[3] projection centre."""
    leds: NDArray[np.int64]
    """[n] ids."""
    signal: Floats
    """[n, m] DN/s over the flat field, of one channel; NaN where there was no signal."""
    u_signal: Floats
    """[n, m] uncertainty of each signal from noise."""
    saturation_mask: NDArray[np.bool_]
    """[n] True where pixels of the tile were saturated."""
    times_s: Floats | None = None
    """[n] times of the frames, on the box's clock."""


@dataclass(frozen=True)
class Emitter:
    """The light-emitting square of an LED: its emission profile, and its side."""

    emission: Emission = "lambertian"
    side_mm: float = LED_SIDE_MM


LAMBERTIAN = Emitter()


@dataclass(frozen=True)
class Positions:
    """LEDs' places and normals in the base frame, by id."""

    ids: NDArray[np.int64]
    centres_mm: Floats
    """[n, 3]"""
    normals: Floats
    """[n, 3]"""

    def only(self, ids: NDArray[np.int64]) -> Positions:
        """Return the positions of some LEDs, in the order of `ids`."""
        return Positions(ids, *self.of(ids))

    def of(self, ids: NDArray[np.int64]) -> tuple[Floats, Floats]:
        row = {int(led): i for i, led in enumerate(self.ids)}
        rows = [row[int(led)] for led in ids]
        return self.centres_mm[rows], self.normals[rows]


@dataclass(frozen=True)
class Angles:
    """Cosines [..., m] at the parts of the tile."""

    incidence: Floats
    observation: Floats
    half: Floats
    """Cosine between the normal and the half vector of light and view."""
    difference: Floats
    """Cosine between the light and the half vector."""

    def at(self, row: int) -> Angles:
        """Return the cosines of one LED."""
        return Angles(self.incidence[row], self.observation[row], self.half[row], self.difference[row])


@dataclass(frozen=True)
class Row:
    """One LED in one view."""

    view: int
    led: int
    value: float
    """S / h, before the logarithm. It is the power if the tile's pose is as described."""
    u: float
    """Standard uncertainty of the value, from noise."""
    design: Floats
    """Relative change of h by the figures that LEDs share: two tilts and the height of all places, then ln
    reflectance and Minnaert's k."""
    parts: Floats
    """[m] value of each part of the tile, relative to the row's value."""
    u_parts: Floats
    """[m] relative standard uncertainty of each part from noise."""
    part_slopes: Floats
    """[m, figures] relative change of h of each part by the shared figures."""
    angles: Angles
    """Directions at each part."""
    time_s: float
    """Time of the frame; NaN if it is not known."""


@dataclass(frozen=True)
class ViewRows:
    """The observations of one view."""

    rows: list[Row]
    unused_leds: set[int]
    """LEDs that are lit in the view although their frames cannot be used."""
    remarks: list[str]
    """Sentences: frames that cannot be used, and why."""


def transfer(
    view: TileView,
    leds: Positions,
    tile: Tile,
    emitter: Emitter = LAMBERTIAN,
    *,
    tilt_deg: Floats | None = None,
    height_mm: float = 0.0,
    minnaert: float | None = None,
) -> tuple[Floats, Floats]:
    """Return h [n, m] = f E/Phi of each patch under each of the LEDs, and the cosine of incidence [n, m].

    The pixels that see a patch define it. At another height of the tile, they see another part of it.
    """
    x, y = np.radians(np.zeros(2) if tilt_deg is None else tilt_deg)
    normal = view.base_from_tile[:3, :3] @ np.array([np.sin(y), -np.sin(x) * np.cos(y), np.cos(x) * np.cos(y)])
    rays = view.points_mm - view.camera_mm
    points = (view.points_mm + rays * (height_mm / (rays @ view.base_from_tile[:3, 2]))[:, None])[None]
    towards = leds.centres_mm[:, None] - points
    cos_in = (towards @ normal) / np.linalg.norm(towards, axis=-1)
    away = view.camera_mm - points[0]
    cos_out = (away @ normal) / np.linalg.norm(away, axis=-1)
    places, axes = leds.centres_mm[:, None], leds.normals[:, None]
    lit = irradiance_per_flux(points, normal, places, axes, side_mm=emitter.side_mm, emission=emitter.emission)
    h: Floats = tile.brdf(np.maximum(cos_in, 1e-6), cos_out[None], minnaert=minnaert) * lit
    return h, cos_in


def angles_of(view: TileView, leds: Positions) -> Angles:
    """Return the cosines [n, m] at the tile's parts, for the tile as described."""
    normal = view.base_from_tile[:3, 2]
    to_led = leds.centres_mm[:, None] - view.points_mm
    to_led /= np.linalg.norm(to_led, axis=-1)[..., None]
    to_eye = view.camera_mm - view.points_mm
    to_eye /= np.linalg.norm(to_eye, axis=-1)[..., None]
    half = to_led + to_eye
    half /= np.linalg.norm(half, axis=-1)[..., None]
    observation = np.broadcast_to(to_eye @ normal, half.shape[:-1])
    return Angles(to_led @ normal, observation, half @ normal, np.sum(half * to_led, axis=-1))


def rows_of(
    number: int,
    view: TileView,
    positions: Positions,
    tile: Tile,
    emitter: Emitter,
    *,
    place: int = 0,
    figures: int = 5,
) -> ViewRows:
    """Return observations of view `number`.

    All LEDs share `figures`: two tilts and the height for each place of the tile, ln reflectance, and Minnaert's
    k. The view's place has the number `place`.
    """
    leds = positions.only(view.leds)
    h, cos_in = transfer(view, leds, tile, emitter)
    slopes = np.zeros((*h.shape, figures))
    of_place = slice(OF_PLACE * place, OF_PLACE * (place + 1))
    slopes[..., of_place], slopes[..., -2:] = _slopes(view, leds, tile, emitter)
    angles = angles_of(view, leds)
    times_s = np.full(len(view.leds), np.nan) if view.times_s is None else view.times_s
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, u_ratio = view.signal / h, view.u_signal / h
    usable = (cos_in.min(axis=1) > _LOWEST_COSINE) & (h > 0).all(axis=1) & np.isfinite(view.signal).all(axis=1)
    rows: list[Row] = []
    remarks: list[str] = []
    candidates = np.flatnonzero(usable & ~view.saturation_mask)
    shaded_mask = _shaded_mask(ratio[candidates], u_ratio[candidates])
    shaded_leds = [int(led) for led in view.leds[candidates[shaded_mask]]]
    for n in candidates[~shaded_mask]:
        total = float(h[n].sum())
        u = float(np.sqrt(np.sum(view.u_signal[n] ** 2)) / total)
        value, design = float(view.signal[n].sum() / total), slopes[n].mean(axis=0)
        parts, u_parts, time_s = ratio[n] / value, u_ratio[n] / value, float(times_s[n])
        led = int(view.leds[n])
        rows.append(Row(number, led, value, u, design, parts, u_parts, slopes[n], angles.at(n), time_s))
    if shaded_leds:
        remarks.append(f"view {view.name}: the tile is partly in shadow under {list_of(shaded_leds)}; not used")
    if (full := view.leds[view.saturation_mask & usable]).size:
        remarks.append(f"view {view.name}: the tile is saturated under {list_of(full)}; not used, expose less")
    return ViewRows(rows, {*shaded_leds, *map(int, full)}, remarks)


def _shaded_mask(ratio: Floats, u_ratio: Floats) -> NDArray[np.bool_]:
    """Return a mask [n] of LEDs under which a part of the tile is in shadow, by the values [n, m] of its parts."""
    clean = ratio / _own_pattern(ratio)
    middle = np.median(clean, axis=1)
    # A shadow's edge across a part raises that part's noise, so the median noise of all parts is used.
    limit = _SHADED * np.abs(middle) + _SHADED_SIGMA * np.median(u_ratio, axis=1)
    return np.asarray((np.abs(clean - middle[:, None]) > limit[:, None]).any(axis=1))


def _own_pattern(ratio: Floats) -> Floats:
    """Return [m] the pattern of the tile's parts that most LEDs [n, m] show: a stain, and no shadow. With few
    LEDs, none is known."""
    if len(ratio) < _FEW_LEDS:
        return np.ones(ratio.shape[1])
    pattern: Floats = np.median(ratio / np.median(ratio, axis=1, keepdims=True), axis=0)
    return pattern


def _slopes(view: TileView, leds: Positions, tile: Tile, emitter: Emitter) -> tuple[Floats, Floats]:
    """Return derivatives of ln h of each part by the tile's two tilts and its height [n, m, 3], and by ln
    reflectance and Minnaert's k [n, m, 2], as central differences."""

    def log_h(tilt_deg: Floats | None = None, height_mm: float = 0.0, minnaert: float | None = None) -> Floats:
        h, _ = transfer(view, leds, tile, emitter, tilt_deg=tilt_deg, height_mm=height_mm, minnaert=minnaert)
        return np.asarray(np.log(np.maximum(h, 1e-300)))

    tilts = [(log_h(tilt) - log_h(-tilt)) / (2 * _STEP) for tilt in _STEP * np.eye(2)]
    height = (log_h(height_mm=_STEP_MM) - log_h(height_mm=-_STEP_MM)) / (2 * _STEP_MM)
    more, less = (log_h(minnaert=tile.minnaert + step) for step in (_STEP, -_STEP))
    by_minnaert = (more - less) / (2 * _STEP)
    return np.stack([*tilts, height], axis=-1), np.stack([np.ones_like(height), by_minnaert], axis=-1)


def arrays_of(
    rows: Sequence[Row], ids: NDArray[np.int64], flash_noise: float
) -> tuple[Floats, Floats, NDArray[np.intp], NDArray[np.intp], Floats]:
    """Return logarithms, weights, number of the LED, number of the view, and derivatives."""
    value = np.array([row.value for row in rows])
    u = np.array([row.u for row in rows])
    positive = np.maximum(value, 1e-300)
    weight = 1.0 / ((u / positive) ** 2 + flash_noise**2)
    led = np.searchsorted(ids, [row.led for row in rows])
    return (
        np.log(positive), weight, led, np.array([row.view for row in rows]), np.stack([row.design for row in rows])
    )  # fmt: skip


def without_dark(
    rows: Sequence[Row],
    views: Sequence[TileView],
    ids: NDArray[np.int64],
    lit_elsewhere: set[int],
    remarks: list[str],
) -> tuple[list[Row], NDArray[np.bool_]]:
    """Return rows in which the tile is lit, and a mask [n] of dead LEDs. Dead LEDs are dark in all their views."""
    bright = float(np.median([row.value for row in rows]))

    def lit(row: Row) -> bool:
        return row.value > max(_DEAD_SIGMA * row.u, _DEAD_SHARE * bright)

    alive = {row.led for row in rows if lit(row)} | lit_elsewhere
    seen_leds = {row.led for row in rows}
    dead = np.array([int(led) in seen_leds - alive for led in ids])
    if dead.any():
        remarks.append(f"LEDs that are dead, or hidden in every view: {list_of(ids[dead])}")
    for v, view in enumerate(views):
        shadowed_leds = [row.led for row in rows if row.view == v and row.led in alive and not lit(row)]
        if shadowed_leds:
            remarks.append(
                f"view {view.name}: the tile is wholly in shadow under {list_of(shadowed_leds)}; not used"
            )
    return [row for row in rows if lit(row)], dead


def list_of(ids: Sequence[int] | NDArray[np.int64]) -> str:
    """Return the first of them by number, as text."""
    numbers = ", ".join(f"{int(led)}" for led in list(ids)[:8])
    return f"LED {numbers}" + (f" and {len(ids) - 8} more" if len(ids) > 8 else "")
