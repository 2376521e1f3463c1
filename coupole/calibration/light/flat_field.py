"""Flat field: the light at each pixel divided by the light at the field's brightest point, per channel.

The source is Lucat et al. 2025, section 4.2 (g in its Eq. 1). A luminous panel is photographed, shifted and
turned. Its signal is a_v * g(p) * s(q). Here a_v is the view's brightness. g is the lens's fall-off, which depends
on the pixel p. s is the panel's unevenness, which depends on the place q on the panel. Views that differ in shift
and rotation separate the two. In logarithms

    ln g = -2 ln(1 + r^2/f^2) + k1 (r/R)^2 + k2 (r/R)^4 + k3 (r/R)^6,   r = |p - centre|,   R half the diagonal,
    ln s = e1 x + e2 y + e3 x^2 + e4 x y + e5 y^2,                      (x, y) = q / `panel_scale_mm`.

The first term is cos^4 with the focal length f; the polynomial is the departure of a real lens from it. Images are
reduced to means of blocks of pixels. Dust and dead pixels do not affect the result, because a block's mean leaves
out outliers, and its weight decreases with its residual (Tukey). A block has the same error in all views (from its
pixels' responses). So the covariance is computed for clusters of blocks ("sandwich", Liang and Zeger 1986), with
leave-one-out residuals (Bell and McCaffrey 2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.flat_suspects import FlatCauses, flat_causes, form_modes
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

G_NAMES = ("cx_px", "cy_px", "k1", "k2", "k3")
PANEL_NAMES = ("e1", "e2", "e3", "e4", "e5")
_TUKEY = 4.685
_ROUNDS = 40
_MAD = 1.4826
_LEAST_BLOCKS = 60
_INDEFINITE = 1e11


@dataclass(frozen=True)
class FlatView:
    """One view of the panel, reduced to blocks; NaN where a block cannot be used."""

    name: str
    pixels: Floats
    """[n, 2] centres of the blocks, column and row."""
    signal: Floats
    """[n] means, in any unit that is linear in light."""
    panel_mm: Floats
    """[n, 2] places on the panel that the blocks show."""


@dataclass(frozen=True)
class FlatField:
    """Fall-off of one channel."""

    channel: str
    parameters: Floats
    """[5] values of the parameters `G_NAMES`."""
    covariance: Floats
    """[5, 5]."""
    focal_px: float
    """Focal length f, held. The polynomial absorbs an error of this focal length."""
    size_px: tuple[int, int]
    """Width and height."""
    panel: Floats
    """[5] unevenness of the panel, as the parameters `PANEL_NAMES`."""
    panel_covariance: Floats
    residual: float
    """Robust relative standard deviation of a block."""
    residuals: tuple[Floats, ...]
    """Relative residuals of each view; NaN where a block was not used."""
    rejected_share: float
    """Share of the blocks with weight 0."""
    views: tuple[str, ...]
    degrees_of_freedom: float
    form: Floats
    """[modes] coefficients of a fall-off that is not round (`form_modes`); none without a search."""
    field_covariance: Floats
    """[5 + modes, 5 + modes] covariance of the parameters and these coefficients."""
    causes: FlatCauses

    def at(self, pixels: Floats) -> Floats:
        """Return g [...] at pixels [..., 2]. It is 1 at its centre."""
        radial, _ = _radial(pixels, self.parameters[:2], self.focal_px, self.size_px)
        log = radial[0] + np.tensordot(self.parameters[2:], radial[1:], 1)
        if self.form.any():
            log = log + form_modes(pixels, self.size_px) @ self.form
        value: Floats = np.exp(log)
        return value

    def u_at(self, pixels: Floats) -> Floats:
        """Return the relative standard uncertainty [...] of g at pixels [..., 2] against the mean over the field.

        A common factor of g is also in the LEDs' power and cancels in every reflectance.
        """
        grid = _grid(self.size_px)
        mean = self._slopes(grid).mean(axis=1).reshape(-1, *[1] * (pixels.ndim - 1))
        by = self._slopes(pixels) - mean
        return np.asarray(np.sqrt(np.einsum("i...,ij,j...->...", by, self.field_covariance, by)))

    def map(self) -> NDArray[np.float32]:
        """Return [H, W], g of every pixel."""
        width, height = self.size_px
        columns = np.arange(width, dtype=float)
        rows = (np.column_stack([columns, np.full(width, float(row))]) for row in range(height))
        return np.stack([self.at(row).astype(np.float32) for row in rows])

    def _slopes(self, pixels: Floats) -> Floats:
        """Return [5 + modes, ...], derivatives of ln g."""
        radial, by_centre = _radial(pixels, self.parameters[:2], self.focal_px, self.size_px)
        centre_slopes = by_centre[:, 0] + np.einsum("k,ck...->c...", self.parameters[2:], by_centre[:, 1:])
        own = np.concatenate([centre_slopes, radial[1:]])
        if not len(self.form):
            return own
        return np.concatenate([own, np.moveaxis(form_modes(pixels, self.size_px), -1, 0)])


def fit_flat_field(
    views: Sequence[FlatView],
    *,
    channel: str,
    focal_px: float,
    size_px: tuple[int, int],
    panel_scale_mm: float = 100.0,
    search: bool = True,
) -> FlatField:
    """Fit one channel. Without `search`, causes that the model lacks are left out. Raises InputError if the views
    do not separate panel and lens, or have too few blocks."""
    usable = [np.isfinite(view.signal) & (view.signal > 0) for view in views]
    if len(views) < 3 or min(int(u.sum()) for u in usable) < _LEAST_BLOCKS:
        least = min((int(u.sum()) for u in usable), default=0)
        raise InputError(
            f"flat field: expected three views or more with {_LEAST_BLOCKS} usable blocks each, found "
            f"{len(views)} with {least} or more; photograph the panel, shifted and turned, filling the field, "
            "unsaturated"
        )
    blocks = _gathered_blocks(views, usable, panel_scale_mm)
    fit = _fit(blocks, len(views), focal_px, size_px)
    causes = _no_causes(blocks, fit)
    if search:
        places = blocks.panel_terms[:, :2]
        causes = flat_causes(blocks.pixels, places, fit.residuals, fit.design, fit.weight > 0.0, size_px)
    parts = np.split(fit.residuals, np.cumsum([int(u.sum()) for u in usable])[:-1])
    residuals = []
    for use, part in zip(usable, parts, strict=True):
        whole = np.full(len(use), np.nan)
        whole[use] = part
        residuals.append(whole)
    clusters, count = len(np.unique(blocks.pixels, axis=0)), fit.design.shape[1]
    return FlatField(
        channel,
        fit.parameters + causes.step[:5],
        causes.joint_covariance[:5, :5],
        focal_px,
        size_px,
        fit.panel + causes.step[-5:],
        causes.joint_covariance[np.ix_(*[np.arange(count - 5, count)] * 2)],
        fit.sigma,
        tuple(residuals),
        float(np.mean(fit.weight == 0.0)),
        tuple(view.name for view in views),
        float(max(1, clusters - count)),
        causes.form,
        causes.joint_covariance[
            np.ix_(*[np.append(np.arange(5), np.arange(count, len(causes.joint_covariance)))] * 2)
        ],
        causes,
    )


def _no_causes(blocks: _Blocks, fit: _Fit) -> FlatCauses:
    covariance = _clustered_covariance(fit.design, fit.weight, fit.residuals, blocks.pixels)
    return FlatCauses(np.zeros(len(covariance)), np.zeros(0), covariance, (), 0.0, 0.0)


@dataclass(frozen=True)
class _Blocks:
    """The usable blocks of all views."""

    pixels: Floats
    """[b, 2] centres."""
    logs: Floats
    """[b] logarithms of their signals."""
    view: NDArray[np.intp]
    """[b] number of the view."""
    panel_terms: Floats
    """[b, 5] derivatives of ln s by `PANEL_NAMES`."""


def _gathered_blocks(
    views: Sequence[FlatView], used_masks: Sequence[NDArray[np.bool_]], panel_scale_mm: float
) -> _Blocks:
    pixels = np.concatenate([view.pixels[u] for view, u in zip(views, used_masks, strict=True)])
    logs = np.log(np.concatenate([view.signal[u] for view, u in zip(views, used_masks, strict=True)]))
    places = np.concatenate([view.panel_mm[u] for view, u in zip(views, used_masks, strict=True)]) / panel_scale_mm
    number = np.concatenate([np.full(int(u.sum()), i) for i, u in enumerate(used_masks)])
    x, y = places.T
    return _Blocks(pixels, logs, number, np.column_stack([x, y, x * x, x * y, y * y]))


@dataclass(frozen=True)
class _Fit:
    parameters: Floats
    """[5] values of the parameters `G_NAMES`."""
    panel: Floats
    """[5] values of the parameters `PANEL_NAMES`."""
    design: Floats
    """[b, 10 + views] derivatives of the logarithms."""
    residuals: Floats
    """[b] residuals."""
    weight: Floats
    """[b] Tukey's weights."""
    sigma: float
    """Robust standard deviation of the residuals."""


