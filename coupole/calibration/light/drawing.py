"""Pictures of the radiometric calibrations' reports. Each shows possible errors of its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.report import BLUE, DARK, GREY, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from coupole.calibration.light.dark import Dark
    from coupole.calibration.light.flat_field import FlatField, Spot
    from coupole.calibration.light.led_power import LedPower
    from coupole.calibration.light.linearity import Linearity
    from coupole.calibration.light.photon_transfer import PhotonTransfer
    from coupole.calibration.light.tile_views import Positions
    from coupole.calibration.record import Record

CHANNEL_COLOURS = {"R": RED, "G": "#2d7d46", "B": BLUE}
_MOST_SIDE = 800
"""Largest number of pixels along a side of a map in a picture."""


def draw_dark(dark: Dark, record: Record, figure: Figure) -> None:
    """Offset map, dark current's distribution, mean level by exposure, noise's distribution."""
    axes = figure.subplots(2, 2)
    _map(axes[0, 0], dark.offset_dn, "Offset of the pixels (DN)")
    current = dark.current_dn_per_s
    ax = axes[0, 1]
    high = max(float(current.max()), 1.0)
    bins = np.geomspace(max(float(np.median(current)) / 10, 0.01), high * 1.1, 90)
    ax.hist(current.ravel(), bins=bins, color=GREY)
    if len(dark.hot):
        hot = current[dark.hot[:, 0], dark.hot[:, 1]]
        ax.hist(hot, bins=bins, color=RED)
    ax.set(
        xscale="log", yscale="log", xlabel="dark current (DN/s)", ylabel="pixels",
        title=f"Dark current: median {np.median(current):.3g} DN/s, {len(dark.hot)} hot pixels in red",
    )  # fmt: skip
    exposure_s, _, level = np.array(dark.levels).T
    ax = axes[1, 0]
    ax.plot(exposure_s * 1e3, level, "o", color=BLUE, ms=5, mfc="none")
    t = np.linspace(0, exposure_s.max() * 1.02, 50)
    ax.plot(t * 1e3, np.median(dark.offset_dn) + np.median(current) * t, color=DARK, lw=1)
    ax.set(title="Mean of each frame, and the median pixel's line", xlabel="exposure (ms)", ylabel="DN")
    ax = axes[1, 1]
    high = float(np.quantile(dark.noise_dn, 0.999))
    ax.hist(dark.noise_dn.ravel(), bins=120, range=(0.0, 1.2 * high), color=GREY)
    ax.axvline(dark.read_noise_dn, color=BLUE, lw=2)
    ax.set(
        title=f"Noise of the pixels; read noise {dark.read_noise_dn:.3g} DN, of rows {dark.row_noise_dn:.2g} DN",
        xlabel="standard deviation about the line (DN)", yticks=[],
    )  # fmt: skip
    ax.spines["left"].set_visible(False)


def draw_response(
    transfers: Mapping[str, PhotonTransfer], lines: Mapping[str, Linearity], record: Record, figure: Figure
) -> None:
    """Photon transfer and its residuals, signal by exposure, deviation from a line."""
    axes = figure.subplots(2, 2)
    for channel, transfer in transfers.items():
        colour = CHANNEL_COLOURS[channel]
        x, y, use = transfer.signal_dn, transfer.variance_dn2, transfer.used_levels
        line = transfer.read_noise_dn.value**2 + 1.0 / 12.0 + transfer.gain_dn_per_e.value * x
        per_dn = transfer.electrons_per_dn
        label = f"{channel}: {per_dn.value:.3f} ({per_dn.u:.1g}) e/DN, read {transfer.read_noise_e.value:.3g} e"
        axes[0, 0].plot(x, line, color=colour, lw=1, label=label)
        axes[0, 0].plot(x[use], y[use], "o", color=colour, ms=5, mfc="none")
        axes[0, 0].plot(x[~use], y[~use], "x", color=colour, ms=5)
        off = 100 * (y / line - 1.0)
        axes[0, 1].errorbar(
            x[use], off[use], 100 * transfer.u_variance_dn2[use] / line[use], fmt="o", color=colour, ms=4, lw=1
        )
    axes[0, 0].set(title="Photon transfer", xlabel="signal above dark (DN)", ylabel="variance (DN$^2$)")
    axes[0, 0].legend(frameon=False)
    axes[0, 1].axhline(0, color=DARK, lw=1)
    axes[0, 1].set(
        title="Deviation of the variance from its line; bars: one sigma",
        xlabel="signal above dark (DN)",
        ylabel="%",
    )
    for channel, straight in lines.items():
        colour = CHANNEL_COLOURS[channel]
        t, signal = straight.exposures_us * 1e-3, straight.signals_dn
        for group in (0, len(signal) // 2, len(signal) - 1):
            axes[1, 0].plot(t, signal[group], "o-", color=colour, ms=4, lw=1, mfc="none")
        is_known = np.isfinite(straight.deviations)
        axes[1, 1].plot(signal[is_known], 100 * straight.deviations[is_known], ".", color=colour, ms=5)
        x = np.linspace(0.02, 1, 100) * straight.range_dn
        axes[1, 1].plot(x, 100 * (x / straight.linear(x) - 1), color=colour, lw=1.5)
    axes[1, 0].set(
        title="Darkest, middle and brightest pixels", xlabel="exposure (ms)", ylabel="signal above dark (DN)",
        xscale="log", yscale="log",
    )  # fmt: skip
    axes[1, 1].axhline(0, color=DARK, lw=1)
    axes[1, 1].set(
        title="Deviation from a straight line; lines: correction", xlabel="signal above dark (DN)", ylabel="%"
    )


def draw_flat_field(
    fits: Mapping[str, FlatField],
    ratio: NDArray[np.float32],
    spots: Sequence[Spot],
    record: Record,
    figure: Figure,
) -> None:
    """Fall-off of green, profiles of each channel with their uncertainty, residuals, response of single pixels."""
    axes = figure.subplots(2, 2)
    green = fits["G"]
    width, height = green.size_px
    x, y = np.meshgrid(np.linspace(0, width - 1, 160), np.linspace(0, height - 1, 120))
    g = green.at(np.stack([x, y], axis=-1))
    image = axes[0, 0].imshow(g, extent=(0, width, height, 0), cmap="viridis", aspect="equal")
    levels = axes[0, 0].contour(x, y, g, levels=8, colors="white", linewidths=0.7)
    axes[0, 0].clabel(levels, fmt="%.2f", fontsize=8)
    axes[0, 0].plot(*green.parameters[:2], "+", color="white", ms=12)
    axes[0, 0].set(title="Fall-off g of green", xlabel="x (px)", ylabel="y (px)")
    figure.colorbar(image, ax=axes[0, 0], shrink=0.8)
    across = np.linspace(0.0, 1.0, 200)
    diagonal = np.stack([across * (width - 1), across * (height - 1)], axis=-1)
    place = (across - 0.5) * np.hypot(width, height)
    for channel, fit in fits.items():
        profile, u = fit.at(diagonal), fit.u_at(diagonal)
        colour = CHANNEL_COLOURS[channel]
        axes[0, 1].plot(place, profile, color=colour, lw=1.5, label=channel)
        axes[0, 1].fill_between(
            place, profile * (1 - 20 * u), profile * (1 + 20 * u), color=colour, alpha=0.2, lw=0
        )
    axes[0, 1].legend(frameon=False)
    axes[0, 1].set(title="g along the diagonal; bands: 20 standard uncertainties", xlabel="from the middle (px)")
    residuals = np.nanmean(np.stack(green.residuals), axis=0)
    size = round(np.sqrt(width * height / len(residuals)))
    columns = width // size
    limit = 3 * green.residual
    image = axes[1, 0].imshow(
        100 * residuals[: len(residuals) // columns * columns].reshape(-1, columns),
        extent=(0, width, height, 0), cmap="RdBu", vmin=-100 * limit, vmax=100 * limit, aspect="equal",
    )  # fmt: skip
    axes[1, 0].set(title="Residuals of green, mean of all views (%)", xlabel="x (px)", ylabel="y (px)")
    figure.colorbar(image, ax=axes[1, 0], shrink=0.8)
    _map(axes[1, 1], 100 * (ratio - 1), f"Pixels' own response (%), {len(spots)} dust spots ringed")
    for spot in spots[:40]:
        axes[1, 1].plot(spot.column_px, spot.row_px, "o", color=RED, ms=12, mfc="none")


def draw_led_power(powers: Mapping[str, LedPower], positions: Positions, record: Record, figure: Figure) -> None:
    """Power over the dome, its distribution, uncertainty by LED, residuals by view."""
    axes = figure.subplots(2, 2)
    green = powers["G"]
    lit = np.isfinite(green.power) & (green.power > 0)
    relative = green.power / np.mean(green.power[lit])
    x, y = _dome_map(positions, green.ids)
    dots = axes[0, 0].scatter(x[lit], y[lit], c=relative[lit], cmap="viridis", s=14)
    axes[0, 0].plot(x[green.power == 0], y[green.power == 0], "x", color=RED, ms=9, mew=2)
    axes[0, 0].set(
        title="Power of green divided by the mean; dead LEDs in red", aspect="equal", xticks=[], yticks=[]
    )
    axes[0, 0].spines[["left", "bottom"]].set_visible(False)
    figure.colorbar(dots, ax=axes[0, 0], shrink=0.8)
    for channel, power in powers.items():
        good = np.isfinite(power.power) & (power.power > 0)
        colour = CHANNEL_COLOURS[channel]
        values = power.power[good] / np.mean(power.power[good])
        label = f"{channel}: {np.std(values):.1%}"
        axes[0, 1].hist(values, bins=40, histtype="step", color=colour, lw=1.5, label=label)
        axes[1, 0].plot(power.ids[good], 100 * power.u_own[good], ".", color=colour, ms=3)
        axes[1, 0].plot(power.ids[good], 100 * power.u_against_mean()[good], ".", color=colour, ms=3, alpha=0.3)
    axes[0, 1].legend(frameon=False, title="spread")
    axes[0, 1].set(title="Power divided by the mean", ylabel="LEDs")
    axes[1, 0].set(
        title="Relative standard uncertainty of each LED: from its own noise (dark), relative to the mean (pale)",
        xlabel="LED", ylabel="%", yscale="log",
    )  # fmt: skip
    view_residuals = [residuals[np.isfinite(residuals)] for residuals in green.residuals]
    axes[1, 1].boxplot([100 * part for part in view_residuals if len(part)], showfliers=False, patch_artist=False)
    axes[1, 1].axhline(0, color=GREY, lw=1)
    axes[1, 1].set(title=f"Residuals of green by view; noise {green.noise:.2%}", xlabel="view", ylabel="%")


def _dome_map(positions: Positions, ids: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions of LEDs on a plane map, degrees, as seen from the point where their axes intersect, with
    true angles to the dome's axis."""
    centres_mm, normals = positions.of(ids)
    across = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    middle_mm = np.linalg.lstsq(across.sum(axis=0), (across @ centres_mm[:, :, None]).sum(axis=0)[:, 0])[0]
    inwards = middle_mm - centres_mm
    inwards /= np.linalg.norm(inwards, axis=1)[:, None]
    axis = inwards.mean(axis=0)
    axis /= np.linalg.norm(axis)
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    u = np.cross(helper, axis)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    polar_deg = np.degrees(np.arccos(np.clip(inwards @ axis, -1.0, 1.0)))
    turn = np.arctan2(-(inwards @ v), -(inwards @ u))
    return polar_deg * np.cos(turn), polar_deg * np.sin(turn)


def _map(ax: Axes, values: NDArray[np.float32], title: str) -> None:
    """Draw a map [H, W], subsampled, between its 0.5 and 99.5 % quantiles."""
    step = max(1, -(-max(values.shape) // _MOST_SIDE))
    thin = values[::step, ::step]
    low, high = np.nanquantile(thin, [0.005, 0.995])
    extent = (0, values.shape[1], values.shape[0], 0)
    image = ax.imshow(thin, extent=extent, cmap="viridis", vmin=low, vmax=high, aspect="equal")
    ax.set(title=title, xlabel="x (px)", ylabel="y (px)")
    ax.figure.colorbar(image, ax=ax, shrink=0.8)
