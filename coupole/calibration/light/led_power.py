"""Power of each LED from pictures of a Spectralon tile: Phi_k of seed 003, Eq. 2 and section 4.2.

A patch of the tile at x gives the signal S = f(i, o) * E/Phi(x) * Phi_k, S being DN per second over the flat
field: so Phi_k is in those units times m^2 sr, and a reflectance made with it is free of the camera's constants.
Taken as logarithms the problem is linear,

    ln S_kv - ln h_kv = ln Phi_k + J_kv . theta + noise,

theta being what all LEDs share: the tile's tilt about two axes in each place that it lay, the logarithm of its
reflectance, its departure from Lambert's law. They have priors from the tile's description; where the tile was
photographed in several places the data add to them. So the covariance of all powers is a diagonal (each LED's own
noise) and a few common directions, and 1080 LEDs need no matrix of 1080 by 1080.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from coupole.calibration.light.irradiance import LED_SIDE_MM, Emission, irradiance_per_flux
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

_DEAD_SIGMA = 5.0
_DEAD_SHARE = 0.01
"""Of the median LED's power."""
_SHADED = 0.03
"""Relative departure of a part of the tile that noise does not explain."""
_SHADED_SIGMA = 6.0
_LOWEST_COSINE = 0.05
"""Of incidence on the tile: LEDs nearer to its horizon (3 degrees) tell nothing but its tilt."""
_UNLIKELY = 1e-6
_STEP = 1e-4


@dataclass(frozen=True)
class TileView:
    """The tile in one view, under many LEDs."""

    name: str
    place: int
    """Views with the tile in the same place share its tilt."""
    base_from_tile: Floats
    """[4, 4] mm, as described."""
    points_mm: Floats
    """[m, 3] middles of the tile's patches, in the base frame."""
    camera_mm: Floats
    """[3] projection centre."""
    leds: NDArray[np.int64]
    """[n] ids."""
    signal: Floats
    """[n, m] DN/s over the flat field, of one channel; NaN where nothing was seen."""
    u_signal: Floats
    """[n, m] of each, from noise."""
    saturated: NDArray[np.bool_]
    """[n] True where pixels of the tile were saturated."""


@dataclass(frozen=True)
class Positions:
    """LEDs' places and normals in the base frame, by id."""

    ids: NDArray[np.int64]
    centres_mm: Floats
    normals: Floats

    def of(self, ids: NDArray[np.int64]) -> tuple[Floats, Floats]:
        row = {int(led): i for i, led in enumerate(self.ids)}
        rows = [row[int(led)] for led in ids]
        return self.centres_mm[rows], self.normals[rows]


@dataclass(frozen=True)
class LedPower:
    """Power of one channel; what is relative is so to the LED's own power."""

    ids: NDArray[np.int64]
    power: Floats
    """[n] DN s^-1 m^2 sr; 0 for a dead LED, NaN for one that no view could use."""
    u_own: Floats
    """[n] relative standard uncertainty that an LED shares with no other."""
    common: Floats
    """[n, c] relative change of each power by one unit of each common figure."""
    common_names: tuple[str, ...]
    common_covariance: Floats
    """[c, c]."""
    found: Floats
    """[c] the common figures' departures from the description."""
    noise: float
    """Relative, of one LED in one view, as found."""
    residuals: tuple[Floats, ...]
    """Of each view [n], relative; NaN where not used."""
    remarks: tuple[str, ...]
    """Faults by name: dead LEDs, shadows, saturation."""
    degrees_of_freedom: float

    def u(self) -> Floats:
        """[n] relative standard uncertainty, all together."""
        together = np.einsum("ni,ij,nj->n", self.common, self.common_covariance, self.common)
        total: Floats = np.sqrt(self.u_own**2 + together)
        return total

    def u_against_mean(self) -> Floats:
        """[n] relative standard uncertainty of an LED's power over the mean of all: the common scale drops out."""
        off = self.common - np.nanmean(self.common[self.power > 0], axis=0)
        together = np.einsum("ni,ij,nj->n", off, self.common_covariance, off)
        total: Floats = np.sqrt(self.u_own**2 + together)
        return total

    @property
    def u_scale(self) -> float:
        """Relative standard uncertainty of all powers together."""
        mean = np.nanmean(self.common[self.power > 0], axis=0)
        return float(np.sqrt(mean @ self.common_covariance @ mean))