def _fit(blocks: _Blocks, views: int, focal_px: float, size_px: tuple[int, int]) -> _Fit:
    """Run Gauss-Newton with Tukey's weights. Raises InputError if panel and lens cannot be separated."""
    brightness = np.eye(views)[blocks.view]
    p = np.concatenate([np.array([size_px[0] - 1, size_px[1] - 1]) / 2.0, np.zeros(3)])
    rest = np.zeros(views + 5)
    weight = np.ones(len(blocks.logs))
    sigma, residuals = 0.0, blocks.logs
    design = np.zeros((len(blocks.logs), 0))
    for _ in range(_ROUNDS):
        radial, by_centre = _radial(blocks.pixels, p[:2], focal_px, size_px)
        centre_slopes = by_centre[:, 0] + np.einsum("k,ckn->cn", p[2:], by_centre[:, 1:])
        design = np.column_stack([centre_slopes.T, radial[1:].T, brightness, blocks.panel_terms])
        residuals = blocks.logs - radial[0] - radial[1:].T @ p[2:] - design[:, 5:] @ rest
        scale = np.linalg.norm(design, axis=0)
        normal = (design / scale).T @ ((design / scale) * weight[:, None])
        if np.linalg.cond(normal) > _INDEFINITE:
            raise InputError(
                "flat field: these views cannot separate the panel's unevenness from the lens's fall-off; add "
                "views "
                "shifted both ways by a third of the field, and turned by 90 degrees or more about the view"
            )
        step = np.linalg.solve(normal, (design / scale).T @ (weight * residuals)) / scale
        # Steps of the centre are limited: far outside the field, fall-off is no longer radial about it.
        step[:2] = np.clip(step[:2], -0.1 * max(size_px), 0.1 * max(size_px))
        p, rest = p + step[:5], rest + step[5:]
        residuals = residuals - design @ step
        sigma = max(_MAD * float(np.median(np.abs(residuals))), 1e-9)
        weight = np.clip(1.0 - (residuals / (_TUKEY * sigma)) ** 2, 0.0, None) ** 2
        if np.abs(step[:2]).max() < 1e-3 and np.abs(step[2:5]).max() < 1e-7:
            break
    return _Fit(p, rest[-5:], design, residuals, weight, sigma)


