"""Views of the tile left out in turn: how far each moves the LEDs' powers.

The model is linear in logarithms, so each fit without a view is solved anew, with lobe and drift at the amplitudes
found. The squares of the moves give a covariance that assumes only that the views are independent; it uses neither
the stated noise nor the model's form (the jackknife by clusters, CR3: Bell and McCaffrey, Survey Methodology
28(2), 2002). Exposures of one view are one cluster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from coupole.calibration.light.power_between import Between, between_views
from coupole.calibration.rotations import Floats


@dataclass(frozen=True)
class ViewsLeftOut:
    """Moves of the powers against their mean."""

    u: Floats
    """[leds] relative standard uncertainty by the jackknife; NaN for an LED in one view only."""
    worst: str
    """View whose removal moves the powers most; empty if no LED is in two views."""

    def ratio(self, u: Floats) -> float:
        """Return the root mean square of these uncertainties, divided by the root mean square of the stated ones
        [leds]; 0 if no LED is in two views."""
        both_known = np.isfinite(self.u) & np.isfinite(u)
        if not both_known.any():
            return 0.0
        return float(np.sqrt(np.mean(self.u[both_known] ** 2) / np.mean(u[both_known] ** 2)))


def views_left_out(y: Floats, observations: Between, names: Sequence[str]) -> ViewsLeftOut:
    """Leave out the views, one after the other. `y` [n] are the logarithms. The design of the observations has the
    derivatives by the shared figures and by the modes of causes; its prior has their standard uncertainties.
    `names` [n] are the views."""
    led, leds = observations.led, observations.leds
    whole = _log_powers(y, observations)
    squares, views_of_led, largest = np.zeros(leds), np.zeros(leds, np.int64), (0.0, "")
    for name in dict.fromkeys(names):
        inside = np.array([view == name for view in names])
        views_of_led += np.bincount(led[inside], minlength=leds) > 0
        moves = whole - _log_powers(y, replace(observations, weights=np.where(inside, 0.0, observations.weights)))
        known_leds = np.isfinite(moves)
        if not known_leds.any():
            continue
        moves = np.where(known_leds, moves - moves[known_leds].mean(), 0.0)
        squares += moves**2
        largest = max(largest, (float(np.sum(moves**2)), name))
    several = views_of_led > 1
    count = np.where(several, views_of_led, 1)
    return ViewsLeftOut(np.where(several, np.sqrt(squares * (count - 1) / count), np.nan), largest[1])


def _log_powers(y: Floats, observations: Between) -> Floats:
    """Return [leds] logarithms of the powers; NaN for an LED without observations."""
    weights = observations.weights
    between, mean_y = between_views(
        y, weights, observations.led, observations.design, observations.leds, observations.prior
    )
    normal = np.diag(observations.prior**-2.0) + between.design.T @ (between.design * weights[:, None])
    figures = np.linalg.solve(normal, between.design.T @ (weights * between.residuals))
    powers = mean_y - between.means(observations.design) @ figures
    return np.where(between.weight > 0.0, powers, np.nan)
