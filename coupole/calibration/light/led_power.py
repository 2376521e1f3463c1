"""Power of each LED from pictures of a Spectralon tile: Phi_k of seed 003, Eq. 2 and section 4.2.

A patch of the tile at x gives the signal S = f(i, o) * E/Phi(x) * Phi_k, where S is DN per second over the flat
field. So Phi_k is in these units times m^2 sr, and the camera's constants cancel in a reflectance. In logarithms
the problem is linear,

    ln S_kv - ln h_kv = ln Phi_k + J_kv . theta + noise,

where theta are the figures that all LEDs share: the tile's tilt about two axes and its height at each of its
places, the logarithm of its reflectance, and its departure from Lambert's law. They have priors from the tile's
description; data from several places of the tile improve them. So the covariance of all powers is a diagonal
(noise of each LED) plus a matrix of low rank (the shared figures). A matrix of 1080 by 1080 for 1080 LEDs is not
needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from coupole.calibration.light.irradiance import LED_SIDE_MM, Emission
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_views import (
    OF_PLACE,
    Emitter,
    Positions,
    Row,
    TileView,
    arrays_of,
    list_of,
    rows_of,
    without_dark,
)
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

_UNLIKELY = 1e-6
LEAST_PRIOR = 1e-12
"""Standard uncertainty of a figure that is stated to be exact."""


@dataclass(frozen=True)
class LedPower:
    """Power of each LED in one channel. Relative figures refer to the LED's power."""

    ids: NDArray[np.int64]
    power: Floats
    """[n] DN s^-1 m^2 sr; 0 for a dead LED, NaN for one without a usable view."""
    u_own: Floats
    """[n] relative standard uncertainty from errors that are independent between LEDs."""
    common: Floats
    """[n, c] relative change of each power by one unit of each common figure."""
    common_names: tuple[str, ...]
    common_covariance: Floats
    """[c, c]."""
    departures: Floats
    """[c] departures of the common figures from the description."""
    noise: float
    """Estimated relative noise of one LED in one view."""
    residuals: tuple[Floats, ...]
    """Relative residuals of each view [n]; NaN where a row was not used."""
    remarks: tuple[str, ...]
    """Named faults: dead LEDs, shadows, saturation."""
    degrees_of_freedom: float

    def u(self) -> Floats:
        """Relative standard uncertainty [n], from all errors together."""
        together = np.einsum("ni,ij,nj->n", self.common, self.common_covariance, self.common)
        total: Floats = np.sqrt(self.u_own**2 + together)
        return total

    def u_against_mean(self) -> Floats:
        """Relative standard uncertainty [n] of an LED's power relative to the mean of all LEDs. The common scale
        does not count."""
        off = self.common - np.nanmean(self.common[self.power > 0], axis=0)
        together = np.einsum("ni,ij,nj->n", off, self.common_covariance, off)
        total: Floats = np.sqrt(self.u_own**2 + together)
        return total


def prior_of(tile: Tile, places: int = 1) -> Floats:
    """Return [c], the standard uncertainties of the shared figures, from the tile's description."""
    of_place = [tile.u_tilt_deg, tile.u_tilt_deg, tile.u_height_mm]
    return np.array([*of_place * places, tile.u_reflectance / tile.reflectance, tile.u_minnaert])


def _common_names(places: Sequence[int]) -> tuple[str, ...]:
    """Return [c], the names of the shared figures, in the order of `prior_of`."""
    of_places = [f"place{p}.{figure}" for p in places for figure in ("tilt_x_deg", "tilt_y_deg", "height_mm")]
    return (*of_places, "ln_reflectance", "minnaert")