def block_means(
    image: Floats, mask: NDArray[np.bool_], block_px: int, *, saturation_mask: NDArray[np.bool_] | None = None
) -> tuple[Floats, Floats]:
    """Return centres [n, 2] and means [n] of the masked pixels of square blocks; NaN for a block with saturated
    pixels.

    A block's mean leaves out pixels that lie 4 robust standard deviations from its median, such as dust and hot
    pixels.
    """
    height, width = image.shape
    rows, columns = height // block_px, width // block_px
    centres, means = [], []
    for i in range(rows):
        for j in range(columns):
            part = slice(i * block_px, (i + 1) * block_px), slice(j * block_px, (j + 1) * block_px)
            values = image[part][mask[part]]
            centres.append(((j + 0.5) * block_px - 0.5, (i + 0.5) * block_px - 0.5))
            full = saturation_mask is not None and bool(saturation_mask[part][mask[part]].mean() > 1e-3)
            middle = np.median(values)
            scatter = _MAD * np.median(np.abs(values - middle))
            inliers = values[np.abs(values - middle) <= 4.0 * max(float(scatter), 1e-9)]
            means.append(np.nan if full or not len(inliers) else float(inliers.mean()))
    return np.array(centres), np.array(means)


@dataclass(frozen=True)
class Spot:
    """Dust on the sensor: pixels that are darker than their neighbours in all views."""

    column_px: float
    row_px: float
    pixels: int
    depth: float
    """Largest relative loss."""


