"""The picture of a colour profile: the chart, errors of patches, a*b*, tone, edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from coupole.calibration.colour.chart import KnownChart
from coupole.calibration.colour.slanted_edge import SlantedEdge
from coupole.calibration.report import BLUE, DARK, GREY, RED
from coupole.calibration.rotations import Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from coupole.calibration.record import Record


@dataclass(frozen=True)
class ShownChart:
    """A plain picture of the chart, reduced, with the places where its patches were read."""

    picture: Floats
    """[h, w, 3] from 0 to 1, encoded for displays."""
    polygons_px: Floats
    """[patches, 4, 2] in pixels of `picture`."""
    names: Sequence[str]
    name: str


def draw_colour(
    known_chart: KnownChart,
    lab: Floats,
    de: Floats,
    edges: Sequence[tuple[str, SlantedEdge]],
    shown_chart: ShownChart | None,
    record: Record,
    figure: Figure,
) -> None:
    """Fill the figure. `lab` [patches, 3] is from the profile, and `de` [patches] is CIEDE2000 of left-out
    patches. The last part shows the chart as it was found in a picture, or the response at `edges`."""
    axes = figure.subplots(2, 2)
    names = known_chart.chart.patch_names
    axes[0, 0].bar(range(len(de)), de, color=BLUE)
    axes[0, 0].set_xticks(range(len(de)), names, rotation=90, fontsize=8)
    axes[0, 0].axhline(float(np.mean(de)), color=GREY)
    axes[0, 0].set(title="CIEDE2000 of each patch by a profile without it", ylabel="dE00")
    for seen_lab, true_lab in zip(lab, known_chart.lab, strict=True):
        axes[0, 1].plot([true_lab[1], seen_lab[1]], [true_lab[2], seen_lab[2]], color=GREY)
    axes[0, 1].plot(known_chart.lab[:, 1], known_chart.lab[:, 2], "o", color=DARK, mfc="none", label="chart")
    axes[0, 1].plot(lab[:, 1], lab[:, 2], ".", color=RED, label="by the profile")
    axes[0, 1].legend(frameon=False)
    axes[0, 1].set(title="a*, b*", xlabel="a*", ylabel="b*", aspect="equal")
    grey = list(known_chart.neutral)
    axes[1, 0].axhline(0.0, color=GREY)
    axes[1, 0].plot(known_chart.lab[grey, 0], (lab - known_chart.lab)[grey, 0], "o-", color=BLUE)
    axes[1, 0].set(
        title="Tone: greys by the profile minus greys of the chart", xlabel="L*", ylabel="difference of L*"
    )
    if shown_chart is not None:
        _draw_chart(axes[1, 1], shown_chart)
        return
    for name, edge in edges:
        axes[1, 1].plot(edge.frequencies, edge.response, label=name)
    axes[1, 1].axvline(0.5, color=GREY)
    axes[1, 1].set(title="Spatial frequency response, green", xlabel="cycles per pixel", ylim=(0, 1.2))
    if edges:
        axes[1, 1].legend(frameon=False)


def _draw_chart(axes: Any, shown_chart: ShownChart) -> None:
    axes.imshow(shown_chart.picture, interpolation="nearest")
    for name, polygon in zip(shown_chart.names, shown_chart.polygons_px, strict=True):
        for colour, width in ((DARK, 2.5), ("white", 1.0)):
            axes.plot(*np.vstack([polygon, polygon[:1]]).T, color=colour, linewidth=width)
        axes.text(*polygon.mean(axis=0), name, color="white", fontsize=8, ha="center", va="center").set_bbox(
            {"facecolor": DARK, "alpha": 0.6, "edgecolor": "none", "pad": 1.0}
        )
    low, high = shown_chart.polygons_px.min(axis=(0, 1)), shown_chart.polygons_px.max(axis=(0, 1))
    room = 0.15 * (high - low).max()
    height, width = shown_chart.picture.shape[:2]
    axes.set(
        title=f"Where the patches were read in {shown_chart.name}",
        xlim=(max(low[0] - room, -0.5), min(high[0] + room, width - 0.5)),
        ylim=(min(high[1] + room, height - 0.5), max(low[1] - room, -0.5)),
    )
    axes.set_axis_off()