def calibrate_led_power(
    views: Sequence[TileView],
    positions: Positions,
    tile: Tile,
    *,
    emission: Emission = "lambertian",
    side_mm: float = LED_SIDE_MM,
    flash_noise: float = 5e-4,
) -> LedPower:
    """Find the powers of one channel from the tile's views.

    `flash_noise` is the stated relative scatter of an LED's flashes. Raises InputError if no view shows the tile
    lit, if all views are saturated, or if the tile was moved between views of one place.
    """
    if not views:
        raise InputError("LED power: expected views of the tile, found none")
    ids = np.unique(np.concatenate([view.leds for view in views]))
    places = sorted({view.place for view in views})
    names = _common_names(places)
    remarks: list[str] = []
    rows: list[Row] = []
    lit_elsewhere: set[int] = set()
    for v, view in enumerate(views):
        place = places.index(view.place)
        view_rows = rows_of(v, view, positions, tile, Emitter(emission, side_mm), place=place, figures=len(names))
        rows += view_rows.rows
        remarks += view_rows.remarks
        lit_elsewhere |= view_rows.unused_leds
    if not rows:
        raise InputError("LED power: no LED could be used: " + ("; ".join(remarks[:5]) or "all are too low"))
    rows, dead = without_dark(rows, views, ids, lit_elsewhere, remarks)
    y, w, led, view_of, design = arrays_of(rows, ids, flash_noise)
    solution = _solve(y, w, led, design, len(ids), prior_of(tile, len(places)))
    redundancy = max(1.0, float(len(y) - len(np.unique(led))))
    chi2 = float(np.sum(w * solution.residuals**2))
    factor = max(1.0, chi2 / redundancy) if len(y) > len(np.unique(led)) else 1.0
    _refuse_moved(views, view_of, solution.residuals, w, design, redundancy)
    is_used = np.zeros(len(ids), bool)
    is_used[np.unique(led)] = True
    power = np.where(is_used, np.exp(np.where(is_used, solution.log_power, 0.0)), np.nan)
    power[dead] = 0.0
    own_u = np.where(is_used, np.sqrt(factor / np.maximum(solution.weight, 1e-300)), np.nan)
    missing = ids[~is_used & ~dead]
    if len(missing):
        remarks.append(f"{len(missing)} LEDs have no usable picture: {list_of(missing)}")
    return LedPower(
        ids,
        power,
        own_u,
        np.where(is_used[:, None], -solution.mean_design, np.nan),
        names,
        solution.covariance,
        solution.theta,
        float(np.sqrt(factor / np.median(w))),
        _by_view(views, view_of, ids[led], solution.residuals),
        tuple(remarks),
        redundancy,
    )


def _by_view(
    views: Sequence[TileView], view_of: NDArray[np.intp], led_of: NDArray[np.int64], row_residuals: Floats
) -> tuple[Floats, ...]:
    """Return residuals of each view in the order of its LEDs [n]; NaN where an LED was not used."""
    residuals = []
    for v, view in enumerate(views):
        view_residuals = np.full(len(view.leds), np.nan)
        where = {int(i): n for n, i in enumerate(view.leds)}
        for n in np.flatnonzero(view_of == v):
            view_residuals[where[int(led_of[n])]] = row_residuals[n]
        residuals.append(view_residuals)
    return tuple(residuals)


@dataclass(frozen=True)
class _Solved:
    log_power: Floats
    weight: Floats
    """[leds] sum of weights."""
    mean_design: Floats
    """[leds, c] weighted mean of the design."""
    theta: Floats
    covariance: Floats
    residuals: Floats


def _solve(y: Floats, w: Floats, led: NDArray[np.intp], design: Floats, leds: int, prior: Floats) -> _Solved:
    """Solve by least squares. The LEDs' own unknowns are eliminated first."""
    weight: Floats = np.bincount(led, w, leds).astype(np.float64)
    safe = np.maximum(weight, 1e-300)
    mean_y = np.bincount(led, w * y, leds) / safe
    mean_design: Floats = np.column_stack([np.bincount(led, w * column, leds) / safe for column in design.T])
    off_y, off = y - mean_y[led], design - mean_design[led]
    prior_sigmas = np.maximum(prior, LEAST_PRIOR)
    normal = np.diag(prior_sigmas**-2.0) + off.T @ (off * w[:, None])
    covariance: Floats = np.asarray(np.linalg.inv(normal), np.float64)
    theta: Floats = covariance @ (off.T @ (w * off_y))
    return _Solved(mean_y - mean_design @ theta, weight, mean_design, theta, covariance, off_y - off @ theta)


def _refuse_moved(
    views: Sequence[TileView],
    view_of: NDArray[np.intp],
    residuals: Floats,
    w: Floats,
    design: Floats,
    redundancy: float,
) -> None:
    """Raise InputError if one view fits far better with a tilt of its own, although it has the same place as
    others."""
    for place in {view.place for view in views}:
        members = [v for v, view in enumerate(views) if view.place == place]
        if len(members) < 2:
            continue
        best: tuple[float, int, float] = (0.0, -1, 0.0)
        for v in members:
            at = view_of == v
            columns = [c for c in range(design.shape[1] - 2) if c % OF_PLACE < 2 and np.any(design[at][:, c])]
            if at.sum() < 10 or not columns:
                continue
            part = np.column_stack([design[at][:, columns], np.ones(int(at.sum()))])
            normal = part.T @ (part * w[at, None])
            step = np.linalg.solve(normal, part.T @ (w[at] * residuals[at]))
            # The fit absorbs a part of a view's own tilt, which the residuals therefore do not show.
            share = len(members) / (len(members) - 1.0)
            gain = float(step @ normal @ step) * share
            noise = max(1.0, (float(np.sum(w * residuals**2)) - gain) / redundancy)
            gain /= noise
            best = max(best, (gain, v, float(np.hypot(*step[: len(columns)])) * share))
        gain, v, tilt_deg = best
        if gain > chdtri(3, _UNLIKELY) and tilt_deg > 0.05:
            raise InputError(
                f"LED power: the tile was moved: view {views[v].name} sees it tilted by {tilt_deg:.2g} "
                "deg or shifted against the other views of this place. Acquire again, or describe "
                "its places separately"
            )
