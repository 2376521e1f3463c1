"""The accuracies of Lucat et al. 2025 beside the accuracies from calibration records, for one cell or several.

Our figures are computed from records: standard uncertainties, all directions together. The paper does not state
the coverage of its figures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from coupole.calibration.budget.budget import Spread
from coupole.calibration.budget.records import camera_reach_mm
from coupole.calibration.in_force import InForce
from coupole.calibration.record import step_names
from coupole.calibration.rotations import Floats

PAPER_SPREAD = {"best": (-0.0106, 0.0123), "half": (-0.1066, 0.1400), "most": (-0.1523, 0.2242)}
"""Lucat et al. 2025, section 6.1: relative intervals at 68 %."""
SPREAD_WORDS = {"best": "best", "half": "half of all", "most": "95 % of all"}


@dataclass(frozen=True)
class Case:
    """One cell: its records, and the intervals of samples that follow from them."""

    name: str
    records: tuple[InForce, ...]
    sample_spread: Spread | None = None

    @property
    def robot(self) -> str:
        """The largest noise of the robot in its records, as text."""
        noises = [{line.name: line.found for line in item.record.noise} for item in self.records]
        noises = [noise for noise in noises if {"robot position", "robot orientation"} <= set(noise)]
        if not noises:
            return "no record"
        worst = max(noises, key=lambda noise: noise["robot position"])
        return f"{1e3 * worst['robot position']:.0f} um, {worst['robot orientation']:.2g} deg"


@dataclass(frozen=True)
class Accuracy:
    """One line of the table."""

    quantity: str
    unit: str
    """Empty for relative intervals."""
    paper: str
    """The paper's figure, as the paper writes it."""
    our_figures: tuple[tuple[float, ...] | None, ...]
    """Our figure for each case: one number, or the two ends of an interval; None without a record."""

    def cell(self, case: int) -> str:
        """Return our figure as text."""
        figure = self.our_figures[case]
        if figure is None:
            return "no record"
        if len(figure) == 2:
            return f"[{figure[0]:+.2%}, {figure[1]:+.2%}]"
        return f"{figure[0]:.2g} {self.unit}"


def accuracies(cases: Sequence[Case]) -> tuple[Accuracy, ...]:
    """Return the table. `read_records` has checked that the records' files exist."""
    lines = [
        Accuracy(label, unit, paper, tuple(_by_record(case, kind, figure) for case in cases))
        for label, unit, paper, kind, figure in _LINES
    ]
    for key, (low, high) in PAPER_SPREAD.items():
        our_figures = tuple(
            None if case.sample_spread is None else getattr(case.sample_spread, key) for case in cases
        )
        paper = f"[{low:+.2%}, {high:+.2%}]"
        lines.append(Accuracy(f"samples, {SPREAD_WORDS[key]}", "", paper, our_figures))
    return tuple(lines)


def _by_record(case: Case, kind: str, figure: Callable[[InForce], float]) -> tuple[float] | None:
    return next(((figure(item),) for item in case.records if item.record.kind == kind), None)


def _camera_on_flange(item: InForce) -> float:
    u = {parameter.name: parameter.u for parameter in item.record.parameters}
    return float(np.linalg.norm([u[name] for name in step_names("flange_from_camera")[:3]]))


def _camera_in_base(item: InForce) -> float:
    """Return the standard uncertainty of the camera's position in the base frame, at any pose: hand-eye and the
    robot's noise. A common rotation of the base does not count, as LEDs and mesh are calibrated in the same
    base."""
    noise = {line.name: line.found for line in item.record.noise}
    turned_mm = np.radians(noise["robot orientation"]) * camera_reach_mm(item.record)
    pose_mm2 = 3.0 * noise["robot position"] ** 2 + 2.0 * turned_mm**2
    return float(np.sqrt(_camera_on_flange(item) ** 2 + pose_mm2))


def _led_centres_mm(item: InForce) -> Floats:
    """Return [found LEDs] the standard uncertainty of their centres."""
    covariance, found_leds = _leds(item, "centre_covariance")
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2))[found_leds])


def _led_normals_deg(item: InForce) -> Floats:
    covariance, found_leds = _leds(item, "normal_covariance")
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2))[found_leds])


def _leds(item: InForce, name: str) -> tuple[Floats, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    import h5py

    file = next(file for file in item.record.files if file.name.endswith(".h5"))
    with h5py.File(item.path.parent / file.name, "r") as table:
        return np.asarray(table[name], np.float64), np.asarray(table["found"], np.bool_)


def _worst_sticker(item: InForce) -> float:
    return next(limit.found for limit in item.record.limits if limit.what == "place of the worst sticker")


_LINES: tuple[tuple[str, str, str, str, Callable[[InForce], float]], ...] = (
    ("camera on the flange", "mm", "", "hand-eye", _camera_on_flange),
    ("camera in the base", "mm", "0.3 mm", "hand-eye", _camera_in_base),
    ("LED centre, median", "mm", "0.7 mm", "leds", lambda item: float(np.median(_led_centres_mm(item)))),
    ("LED centre, worst", "mm", "", "leds", lambda item: float(_led_centres_mm(item).max())),
    ("LED normal, median", "deg", "", "leds", lambda item: float(np.median(_led_normals_deg(item)))),
    ("LED normal, worst", "deg", "0.21 deg, at worst", "leds", lambda item: float(_led_normals_deg(item).max())),
    ("mesh, worst sticker", "mm", "0.1 mm, at most", "mesh", _worst_sticker),
)
