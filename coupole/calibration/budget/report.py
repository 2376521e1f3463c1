"""The uncertainty budget as a picture and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from coupole.calibration.budget.accuracy import PAPER_SPREAD, Accuracy, Case
from coupole.calibration.budget.budget import Budget, Spread
from coupole.calibration.budget.propagation import Interval, Validation
from coupole.calibration.report import BLUE, DARK, GREY, RED, png_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def as_json(
    budget: Budget, sample_spread: Spread, cases: Sequence[Case] = (), table: Sequence[Accuracy] = ()
) -> dict[str, Any]:
    """Return the figures for programs."""
    return {
        "incidence_deg": budget.geometry.incidence_deg,
        "nominal_per_sr": budget.nominal,
        "u_relative": budget.numeric.u / budget.nominal,
        "u_relative_linear": budget.linear.result.u / budget.nominal,
        "trials": budget.numeric.trials,
        "stable": budget.numeric.stable,
        "intervals": [_interval(interval, budget.nominal) for interval in budget.numeric.intervals],
        "linear_formula_will_do": [_validation(validation) for validation in budget.validations],
        "sources": [
            {
                "source": share.source,
                "figure": share.figure,
                "said_by": share.said_by,
                "share_of_linear_variance": share.linear,
                "width_falls_without": share.width_decrease,
                "alone": share.alone,
            }
            for share in budget.shares
        ],
        "inputs": [
            {"name": q.name, "value": q.value, "u": q.u, "distribution": q.shape, "source": q.source}
            for q in budget.inputs.quantities
        ],
        "samples": {
            "best": sample_spread.best,
            "half": sample_spread.half,
            "most": sample_spread.most,
            "paper": PAPER_SPREAD,
        },
        "accuracies": [
            {"what": line.quantity, "unit": line.unit, "paper": line.paper, "ours": line.our_figures}
            for line in table
        ],
        "cases": [
            {
                "name": case.name,
                "robot": case.robot,
                "records": {item.record.kind: item.record.sha256 for item in case.records},
            }
            for case in cases
        ],
    }


def _interval(interval: Interval, nominal: float) -> dict[str, Any]:
    return {
        "coverage": interval.coverage,
        "kind": interval.kind,
        "low": interval.low / nominal - 1.0,
        "high": interval.high / nominal - 1.0,
    }


def _validation(validation: Validation) -> dict[str, Any]:
    return {
        "coverage": validation.coverage,
        "digits": validation.digits,
        "d_low": validation.d_low,
        "d_high": validation.d_high,
        "tolerance": validation.tolerance,
        "passed": validation.is_within_tolerance,
        "sure": validation.sure,
    }


def draw_budget(budget: Budget, sample_spread: Spread) -> bytes:
    """Draw a PNG, 1600 x 1200: the distribution, the dominant sources, and the uncertainty over the incidence."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 12), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2)
    _draw_distribution(figure, grid[0, 0], budget)
    _draw_sources(figure, grid[0, 1], budget)
    _draw_spread(figure, grid[1, :], sample_spread)
    coverage = budget.numeric.intervals[0].coverage
    low, high = budget.relative(coverage)
    figure.suptitle(
        f"Uncertainty of a reflectance, light at {budget.geometry.incidence_deg:g} deg: "
        f"[{low:+.2%}, {high:+.2%}] at {coverage:.0%}",
        fontsize=16,
        color=DARK,
    )
    return png_of(figure)


def _draw_distribution(figure: Figure, place: Any, budget: Budget) -> None:
    ax = figure.add_subplot(place)
    relative = 100.0 * (budget.numeric.samples / budget.nominal - 1.0)
    low, high = np.quantile(relative, [0.001, 0.995])
    ax.hist(relative, bins=160, range=(low, high), density=True, color=GREY)
    grid = np.linspace(low, high, 400)
    sigma = 100.0 * budget.linear.result.u / budget.nominal
    ax.plot(grid, np.exp(-0.5 * (grid / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi)), color=DARK, lw=1.5)
    coverages = [interval.coverage for interval in budget.linear.result.intervals]
    for number, coverage in enumerate(sorted(coverages, reverse=True)):
        a, b = (100.0 * end for end in budget.relative(coverage))
        y = ax.get_ylim()[1] * (0.98 - 0.06 * number)
        ax.plot([a, b], [y, y], color=BLUE, lw=3, solid_capstyle="butt")
        ax.annotate(f" [{a:+.1f}, {b:+.1f}] % at {coverage:.0%}", (b, y), va="center", color=BLUE)
    ax.set(
        title=f"Monte Carlo, {budget.numeric.trials} trials; line: the linear formula", xlabel="off the value (%)",
        yticks=[], xlim=(low, high),
    )  # fmt: skip
    ax.spines["left"].set_visible(False)


def _draw_sources(figure: Figure, place: Any, budget: Budget) -> None:
    ax = figure.add_subplot(place)
    shares = budget.shares[::-1]
    at = np.arange(len(shares))
    ax.barh(
        at + 0.2, [100 * share.alone for share in shares], 0.4, color=BLUE, label="alone: half its 68 % interval"
    )
    ax.barh(
        at - 0.2,
        [max(100 * share.linear, 1e-9) for share in shares],
        0.4,
        color=GREY,
        label="share of linear variance",
    )
    ax.set_yticks(at, [f"{share.source}: {share.figure}\n{share.said_by}" for share in shares], fontsize=8)
    ax.set(xscale="log", xlim=(0.003, 150), xlabel="%", title="What dominates")
    ax.legend(frameon=False, loc="lower right")


def _draw_spread(figure: Figure, place: Any, sample_spread: Spread) -> None:
    ax = figure.add_subplot(place)
    ends = 100 * sample_spread.ends[np.argsort(sample_spread.ends[:, 1] - sample_spread.ends[:, 0])]
    share = 100 * (np.arange(len(ends)) + 0.5) / len(ends)
    ax.fill_between(share, ends[:, 0], ends[:, 1], color=BLUE, alpha=0.25, lw=0)
    ax.plot(share, ends, color=BLUE, lw=1)
    for x, key in ((1, "best"), (50, "half"), (95, "most")):
        ax.errorbar(
            x, 0, [[-100 * PAPER_SPREAD[key][0]], [100 * PAPER_SPREAD[key][1]]], color=RED, capsize=6, lw=1.5,
            label="Lucat et al. 2025, section 6.1" if key == "best" else None,
        )  # fmt: skip
    ax.axhline(0, color=DARK, lw=0.8)
    ax.legend(frameon=False, loc="upper left")
    ax.set(
        title="68 % intervals of samples over a dome, the best first", xlabel="share of samples (%)", ylabel="%",
        xlim=(0, 100),
    )  # fmt: skip
