"""The uncertainty budget from records, as a table, a picture and JSON."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coupole.calibration.budget import Budget, Known, Spread
from coupole.calibration.record import Record, read_record
from coupole.calibration.report import BLUE, DARK, GREY, RED
from coupole.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER = {"best": (-0.0106, 0.0123), "half": (-0.1066, 0.1400), "most": (-0.1523, 0.2242)}
"""Seed 003, section 6.1: relative intervals at 68 %."""


def known_from(paths: Sequence[Path], start: Known) -> Known:
    """What records say, in place of assumptions. Raises InputError for two records of one kind, or one that is not
    of use here."""
    changes: dict[str, Any] = {}
    sources: list[tuple[str, str]] = []
    for path in paths:
        record = read_record(path)
        if record.kind not in _READERS:
            raise InputError(
                f"{path}: a record of the kind `{record.kind}` says nothing to this budget; expected "
                f"{', '.join(_READERS)}"
            )
        found, groups = _READERS[record.kind](record, path)
        if any(key in changes for key in found):
            raise InputError(f"{path}: a second record of the kind `{record.kind}`; give one of each")
        changes |= found
        sources += [(group, f"{record.kind} {record.name}") for group in groups]
    return replace(start, **changes, sources=tuple(sources))


def _of_response(record: Record, path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    gain = record.value("gain_dn_per_e.G")
    read = max(record.value("dark_variance_dn2.G") - 1.0 / 12.0, 0.0) ** 0.5
    limit = next(limit.found for limit in record.limits if limit.what == "uncertainty of linearity")
    found = {
        "gain_dn_per_e": gain,
        "read_noise_dn": read,
        "full_scale_dn": record.value("range_dn"),
        "response": limit,
    }
    return found, ("pixel value", "response")


def _of_flat_field(record: Record, path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    limit = next(limit.found for limit in record.limits if limit.what.startswith("uncertainty"))
    return {"flat_field": limit}, ("flat field",)


def _of_led_power(record: Record, path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    lines = [
        line for line in (path.parent / record.files[0].name).read_text().splitlines() if not line.startswith("#")
    ]
    names = lines[0].split(",")
    table = np.genfromtxt(lines[1:], delimiter=",", ndmin=2)
    good = table[:, names.index("power_G")] > 0
    own = table[good, names.index("u_own_G")]
    all_of_it = table[good, names.index("u_G")]
    common = np.sqrt(np.maximum(all_of_it**2 - own**2, 0.0))
    found = {"power_own": float(np.median(own)), "power_common": float(np.median(common))}
    return found, ("LED power, own", "LED power, common")


_READERS = {"response": _of_response, "flat-field": _of_flat_field, "led-power": _of_led_power}


def as_json(budget: Budget, spread: Spread | None) -> dict[str, Any]:
    """The figures, for programs."""
    document: dict[str, Any] = {
        "incidence_deg": budget.geometry.incidence_deg,
        "nominal_per_sr": budget.nominal,
        "u_relative": budget.numeric.u / budget.nominal,
        "u_relative_linear": budget.linear.result.u / budget.nominal,
        "trials": budget.numeric.trials,
        "stable": budget.numeric.stable,
        "intervals": [
            {
                "coverage": i.coverage,
                "kind": i.kind,
                "low": i.low / budget.nominal - 1.0,
                "high": i.high / budget.nominal - 1.0,
            }
            for i in budget.numeric.intervals
        ],
        "linear_formula_will_do": [
            {
                "coverage": v.coverage,
                "d_low": v.d_low,
                "d_high": v.d_high,
                "tolerance": v.tolerance,
                "passed": v.passed,
            }
            for v in budget.validations
        ],
        "sources": [
            {
                "source": share.source,
                "said_by": share.said_by,
                "share_of_linear_variance": share.linear,
                "width_falls_without": share.removed,
                "alone": share.alone,
            }
            for share in budget.shares
        ],
        "inputs": [
            {"name": q.name, "value": q.value, "u": q.u, "distribution": q.shape, "source": q.source}
            for q in budget.inputs.quantities
        ],
    }
    if spread is not None:
        document["samples"] = {"best": spread.best, "half": spread.half, "most": spread.most, "paper": PAPER}
    return document


def draw_budget(budget: Budget, spread: Spread | None) -> bytes:
    """PNG, 1600 x 1200: the distribution, what dominates, and how uncertainty grows with incidence."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 12), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2)
    _draw_distribution(figure, grid[0, 0], budget)
    _draw_sources(figure, grid[0, 1], budget)
    if spread is not None:
        _draw_spread(figure, grid[1, :], spread)
    low, high = budget.relative(0.68)
    figure.suptitle(
        f"Uncertainty of a reflectance, light at {budget.geometry.incidence_deg:g} deg: "
        f"[{low:+.2%}, {high:+.2%}] at 68 %",
        fontsize=16,
        color=DARK,
    )
    for ax in figure.axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(colors=DARK)
        ax.title.set_fontsize(13)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _draw_distribution(figure: Figure, place: Any, budget: Budget) -> None:
    ax = figure.add_subplot(place)
    relative = 100.0 * (budget.numeric.samples / budget.nominal - 1.0)
    low, high = np.quantile(relative, [0.001, 0.995])
    ax.hist(relative, bins=160, range=(low, high), density=True, color=GREY)
    grid = np.linspace(low, high, 400)
    sigma = 100.0 * budget.linear.result.u / budget.nominal
    ax.plot(grid, np.exp(-0.5 * (grid / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi)), color=DARK, lw=1.5)
    for coverage, height in ((0.68, 0.92), (0.95, 0.98)):
        a, b = (100.0 * end for end in budget.relative(coverage))
        y = ax.get_ylim()[1] * height
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
    ax.set_yticks(at, [f"{share.source}\n{share.said_by}" for share in shares], fontsize=9)
    ax.set(xscale="log", xlim=(0.003, 150), xlabel="%", title="What dominates")
    ax.legend(frameon=False, loc="lower right")


def _draw_spread(figure: Figure, place: Any, spread: Spread) -> None:
    ax = figure.add_subplot(place)
    ends = 100 * spread.ends[np.argsort(spread.ends[:, 1] - spread.ends[:, 0])]
    share = 100 * (np.arange(len(ends)) + 0.5) / len(ends)
    ax.fill_between(share, ends[:, 0], ends[:, 1], color=BLUE, alpha=0.25, lw=0)
    ax.plot(share, ends, color=BLUE, lw=1)
    for x, key in ((1, "best"), (50, "half"), (95, "most")):
        ax.errorbar(
            x, 0, [[-100 * PAPER[key][0]], [100 * PAPER[key][1]]], color=RED, capsize=6, lw=1.5,
            label="seed 003, section 6.1" if key == "best" else None,
        )  # fmt: skip
    ax.axhline(0, color=DARK, lw=0.8)
    ax.legend(frameon=False, loc="upper left")
    ax.set(
        title="68 % intervals of samples over a dome, the best first", xlabel="share of samples (%)", ylabel="%",
        xlim=(0, 100),
    )  # fmt: skip
