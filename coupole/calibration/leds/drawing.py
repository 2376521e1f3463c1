"""The picture of a dome's geometry: uncertainty of each LED, and its distance from its place in the table."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from coupole.calibration.leds.workflow import LedsFound
from coupole.calibration.report import BLUE, DARK, GREY, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ARROW_MM = 120.0
"""Length that the arrow of a typical shift has in the picture."""


def draw_leds(result: LedsFound, figure: Figure) -> None:
    """Fill the figure."""
    axes = figure.subplots(2, 3)
    for ax, (across, up, title) in zip(
        axes[0], ((0, 1, "From above"), (0, 2, "From the side"), (1, 2, "From the front")), strict=True
    ):
        _draw_dome(ax, result, across, up, title)
    _draw_uncertainty(axes[1, 0], result)
    _draw_residuals(axes[1, 1], result)
    _draw_robot(axes[1, 2], result)


def _draw_dome(ax: Axes, result: LedsFound, across: int, up: int, title: str) -> None:
    """Draw the LEDs coloured by their uncertainty. Enlarged arrows lead from a board's place in the table to the
    place that was found. Red rings mark LEDs that were not found."""
    place = result.new_table.positions_mm
    is_known = np.isfinite(result.u_mm)
    order = np.argsort(np.nan_to_num(result.u_mm))
    order = order[is_known[order]]
    x, y = place[:, across], place[:, up]
    dots = ax.scatter(x[order], y[order], c=1e3 * result.u_mm[order], s=9, cmap="viridis", linewidths=0)
    ax.figure.colorbar(dots, ax=ax, label="u of the centre (um)", shrink=0.8)
    ax.scatter(x[~is_known], y[~is_known], s=40, facecolors="none", edgecolors=RED, linewidths=1.5)
    boards = np.unique(result.table.boards)
    before = np.array([result.table.positions_mm[result.table.boards == b].mean(axis=0) for b in boards])
    after = np.array([place[result.table.boards == b].mean(axis=0) for b in boards])
    shift = after - before
    enlargement = _round(_ARROW_MM / max(float(np.median(np.linalg.norm(shift, axis=1))), 1e-6))
    ax.quiver(
        *before[:, [across, up]].T,
        *shift[:, [across, up]].T * enlargement,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.002,
        color=DARK,
    )
    names = "xyz"
    ax.set(
        aspect="equal", xlabel=f"{names[across]} (mm, base)", ylabel=f"{names[up]} (mm, base)",
        title=f"{title}; shifts of boards x {enlargement:g}",
    )  # fmt: skip
    if up == 2:
        ax.invert_yaxis()  # the arm hangs: z of its base points down


def _draw_uncertainty(ax: Axes, result: LedsFound) -> None:
    u_um = result.u_mm[np.isfinite(result.u_mm)] * 1e3
    ax.hist(u_um, bins=40, range=(0, float(np.percentile(u_um, 99.5)) * 1.1), color=BLUE)
    for share, style in ((50, "-"), (95, "--")):
        value = float(np.percentile(u_um, share))
        ax.axvline(value, color=RED, ls=style, label=f"{share} %: {value:.0f} um")
    ax.legend(frameon=False)
    ax.set(title="Uncertainty of centres", xlabel="u (um)", ylabel="LEDs")


def _draw_residuals(ax: Axes, result: LedsFound) -> None:
    """Draw the residuals of all spots. Spots that were left out are red; residuals that are too large for the
    figure are at its rim."""
    residuals, keep = result.geometry.residuals_px, result.geometry.accepted_mask
    reach = 6.0 * float(np.sqrt(np.mean(residuals[keep] ** 2)))
    x, y = np.clip(residuals, -reach, reach).T
    ax.scatter(x[keep], y[keep], s=3, color=BLUE, alpha=0.4, linewidths=0)
    ax.scatter(x[~keep], y[~keep], s=16, color=RED, marker="x")
    ax.axhline(0, color=GREY, lw=0.8)
    ax.axvline(0, color=GREY, lw=0.8)
    out = int((~keep).sum())
    ax.set(
        xlim=(-1.05 * reach, 1.05 * reach), ylim=(-1.05 * reach, 1.05 * reach), aspect="equal",
        title=f"Residuals of {keep.sum()} spots, {out} left out", xlabel="x (px)", ylabel="y (px)",
    )  # fmt: skip


def _draw_robot(ax: Axes, result: LedsFound) -> None:
    """Draw the errors of the arm at each view."""
    views = np.arange(len(result.view_errors))
    ax.plot(
        views,
        1e3 * np.linalg.norm(result.view_errors[:, :3], axis=1),
        "o",
        color=BLUE,
        ms=4,
        label="position (um)",
    )
    turn = 1e3 * np.linalg.norm(result.view_errors[:, 3:], axis=1)
    ax.plot(views, turn, "s", color=RED, ms=4, label="orientation (mdeg)")
    ax.set(title="Errors of the arm", xlabel="view", ylim=(0, None))
    ax.legend(frameon=False)


def _round(value: float) -> float:
    """Return the largest number of the form 1, 2 or 5 times a power of ten that does not exceed the value."""
    ten = 10.0 ** np.floor(np.log10(value))
    return float(ten * max(step for step in (1, 2, 5) if step * ten <= value * (1 + 1e-9)))