def dust_spots(ratio: NDArray[np.float32], *, smooth_px: int = 5, least_depth: float = 0.01) -> list[Spot]:
    """Find spots in the ratio [H, W]: the mean over the views of signal divided by fitted signal (NaN where it is
    unknown). The deepest spot is first.

    The ratio is smoothed over `smooth_px`, so that single pixels with a low response do not count as dust.
    """
    from scipy import ndimage

    is_known = np.isfinite(ratio)
    filled_ratio = np.where(is_known, ratio, 1.0)
    smooth = ndimage.uniform_filter(filled_ratio, smooth_px)
    middle = float(np.median(smooth))
    scatter = _MAD * float(np.median(np.abs(smooth - middle)))
    dark = smooth < middle - max(least_depth, 6.0 * scatter)
    labels, _ = ndimage.label(dark)
    spots = []
    for label, where in enumerate(ndimage.find_objects(labels), 1):
        inside = labels[where] == label
        at = np.argwhere(inside).mean(axis=0) + np.array([where[0].start, where[1].start])
        depth = float(middle - smooth[where][inside].min())
        spots.append(Spot(float(at[1]), float(at[0]), int(inside.sum()), depth))
    return sorted(spots, key=lambda spot: -spot.depth)


def panel_places(
    pixels: Floats, focal_px: float, size_px: tuple[int, int], base_from_camera: Floats, base_from_panel: Floats
) -> Floats:
    """Return [n, 2] mm: the points of the panel's plane z = 0 at pixels [n, 2] of a pinhole camera."""
    centre = (np.array(size_px) - 1) / 2.0
    rays = np.column_stack([(pixels - centre) / focal_px, np.ones(len(pixels))])
    panel_from_camera = np.linalg.inv(base_from_panel) @ base_from_camera
    directions, origin = rays @ panel_from_camera[:3, :3].T, panel_from_camera[:3, 3]
    places: Floats = (origin - directions * (origin[2] / directions[:, 2])[:, None])[:, :2]
    return places


def _radial(pixels: Floats, centre: Floats, focal_px: float, size_px: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return ln cos^4 and the powers 2, 4, 6 of r/R [4, ...], and their derivatives by the centre's x and y [2, 4,
    ...]."""
    reach = 0.5 * float(np.hypot(*size_px))
    away = np.moveaxis(np.asarray(pixels, float), -1, 0) - np.reshape(centre, (2, *[1] * (np.ndim(pixels) - 1)))
    square = (away**2).sum(axis=0)
    s = square / reach**2
    radial = np.stack([-2.0 * np.log1p(square / focal_px**2), s, s**2, s**3])
    by_square = np.stack(
        [-2.0 / (focal_px**2 + square), np.full_like(s, reach**-2), 2 * s / reach**2, 3 * s**2 / reach**2]
    )
    return radial, -2.0 * away[:, None] * by_square[None]


def _clustered_covariance(design: Floats, weight: Floats, residuals: Floats, pixels: Floats) -> Floats:
    """Return the covariance of a weighted fit in which a block has the same error in all views."""
    scale = np.linalg.norm(design, axis=0)
    scaled_design = design / scale
    bread = np.linalg.inv(scaled_design.T @ (scaled_design * weight[:, None]))
    _, cluster = np.unique(pixels, axis=0, return_inverse=True)
    order = np.argsort(cluster.ravel(), kind="stable")
    starts = np.flatnonzero(np.diff(cluster.ravel()[order])) + 1
    scores = []
    for members in np.split(order, starts):
        member_design, root = scaled_design[members], np.sqrt(weight[members])
        hat = (root[:, None] * member_design) @ bread @ (member_design * root[:, None]).T
        # A block at the field's rim has leverage on the fit; its residual is that of a fit without it.
        alone = np.linalg.solve(np.eye(len(members)) - hat, root * residuals[members])
        scores.append((member_design * root[:, None]).T @ alone)
    middle = np.array(scores).T @ np.array(scores)
    # Derivative of the weighted residuals by a step: that of Tukey's psi, which is less than its weight.
    u2 = 1.0 - np.sqrt(weight)
    answer = np.linalg.inv(scaled_design.T @ (scaled_design * (np.sqrt(weight) * (1.0 - 5.0 * u2))[:, None]))
    return np.asarray(answer @ middle @ answer / scale / scale[:, None])


def _grid(size_px: tuple[int, int]) -> Floats:
    x, y = np.meshgrid(np.linspace(0, size_px[0] - 1, 13), np.linspace(0, size_px[1] - 1, 13))
    return np.column_stack([x.ravel(), y.ravel()])
