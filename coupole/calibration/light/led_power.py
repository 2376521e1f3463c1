"""Power of each LED from pictures of a Spectralon tile: Phi_k of Lucat et al. 2025, Eq. 2 and section 4.2.

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
from coupole.calibration.light.power_between import between_views
from coupole.calibration.light.power_figures import common_figures
from coupole.calibration.light.power_left_out import ViewsLeftOut, views_left_out
from coupole.calibration.light.power_suspects import (
    REACH_MM,
    CausesFound,
    causes_of,
    sentences,
    without_causes,
)
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_parts import NO_PARTS, PartsFound, parts_of
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
    """[n, c] relative change of each power per unit of each common figure."""
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
    causes: CausesFound
    parts: PartsFound
    left_out: ViewsLeftOut

    def u(self) -> Floats:
        """Relative standard uncertainty [n], from all errors together."""
        together = np.einsum("ni,ij,nj->n", self.common, self.common_covariance, self.common)
        total: Floats = np.sqrt(self.u_own**2 + together)
        return total

    def u_scale(self) -> float:
        """Relative standard uncertainty of all powers together."""
        mean = np.nanmean(self.common[self.power > 0], axis=0)
        return float(np.sqrt(mean @ self.common_covariance @ mean))

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
    search: bool = True,
) -> LedPower:
    """Find the powers of one channel from the tile's views.

    `flash_noise` is the stated relative scatter of an LED's flashes. Without `search`, causes that the model lacks
    are left out. Raises InputError if no view shows the tile lit, if all views are saturated, or if the tile was
    moved between views of one place.
    """
    _refuse_none(views)
    ids = np.unique(np.concatenate([view.leds for view in views]))
    places = sorted({view.place for view in views})
    names = _common_names(places)
    remarks: list[str] = []
    rows, dead = _rows(views, ids, positions, tile, Emitter(emission, side_mm), remarks)
    y, w, led, view_of, design = arrays_of(rows, ids, flash_noise)
    prior = np.maximum(prior_of(tile, len(places)), LEAST_PRIOR)
    between, mean_y = between_views(y, w, led, design, len(ids), prior)
    causes = causes_of(rows, between, tile) if search else without_causes(between)
    parts = parts_of(rows, [_on_tile_mm(view) for view in views], tile, prior) if search else NO_PARTS
    residuals = between.residuals - between.design @ causes.figures - causes.pattern
    factor = max(1.0, float(np.sum(w * residuals**2)) / between.redundancy)
    _refuse_moved(views, view_of, residuals, w, design, between.redundancy)
    is_used = between.weight > 0.0
    mean_design = between.means(design)
    log_power = mean_y - mean_design @ causes.figures - causes.mean_modes @ causes.error.coefficients - parts.loss
    power = np.where(dead, 0.0, np.exp(np.where(is_used, log_power, np.nan)))
    variance = factor / np.maximum(between.weight, 1e-300) + (REACH_MM * parts.fall_off_per_mm) ** 2
    own_u = np.where(is_used, np.sqrt(variance), np.nan)
    common = common_figures(mean_design, causes, parts, own_u, is_used)
    figures = np.pad(causes.figures, (0, len(common.names)))
    figures[names.index("ln_reflectance")] += parts.loss
    if (missing := ids[~is_used & ~dead]).size:
        remarks.append(f"{len(missing)} LEDs have no usable picture: {list_of(missing)}")
    return LedPower(
        ids,
        power,
        common.u_own,
        np.where(is_used[:, None], common.slopes, np.nan),
        (*names, *common.names),
        common.covariance,
        figures,
        float(np.sqrt(factor / np.median(w))),
        _by_view(views, view_of, ids[led], residuals),
        (*remarks, *sentences(causes, parts)),
        between.redundancy,
        causes,
        parts,
        views_left_out(y, causes.with_modes(between, design, factor), [views[v].name for v in view_of]),
    )


def _refuse_none(views: Sequence[TileView]) -> None:
    if not views:
        raise InputError("LED power: expected views of the tile, found none")


def _rows(
    views: Sequence[TileView],
    ids: NDArray[np.int64],
    positions: Positions,
    tile: Tile,
    emitter: Emitter,
    remarks: list[str],
) -> tuple[list[Row], NDArray[np.bool_]]:
    """Return the observations of lit LEDs, and a mask [n] of dead ones. Sentences on frames that cannot be used
    are added to the remarks. Raises InputError if no LED can be used."""
    places = sorted({view.place for view in views})
    figures = len(_common_names(places))
    rows: list[Row] = []
    lit_elsewhere: set[int] = set()
    for v, view in enumerate(views):
        place = places.index(view.place)
        view_rows = rows_of(v, view, positions, tile, emitter, place=place, figures=figures)
        rows += view_rows.rows
        remarks += view_rows.remarks
        lit_elsewhere |= view_rows.unused_leds
    if not rows:
        raise InputError("LED power: no LED could be used: " + ("; ".join(remarks[:5]) or "all are too low"))
    return without_dark(rows, views, ids, lit_elsewhere, remarks)


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


def _on_tile_mm(view: TileView) -> Floats:
    """Return [m, 2] places of the parts on the tile."""
    turn, middle_mm = view.base_from_tile[:3, :3], view.base_from_tile[:3, 3]
    return np.asarray(((view.points_mm - middle_mm) @ turn)[:, :2])


def _refuse_moved(
    views: Sequence[TileView],
    view_of: NDArray[np.intp],
    residuals: Floats,
    w: Floats,
    design: Floats,
    redundancy: float,
) -> None:
    """Raise InputError if one view fits far better with a tilt of its own, although the tile has the same place in
    other views."""
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
