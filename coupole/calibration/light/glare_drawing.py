"""Picture of the report of veiling glare."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from coupole.calibration.light.drawing import CHANNEL_COLOURS
from coupole.calibration.light.veil import PARTS
from coupole.calibration.report import DARK

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from coupole.calibration.light.glare_fit import GlareFit
    from coupole.calibration.record import Record


def draw_glare(fits: Mapping[str, GlareFit], record: Record, figure: Figure) -> None:
    """Draw the veil of a white picture, the traps against their prediction, the remaining errors by place, and the
    parts."""
    axes = figure.subplots(2, 2)
    green = fits["G"]
    width, height = green.size_px
    x, y = np.meshgrid(np.linspace(0, width - 1, 60), np.linspace(0, height - 1, 45))
    index, _ = green.index(np.stack([x.ravel(), y.ravel()], axis=1))
    extent = (0, width, height, 0)
    image = axes[0, 0].imshow(100 * index.reshape(x.shape), extent=extent, cmap="viridis", aspect="equal")
    axes[0, 0].set(title="Veil of green in a white picture (% of white)", xlabel="x (px)", ylabel="y (px)")
    figure.colorbar(image, ax=axes[0, 0], shrink=0.8)
    for number, (channel, fit) in enumerate(fits.items()):
        colour = CHANNEL_COLOURS[channel]
        axes[0, 1].plot(
            100 * fit.predicted_veil, 100 * fit.found_veil, "o", color=colour, ms=4, mfc="none", label=channel
        )
        places = np.arange(len(PARTS)) + 0.25 * (number - 1)
        u = np.sqrt(np.diag(fit.covariance))
        axes[1, 1].bar(places, 100 * fit.shares, 0.23, yerr=200 * u, color=colour, ecolor=DARK)
    most = 105 * max(float(fit.found_veil.max()) for fit in fits.values())
    axes[0, 1].plot([0, most], [0, most], color=DARK, lw=1)
    axes[0, 1].set(
        title="Traps of each view, predicted from the other views (% of the neighbouring white)",
        xlabel="predicted",
        ylabel="found",
    )
    axes[0, 1].legend(frameon=False)
    off = 100 * (green.found_veil - green.predicted_veil)
    most_off = max(float(np.abs(off).max()), 1e-6)
    dots = axes[1, 0].scatter(
        *green.pixels.T, c=off, cmap="RdBu", vmin=-most_off, vmax=most_off, s=40, ec=DARK, lw=0.3
    )
    axes[1, 0].set(
        title="Measured minus predicted, by place, green (% of white)", xlabel="x (px)", ylabel="y (px)",
        xlim=(0, width), ylim=(height, 0), aspect="equal",
    )  # fmt: skip
    figure.colorbar(dots, ax=axes[1, 0], shrink=0.8)
    axes[1, 1].set(title="Shares of the parts, with two standard uncertainties (%)")
    axes[1, 1].set_xticks(range(len(PARTS)), PARTS)
