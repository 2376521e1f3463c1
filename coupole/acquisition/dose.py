"""The light dose of a run, computed from the box's log."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.devices import NO_LED
from coupole.geometry import apply
from coupole.plan.bursts import Burst
from coupole.preflight.job import Job


class DoseMeter:
    """Sums lux hours at the job's points on the object; the highest is the run's dose."""

    def __init__(self, job: Job) -> None:
        rig = job.cell.rig
        points_base = apply(rig.support.base_from_support.matrix(), job.shape.dose_points_mm)
        self._lux = job.cell.leds.illuminance_lux(points_base, emission=rig.dome.emission)
        self._row_of_led = {int(led): row for row, led in enumerate(job.cell.leds.ids)}
        self._panel_lux = rig.dome.panel_lux
        self._given_lux_h = np.zeros(len(points_base))

    @property
    def lux_h(self) -> float:
        """At the point with the highest dose."""
        return float(self._given_lux_h.max())

    def add(self, burst: Burst, log: NDArray[np.void]) -> float:
        """Add the dose of a burst from its `log` (STEP_RECORD_DTYPE [n]); returns seconds of LED light."""
        lit = log[log["led"] != NO_LED]
        rows = [self._row_of_led[int(led)] for led in lit["led"]]
        self._given_lux_h += self._lux[:, rows] @ lit["on_us"] / 3.6e9
        if burst.panel:
            self._given_lux_h += self._panel_lux * burst.duration_s / 3600.0
        return round(float(lit["on_us"].sum()) * 1e-6, 6)