def calibrate_led_power(
    views: Sequence[TileView],
    positions: Positions,
    tile: Tile,
    *,
    emission: Emission = "lambertian",
    side_mm: float = LED_SIDE_MM,
    flash_noise: float = 5e-4,
) -> LedPower:
    """Powers of one channel from the tile's views.

    `flash_noise` is what flashes of an LED are believed to differ by where none was seen twice. Raises InputError:
    no view shows the tile lit, all are saturated, or the tile did not lie still between views.
    """
    if not views:
        raise InputError("LED power: expected views of the tile, found none")
    ids = np.unique(np.concatenate([view.leds for view in views]))
    places = sorted({view.place for view in views})
    names = (*(f"tilt{p}.{axis}_deg" for p in places for axis in "xy"), "ln_reflectance", "minnaert")
    prior = np.array(
        [tile.u_tilt_deg] * (2 * len(places)) + [tile.u_reflectance / tile.reflectance, tile.u_minnaert]
    )
    remarks: list[str] = []
    rows: list[Row] = []
    lit_elsewhere: set[int] = set()
    for v, view in enumerate(views):
        found, not_used = rows_of(
            v,
            view,
            positions,
            tile,
            emission,
            side_mm=side_mm,
            place=places.index(view.place),
            figures=len(names),
            remarks=remarks,
        )
        rows += found
        lit_elsewhere |= not_used
    if not rows:
        raise InputError("LED power: no LED could be used: " + ("; ".join(remarks[:5]) or "all stand too low"))
    rows, dead = _without_dark(rows, views, ids, lit_elsewhere, remarks)
    y, w, led, view_of, design = _arrays(rows, ids, flash_noise)
    solved = _solve(y, w, led, design, len(ids), prior)
    redundancy = max(1.0, float(len(y) - len(np.unique(led))))
    chi2 = float(np.sum(w * solved.left**2))
    factor = max(1.0, chi2 / redundancy) if len(y) > len(np.unique(led)) else 1.0
    _refuse_moved(views, view_of, solved.left, w, design, redundancy)
    used = np.zeros(len(ids), bool)
    used[np.unique(led)] = True
    power = np.where(used, np.exp(np.where(used, solved.log_power, 0.0)), np.nan)
    power[dead] = 0.0
    own = np.where(used, np.sqrt(factor / np.maximum(solved.weight, 1e-300)), np.nan)
    residuals = []
    for v, view in enumerate(views):
        mine = np.full(len(view.leds), np.nan)
        where = {int(i): n for n, i in enumerate(view.leds)}
        for n in np.flatnonzero(view_of == v):
            mine[where[int(ids[led[n]])]] = solved.left[n]
        residuals.append(mine)
    missing = ids[~used & ~dead]
    if len(missing):
        remarks.append(f"{len(missing)} LEDs have no usable picture: {list_of(missing)}")
    return LedPower(
        ids,
        power,
        own,
        np.where(used[:, None], -solved.mean_design, np.nan),
        names,
        solved.covariance,
        solved.theta,
        float(np.sqrt(factor / np.median(w))),
        tuple(residuals),
        tuple(remarks),
        redundancy,
    )


# -- observations ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One LED in one view."""

    view: int
    led: int
    value: float
    """S / h, before the logarithm: the power, if the tile lies as described."""
    u: float
    """Of the value, from noise."""
    design: Floats
    """Relative change of h by the figures that LEDs share: tilts of all places, ln reflectance, Minnaert's k."""


