"""The picture of a mesh's pose: stickers and mesh drawn onto a frame, and uncertainties."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from coupole.calibration.report import BLUE, DARK, GREY, RED
from coupole.calibration.stickers.workflow import MeshFound, outline_px, projected_pixels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_SHOWN_PX = 1600


def draw_mesh(result: MeshFound, figure: Figure) -> None:
    """Fill the figure."""
    grid = figure.add_gridspec(2, 3)
    _draw_frame(figure.add_subplot(grid[:, :2]), result)
    _draw_uncertainty(figure.add_subplot(grid[0, 2]), result)
    _draw_views(figure.add_subplot(grid[1, 2]), result)


def _draw_frame(ax: Axes, result: MeshFound) -> None:
    """Draw one frame, with the projected outline of the mesh and the projected stickers of the table."""
    from matplotlib.collections import LineCollection

    image = result.images.picture
    step = max(1, max(image.shape) // _MOST_SHOWN_PX)
    height, width = image.shape
    bright = float(np.percentile(image, 99.5))
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    ax.imshow(np.sqrt(np.clip(image[::step, ::step] / bright, 0, 1)), cmap="gray", extent=extent)
    ax.add_collection(
        LineCollection(
            list(outline_px(result, result.scan.mesh)),
            colors="#6fd08c",
            linewidths=0.8,
            label="outline of the mesh",
        )
    )
    middles_px = np.array([s.middle for s in result.images.stickers[result.images.shown_number]])
    ax.plot(middles_px[:, 0], middles_px[:, 1], "o", ms=13, mfc="none", color=BLUE, label="found in the image")
    should = projected_pixels(result, result.scan.targets_mm)
    ax.plot(should[:, 0], should[:, 1], "+", ms=13, color=RED, label="predicted from the scan and the result")
    ax.set(
        xlim=(0, width), ylim=(height, 0), xlabel="x (px)", ylabel="y (px)",
        title=f"Mesh and stickers laid onto {result.images.names[result.images.shown_number]}",
    )  # fmt: skip
    ax.legend(loc="lower right")


def _draw_uncertainty(ax: Axes, result: MeshFound) -> None:
    """Draw the uncertainty of each sticker's position in the base frame, at its place in the mesh's frame."""
    place = result.scan.targets_mm
    dots = ax.scatter(place[:, 0], place[:, 1], c=1e3 * result.u_mm, s=40, cmap="viridis")
    is_missing = np.isin(result.scan.names, result.pose.missing)
    ax.scatter(place[is_missing, 0], place[is_missing, 1], s=110, facecolors="none", edgecolors=RED)
    ax.figure.colorbar(dots, ax=ax, label="u of its place in the base (um)")
    ax.set(aspect="equal", xlabel="x (mm, mesh)", ylabel="y (mm, mesh)", title="Stickers; red: not found")


def _draw_views(ax: Axes, result: MeshFound) -> None:
    """Draw how many views saw each sticker."""
    counts = [result.pose.views_of.get(name, 0) for name in result.scan.names]
    colours = [BLUE if count else RED for count in counts]
    ax.bar(np.arange(len(counts)), counts, color=colours)
    ax.axhline(0, color=GREY, lw=0.8)
    ax.set(title="Views that saw each sticker", xlabel="sticker", ylabel="views")
    ax.tick_params(labelcolor=DARK)
