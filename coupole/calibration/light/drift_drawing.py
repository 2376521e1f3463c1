"""The picture of a drift: readings over time and temperature, the factor of the run's frames, residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from coupole.calibration.light.drift import Drift
from coupole.calibration.report import BLUE, GREY, RED
from coupole.calibration.rotations import Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from coupole.calibration.record import Record

_MOST = 4000


def draw_drift(drift: Drift, warmer_k: Floats, t_s: Floats, record: Record, figure: Figure) -> None:
    """Fill the figure. `warmer_k` and `t_s` [n] belong to the run's frames."""
    axes = figure.subplots(2, 2)
    minutes = np.array([reading.t_s - drift.start_s for reading in drift.used_readings]) / 60.0
    warm = np.array([reading.warmer_k for reading in drift.used_readings])
    by_fit = drift.factor(warm, 60.0 * minutes + drift.start_s)
    read_factors = by_fit * np.exp(drift.residuals)
    axes[0, 0].plot(minutes, 100 * read_factors, ".", color=GREY, ms=4, label="readings of the tile")
    axes[0, 0].plot(minutes, 100 * by_fit, ".", color=BLUE, ms=3, label="by the fit")
    odd = [((reading.t_s - drift.start_s) / 60.0, 100 * reading.ratio) for reading in drift.odd]
    if odd:
        axes[0, 0].plot(*np.transpose(odd), "x", color=RED, label="left out")
    axes[0, 0].legend(frameon=False)
    axes[0, 0].set(title="Power divided by the power of the calibration", xlabel="minutes", ylabel="%")
    axes[0, 1].plot(warm, 100 * read_factors, ".", color=GREY, ms=4)
    axes[0, 1].set(title="The same by temperature", xlabel="warmer than when calibrated (K)", ylabel="%")
    axes[1, 0].hist(100 * drift.residuals, bins=40, color=BLUE)
    axes[1, 0].set(title=f"Residuals; noise of a reading {drift.noise:.2%}", xlabel="%", ylabel="readings")
    step = max(1, len(t_s) // _MOST)
    when, warm = t_s[::step], warmer_k[::step]
    factor, u = drift.factor(warm, when), drift.u_factor(warm, when)
    axes[1, 1].errorbar(
        (when - drift.start_s) / 60.0, 100 * factor, 200 * factor * u, fmt=".", color=BLUE, ecolor=GREY, ms=3
    )
    axes[1, 1].set(title="Factor of all frames, with 95 % intervals", xlabel="minutes", ylabel="%")
