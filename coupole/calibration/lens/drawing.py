"""The picture of a lens and hand-eye calibration.

It shows four properties of the residuals: a pattern over the field (which means that the lens model is
insufficient), coverage of the field, single bad images, and normality (without it intervals are not valid). A
picture of a hand-eye calibration shows the robot's errors by pose instead of normality.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from coupole.calibration.lens.workflow import FIELD_CELLS, Shown
from coupole.calibration.report import BLUE, DARK, GREY, RED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_ARROWS = 4000
_MOST_BARS_NAMED = 24


def draw_lens(lens_report: Shown, figure: Figure) -> None:
    """Fill the figure."""
    axes = figure.subplots(2, 2)
    _draw_field(axes[0, 0], lens_report)
    _draw_coverage(axes[0, 1], lens_report)
    _draw_images(axes[1, 0], lens_report)
    if lens_report.pose_errors is None:
        _draw_distribution(axes[1, 1], lens_report)
    else:
        _draw_robot(axes[1, 1], lens_report)


def _draw_field(ax: Axes, lens_report: Shown) -> None:
    """Draw residual vectors at the corners, enlarged; long ones are red."""
    pixels, residuals = np.concatenate(lens_report.pixels), np.concatenate(lens_report.residuals_px)
    step = max(1, len(pixels) // _MOST_ARROWS)
    pixels, residuals = pixels[::step], residuals[::step]
    length = np.linalg.norm(residuals, axis=1)
    width, height = lens_report.size_px
    enlargement = _round(0.02 * width / max(lens_report.pixel_px, 1e-6))
    long = length > 3.0 * lens_report.pixel_px
    for part, colour in ((~long, BLUE), (long, RED)):
        ax.quiver(
            *pixels[part].T,
            *residuals[part].T * enlargement,
            angles="xy",
            scale_units="xy",
            scale=1,
            width=0.0012,
            color=colour,
        )
    key_px = _round(2 * lens_report.pixel_px, 1)
    ax.plot([0.04 * width, 0.04 * width + key_px * enlargement], [0.96 * height] * 2, color=DARK, lw=3)
    ax.text(0.04 * width, 0.94 * height, f"{key_px:g} px", color=DARK)
    ax.set(
        xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="x (px)", ylabel="y (px)",
        title=f"Residuals, enlarged {enlargement:g} times; red: beyond 3 sigma",
    )  # fmt: skip


def _draw_coverage(ax: Axes, lens_report: Shown) -> None:
    """Draw how many corners were seen in each part of the field."""
    pixels = np.concatenate(lens_report.pixels)
    width, height = lens_report.size_px
    cells = np.floor(pixels * FIELD_CELLS / lens_report.size_px).astype(int)
    count = np.zeros(FIELD_CELLS[::-1])
    np.add.at(count, (cells[:, 1], cells[:, 0]), 1)
    ax.imshow(count, extent=(0, width, height, 0), cmap="Blues", vmin=0, aspect="equal")
    for (row, column), corners in np.ndenumerate(count):
        at = ((column + 0.5) * width / FIELD_CELLS[0], (row + 0.5) * height / FIELD_CELLS[1])
        bright = "white" if corners > 0.6 * count.max() else DARK
        style: dict[str, Any] = {"color": bright} if corners else {"color": RED, "weight": "bold"}
        ax.text(*at, f"{corners:.0f}", ha="center", va="center", **style)
    ax.set(title="Corners seen in each part of the field", xlabel="x (px)", ylabel="y (px)")


def _draw_images(ax: Axes, lens_report: Shown) -> None:
    """Draw the root mean square residual of each image, and the one expected from noise alone."""
    rms = [np.sqrt(np.mean(np.sum(r**2, axis=1))) for r in lens_report.residuals_px]
    expected_px = lens_report.pixel_px * np.sqrt(2)
    place = np.arange(len(rms))
    ax.bar(place, rms, color=[RED if value > 2 * expected_px else BLUE for value in rms], width=0.8)
    ax.axhline(expected_px, color=DARK, ls="--", lw=1)
    ax.annotate(
        f"noise of a corner: {lens_report.pixel_px:.3g} px in x and y",
        (1.0, expected_px),
        xycoords=("axes fraction", "data"),
        ha="right",
        va="bottom",
        color=DARK,
        bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1},
    )
    every = max(1, -(-len(rms) // _MOST_BARS_NAMED))
    ax.set_xticks(place[::every], [_short(name) for name in lens_report.names[::every]], rotation=60, ha="right")
    ax.set(title="Residual of each image, root mean square", ylabel="px", xlim=(-0.7, len(rms) - 0.3))


def _draw_distribution(ax: Axes, lens_report: Shown) -> None:
    """Draw the residuals divided by their noise, beside the normal distribution."""
    normal = np.concatenate(lens_report.residuals_px).ravel() / max(lens_report.pixel_px, 1e-12)
    grid = np.linspace(-4.5, 4.5, 181)
    ax.hist(np.clip(normal, -4.5, 4.5), bins=60, density=True, color=GREY, range=(-4.5, 4.5))
    ax.plot(grid, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), color=BLUE, lw=2)
    inside = np.mean(np.abs(normal) < 1.96)
    ax.set(
        title=f"Residuals divided by their noise; {inside:.1%} within 1.96 (normal: 95 %)",
        xlabel="residual / sigma", yticks=[], xlim=(-4.5, 4.5),
    )  # fmt: skip
    ax.spines["left"].set_visible(False)


def _draw_robot(ax: Axes, lens_report: Shown) -> None:
    """Draw the error of each pose, position on the left and rotation on the right."""
    assert lens_report.pose_errors is not None
    off_mm = np.linalg.norm(lens_report.pose_errors[:, :3], axis=1)
    off_deg = np.linalg.norm(lens_report.pose_errors[:, 3:], axis=1)
    place = np.arange(len(off_mm))
    ax.bar(place - 0.2, off_mm, 0.4, color=BLUE, label="position (mm)")
    ax.set_ylabel("mm", color=BLUE)
    right = ax.twinx()
    right.bar(place + 0.2, off_deg, 0.4, color=GREY, label="turn (deg)")
    right.set_ylabel("deg", color="#6c757d")
    right.spines[["top"]].set_visible(False)
    noise = {n.name: n for n in lens_report.record.noise}
    position, turn = noise["robot position"], noise["robot orientation"]
    ax.set_title(
        "Errors of the robot by pose (blue position, grey turn)\n"
        f"found {position.found:.3g} mm, {turn.found:.3g} deg; "
        f"stated {position.stated:.3g} mm, {turn.stated:.3g} deg"
    )
    every = max(1, -(-len(place) // _MOST_BARS_NAMED))
    ax.set_xticks(place[::every], [_short(name) for name in lens_report.names[::every]], rotation=60, ha="right")


def _short(name: str) -> str:
    return name if len(name) <= 18 else f"{name[:8]}..{name[-8:]}"


def _round(value: float, digits: int = 1) -> float:
    return float(f"{value:.{digits}g}")