def transfer(
    view: TileView,
    centres_mm: Floats,
    normals: Floats,
    tile: Tile,
    *,
    tilt_deg: Floats | None = None,
    minnaert: float | None = None,
    emission: Emission = "lambertian",
    side_mm: float = LED_SIDE_MM,
) -> tuple[Floats, Floats]:
    """h [n, m] = f E/Phi of each patch under each LED, and the cosine of incidence [n, m]."""
    x, y = np.radians(np.zeros(2) if tilt_deg is None else tilt_deg)
    normal = view.base_from_tile[:3, :3] @ np.array([np.sin(y), -np.sin(x) * np.cos(y), np.cos(x) * np.cos(y)])
    points = view.points_mm[None]
    towards = centres_mm[:, None] - points
    cos_in = (towards @ normal) / np.linalg.norm(towards, axis=-1)
    away = view.camera_mm - view.points_mm
    cos_out = (away @ normal) / np.linalg.norm(away, axis=-1)
    lit = irradiance_per_flux(
        points, normal, centres_mm[:, None], normals[:, None], side_mm=side_mm, emission=emission
    )
    h: Floats = tile.brdf(np.maximum(cos_in, 1e-6), cos_out[None], minnaert=minnaert) * lit
    return h, cos_in


def rows_of(
    number: int,
    view: TileView,
    positions: Positions,
    tile: Tile,
    emission: Emission,
    *,
    side_mm: float = LED_SIDE_MM,
    place: int = 0,
    figures: int = 4,
    remarks: list[str],
) -> tuple[list[Row], set[int]]:
    """Observations of view `number`, and LEDs that are lit there though their picture cannot be used.

    `figures` are shared by all LEDs: two tilts for each place of the tile, of which the view's is number `place`,
    ln reflectance, Minnaert's k. What cannot be used is added to `remarks`.
    """
    centres, normals = positions.of(view.leds)

    def log_h(tilt_deg: Floats, minnaert: float) -> Floats:
        h, _ = transfer(
            view, centres, normals, tile,
            tilt_deg=tilt_deg, minnaert=minnaert, emission=emission, side_mm=side_mm,
        )  # fmt: skip
        mean: Floats = np.log(np.maximum(h.mean(axis=1), 1e-300))
        return mean

    h, cos_in = transfer(view, centres, normals, tile, emission=emission, side_mm=side_mm)
    slopes = np.zeros((len(view.leds), figures))
    none, k = np.zeros(2), tile.minnaert
    for axis in range(2):
        step = _STEP * np.eye(2)[axis]
        slopes[:, 2 * place + axis] = (log_h(step, k) - log_h(-step, k)) / (2 * _STEP)
    slopes[:, -2] = 1.0
    slopes[:, -1] = (log_h(none, k + _STEP) - log_h(none, k - _STEP)) / (2 * _STEP)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, u_ratio = view.signal / h, view.u_signal / h
    usable = (cos_in.min(axis=1) > _LOWEST_COSINE) & (h > 0).all(axis=1) & np.isfinite(view.signal).all(axis=1)
    rows: list[Row] = []
    shaded: list[int] = []
    for n in np.flatnonzero(usable & ~view.saturated):
        middle = float(np.median(ratio[n]))
        # A shadow's edge across a part makes that part's own noise great: what the parts have in common counts.
        limit = _SHADED * abs(middle) + _SHADED_SIGMA * float(np.median(u_ratio[n]))
        if (np.abs(ratio[n] - middle) > limit).any():
            shaded.append(int(view.leds[n]))
            continue
        total = float(h[n].sum())
        u = float(np.sqrt(np.sum(view.u_signal[n] ** 2)) / total)
        rows.append(Row(number, int(view.leds[n]), float(view.signal[n].sum() / total), u, slopes[n]))
    if shaded:
        remarks.append(f"view {view.name}: the tile is partly in shadow under {list_of(shaded)}; not used")
    if (full := view.leds[view.saturated & usable]).size:
        remarks.append(f"view {view.name}: the tile is saturated under {list_of(full)}; not used, expose less")
    return rows, {*shaded, *map(int, full)}


def _arrays(
    rows: Sequence[Row], ids: NDArray[np.int64], flash_noise: float
) -> tuple[Floats, Floats, NDArray[np.intp], NDArray[np.intp], Floats]:
    """Logarithms, weights, number of the LED, number of the view, derivatives."""
    value = np.array([row.value for row in rows])
    u = np.array([row.u for row in rows])
    positive = np.maximum(value, 1e-300)
    weight = 1.0 / ((u / positive) ** 2 + flash_noise**2)
    led = np.searchsorted(ids, [row.led for row in rows])
    return (
        np.log(positive), weight, led, np.array([row.view for row in rows]), np.stack([row.design for row in rows])
    )  # fmt: skip


