"""The picture of a check, and the table of its values."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from coupole.calibration.record import Comparison, Record
from coupole.calibration.report import BLUE, DARK, GREY, RED
from coupole.pages.page_parts import Section, Table, Verdict

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_comparisons(record: Record, figure: Figure) -> None:
    """Draw the errors with their uncertainties by position, E_n of each value, and their distribution."""
    grid = figure.add_gridspec(2, 2, width_ratios=(3, 1))
    values = record.comparisons
    is_length = values[0].unit == "mm"
    _draw_errors(figure.add_subplot(grid[0, :]), values, is_length)
    _draw_en(figure.add_subplot(grid[1, 0]), values)
    ax = figure.add_subplot(grid[1, 1])
    ax.hist(
        [value.en for value in values], bins=np.linspace(0.0, max(2.0, _worst(values)), 21).tolist(), color=BLUE
    )
    ax.axvline(1.0, color=RED, lw=1.5)
    ax.set(title="Values by their E_n", xlabel="E_n", ylabel="values")


def _worst(values: tuple[Comparison, ...]) -> float:
    return max(value.en for value in values)


def _draw_errors(ax: Axes, values: tuple[Comparison, ...], is_length: bool) -> None:
    """Draw measured minus certified values, by length or channel, in a colour for each position."""
    positions = list(dict.fromkeys(value.position for value in values))
    factor = 1e3 if is_length else 1.0
    for number, position in enumerate(positions):
        position_values = [value for value in values if value.position == position]
        shift = 0.6 * (number / max(1, len(positions) - 1) - 0.5)
        x = [v.certified_value + 2.0 * shift if is_length else _channel(v.name) + shift for v in position_values]
        expanded_u = [factor * np.hypot(v.expanded_u_certified, v.expanded_u_measured) for v in position_values]
        errors = [factor * v.error for v in position_values]
        ax.errorbar(x, errors, expanded_u, fmt="o", ms=4, lw=1, capsize=2, label=position)
    limits = sorted((v.certified_value, factor * v.permissible) for v in values if v.permissible is not None)
    for sign in (-1.0, 1.0) if limits else ():
        ax.plot([at for at, _ in limits], [sign * limit for _, limit in limits], color=RED, lw=1.2)
    ax.axhline(0.0, color=DARK, lw=0.8)
    if is_length:
        title = "Errors of lengths, bars: both expanded uncertainties together" + (", red: MPE" if limits else "")
        ax.set(title=title, xlabel="length (mm)", ylabel="measured minus certified (um)")
    else:
        ax.set(title="Errors of reflectance, bars: both expanded uncertainties together", ylabel="error")
        names = list(dict.fromkeys(value.name for value in values))
        ax.set_xticks([_channel(name) for name in names], names)
    ax.legend(frameon=False, title="position")


def _channel(name: str) -> float:
    return float("RGB".find(name))


def _draw_en(ax: Axes, values: tuple[Comparison, ...]) -> None:
    at = np.arange(len(values))
    en = np.array([value.en for value in values])
    ax.bar(at, en, color=[BLUE if value <= 1.0 else RED for value in en])
    ax.axhline(1.0, color=RED, lw=1.2)
    starts = [n for n in at if n == 0 or values[n].position != values[n - 1].position]
    for start in starts[1:]:
        ax.axvline(start - 0.5, color=GREY, lw=0.8)
    ax.set_xticks(starts, [values[n].position for n in starts], ha="left", rotation=0)
    ax.set(title="E_n = |measured - certified| / both U together (k = 2); above 1 in red", ylabel="E_n")


def comparison_section(record: Record) -> Section:
    """Return a table of all values."""
    unit = record.comparisons[0].unit
    shown_unit = "" if unit == "1" else f" {unit}"
    rows = [
        (
            value.position,
            value.name,
            f"{value.certified_value:.5f}",
            f"{value.expanded_u_certified:.5f}",
            f"{value.measured_value:.5f}",
            f"{value.expanded_u_measured:.5f}",
            f"{value.error:+.5f}",
            "" if value.permissible is None else f"{value.permissible:.5f}",
            f"{value.en:.2f}",
            Verdict("satisfactory", "ok") if value.en <= 1.0 else Verdict("unsatisfactory", "bad"),
        )
        for value in record.comparisons
    ]
    head = (
        "position", "value", f"certified{shown_unit}", "U", f"measured{shown_unit}", "U", "error", "MPE", "E_n",
        "ISO 13528",
    )  # fmt: skip
    title = "Values of the independent artefact, U with k = 2"
    return Section("comparison", "Measured and certified", tables=[Table(title, head, rows)])