def _without_dark(
    rows: Sequence[Row],
    views: Sequence[TileView],
    ids: NDArray[np.int64],
    lit_elsewhere: set[int],
    remarks: list[str],
) -> tuple[list[Row], NDArray[np.bool_]]:
    """Rows in which the tile is lit, and which LEDs [n] are dead: dark in every view, so far as can be seen."""
    bright = float(np.median([row.value for row in rows]))

    def lit(row: Row) -> bool:
        return row.value > max(_DEAD_SIGMA * row.u, _DEAD_SHARE * bright)

    alive = {row.led for row in rows if lit(row)} | lit_elsewhere
    seen = {row.led for row in rows}
    dead = np.array([int(led) in seen - alive for led in ids])
    if dead.any():
        remarks.append(f"dead LEDs, or hidden in every view: {list_of(ids[dead])}")
    for v, view in enumerate(views):
        shadowed = [row.led for row in rows if row.view == v and row.led in alive and not lit(row)]
        if shadowed:
            remarks.append(f"view {view.name}: the tile is wholly in shadow under {list_of(shadowed)}; not used")
    return [row for row in rows if lit(row)], dead


# -- solution -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Solved:
    log_power: Floats
    weight: Floats
    """[leds] sum of weights."""
    mean_design: Floats
    """[leds, c]."""
    theta: Floats
    covariance: Floats
    left: Floats


def _solve(y: Floats, w: Floats, led: NDArray[np.intp], design: Floats, leds: int, prior: Floats) -> _Solved:
    """Least squares with the LEDs' own unknowns eliminated first."""
    weight: Floats = np.bincount(led, w, leds).astype(np.float64)
    safe = np.maximum(weight, 1e-300)
    mean_y = np.bincount(led, w * y, leds) / safe
    mean_design: Floats = np.column_stack([np.bincount(led, w * column, leds) / safe for column in design.T])
    off_y, off = y - mean_y[led], design - mean_design[led]
    believed = np.maximum(prior, 1e-12)
    normal = np.diag(believed**-2.0) + off.T @ (off * w[:, None])
    covariance: Floats = np.asarray(np.linalg.inv(normal), np.float64)
    theta: Floats = covariance @ (off.T @ (w * off_y))
    return _Solved(mean_y - mean_design @ theta, weight, mean_design, theta, covariance, off_y - off @ theta)


def _refuse_moved(
    views: Sequence[TileView],
    view_of: NDArray[np.intp],
    left: Floats,
    w: Floats,
    design: Floats,
    redundancy: float,
) -> None:
    """Raise InputError if one view fits far better with a tilt of its own, though it names the others' place."""
    for place in {view.place for view in views}:
        mine = [v for v, view in enumerate(views) if view.place == place]
        if len(mine) < 2:
            continue
        best: tuple[float, int, float] = (0.0, -1, 0.0)
        for v in mine:
            at = view_of == v
            columns = [c for c in range(design.shape[1] - 2) if np.any(design[at][:, c])]
            if at.sum() < 10 or not columns:
                continue
            part = np.column_stack([design[at][:, columns], np.ones(int(at.sum()))])
            normal = part.T @ (part * w[at, None])
            step = np.linalg.solve(normal, part.T @ (w[at] * left[at]))
            # Residuals are shared between the views, so a view's own tilt shows in them only in part.
            share = len(mine) / (len(mine) - 1.0)
            gain = float(step @ normal @ step) * share
            noise = max(1.0, (float(np.sum(w * left**2)) - gain) / redundancy)
            gain /= noise
            best = max(best, (gain, v, float(np.hypot(*step[: len(columns)])) * share))
        gain, v, tilt_deg = best
        if gain > chi2_distribution.isf(_UNLIKELY, 3) and tilt_deg > 0.05:
            raise InputError(
                f"LED power: the tile did not lie still: view {views[v].name} sees it tilted by {tilt_deg:.2g} "
                "deg or shifted against the other views of this place. Acquire again, or describe its places apart"
            )


def list_of(ids: Sequence[int] | NDArray[np.int64]) -> str:
    """The first of them by number, for people."""
    named = ", ".join(f"{int(led)}" for led in list(ids)[:8])
    return f"LED {named}" + (f" and {len(ids) - 8} more" if len(ids) > 8 else "")
