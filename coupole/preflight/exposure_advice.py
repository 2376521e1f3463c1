"""Exposure advice for a plan, from pictures under a few lights at a few exposures. Each picture is taken twice.

Two criteria bound the exposure. Upper bound: in each picture at most a given share of the pixels is saturated.
Lower bound: a given share of the object's pixels reaches a signal-to-noise ratio under their most favourable
light. Noise is measured, not assumed: differences of pairs give the photon transfer line, variance = read^2 + gain
* signal (Janesick, "Photon Transfer", 2007, eq. 3.5, in DN). If one exposure meets both criteria, the shortest
such exposure is proposed, because it gives the least dose. Otherwise a bracket is proposed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.devices import FrameFormat
from coupole.errors import InputError
from coupole.plan.exposures import BracketExposure, FixedExposure
from coupole.plan.led_table import LedTable
from coupole.plan.light_selection import spread_rows
from coupole.plan.plan import Plan
from coupole.plan.plan_lights import LightIds
from coupole.plan.shot_id import Light
from coupole.plan.yamlfile import Document

METERING_LIGHTS = 12
SHORTER = (16, 4, 1)
"""The metering exposures are the plan's shortest exposure divided by these numbers."""
_REPEATS = 2
_CELL_STEP = 4
"""Every n-th Bayer cell in both directions is sampled."""
_BRACKET_STEP = 4.0
_FULL = 0.95
"""Share of the range above black that counts as full. It is below 1, so that noise does not reach saturation."""
_UNSEEN_LIGHTS = 0.8
"""Factor by which lights that were not metered may be brighter."""
_NOISE_MARGIN = 1.25
_SEEN_SIGMA = 5.0
"""A pixel shows the object if, in the longest exposure, its signal under its best light exceeds the read noise by
this factor."""
_LEVELS = 48
_ROUNDING_DN = math.sqrt(1.0 / 12.0)
_SHORTEST_US = 10
"""The shortest exposure that a plan may have."""


@dataclass(frozen=True)
class Request:
    """Criteria for the pictures."""

    saturated_share: float = 1e-3
    """Largest share of saturated pixels in any picture."""
    snr: float = 30.0
    """Signal-to-noise ratio of a single pixel in a single picture."""
    object_share: float = 0.9
    """Share of the object's pixels that must reach this ratio."""


@dataclass(frozen=True)
class Noise:
    """Variance of a pixel at a signal of s DN above black: read_dn^2 + gain_dn * s."""

    read_dn: float
    gain_dn: float
    """DN per electron."""

    def signal_for(self, snr: float) -> float:
        """Return the signal s, DN above black, at which s / sqrt(variance) is `snr`."""
        shot = snr**2 * self.gain_dn
        return (shot + math.sqrt(shot**2 + 4.0 * (snr * self.read_dn) ** 2)) / 2.0


@dataclass(frozen=True)
class ViewAdvice:
    """Bounds of one view's exposure."""

    view: str
    longest_us: float
    """Longest exposure. Above it, more than the allowed share of some picture is saturated."""
    shortest_us: float
    """Shortest exposure. Below it, too few of the object's pixels reach the required signal-to-noise ratio."""
    object_share: float
    """Share of the pixels that show the object."""
    saturated_at_shortest: bool
    """True if even the shortest metering exposure saturated more than allowed. `longest_us` may then be too
    long."""


@dataclass(frozen=True)
class Advice:
    """Advice for the whole plan."""

    noise: Noise
    views: tuple[ViewAdvice, ...]
    exposure: FixedExposure | BracketExposure
    remarks: tuple[str, ...]

    def figures(self) -> dict[str, Any]:
        """Return the figures, with values of JSON only."""
        return {
            "exposure": self.exposure.model_dump(mode="json"),
            "remarks": self.remarks,
            "noise": asdict(self.noise),
            "views": {advice.view: asdict(advice) for advice in self.views},
        }


def metering_plan(plan: Plan, leds: LedTable, rows: NDArray[np.int64]) -> Plan:
    """Return the plan with a few of its lights (`rows` of the table) spread over the dome. Each light is taken
    twice at a few exposures.

    Plans without LEDs (panels, darks) keep their lights.
    """
    base_us = plan.exposure.exposures_us[0]
    exposures_us = sorted({max(10, base_us // shorter) for shorter in SHORTER})
    exposure: FixedExposure | BracketExposure = FixedExposure(kind="fixed", exposure_us=base_us)
    if len(exposures_us) > 1:
        exposure = BracketExposure(kind="bracket", exposures_us=tuple(exposures_us))
    changes: dict[str, Any] = {"exposure": exposure, "repeats": _REPEATS, "darks_per_view": 0}
    if len(rows):
        metering_rows = rows[spread_rows(leds.positions_mm[rows], METERING_LIGHTS)]
        changes["lights"] = LightIds(kind="ids", ids=tuple(int(led) for led in leds.ids[metering_rows]))
        changes["views"] = tuple(view.model_copy(update={"lights": None}) for view in plan.view_entries)
    return plan.model_copy(update=changes)


@dataclass
class Metered:
    """Samples of one view: signals in DN above black by light and exposure, one array [pixels] for each repeat."""

    frame_format: FrameFormat
    samples: dict[Light, dict[int, list[NDArray[np.int32]]]] = field(default_factory=dict)


def sample_of(pixels: NDArray[np.uint16], cell_step: int = _CELL_STEP) -> NDArray[np.int32]:
    """[n] pixels of every `cell_step`-th Bayer cell, in both directions, of a frame [H, W], DN."""
    step_px = 2 * cell_step
    height, width = (size // step_px * step_px for size in pixels.shape)
    cells = pixels[:height, :width].reshape(height // step_px, step_px, -1, step_px)
    return cells[:, :2, :, :2].astype(np.int32).ravel()


def noise_of(views: Iterable[Metered]) -> Noise:
    """Compute the noise from all pairs of frames of the same light and exposure."""
    return noise_of_pairs(
        (a, b, view.frame_format.white_dn - view.frame_format.black_dn)
        for view in views
        for by_exposure in view.samples.values()
        for samples in by_exposure.values()
        for a, b in zip(samples[::2], samples[1::2], strict=False)
    )


def noise_of_pairs(pairs: Iterable[tuple[NDArray[np.int32], NDArray[np.int32], int]]) -> Noise:
    """Fit the photon transfer line to pairs of frames: signals [n] of both above black, and the top of their
    range, DN. The line is half of the mean squared difference as a function of the mean signal, in levels with
    equally many pixels. Levels are weighted by the uncertainty of their variance. If everything is saturated, the
    result is rounding noise only."""
    signal, half_squares = [np.zeros(0)], [np.zeros(0)]
    for a, b, white in pairs:
        below_white = np.maximum(a, b) < white
        signal.append((a[below_white] + b[below_white]) / 2.0)
        half_squares.append((a[below_white] - b[below_white]) ** 2 / 2.0)
    if sum(map(len, signal)) < _LEVELS:
        return Noise(_ROUNDING_DN, _ROUNDING_DN)
    order = np.argsort(all_signal := np.concatenate(signal), kind="stable")
    levels = np.array_split(all_signal[order], _LEVELS)
    spreads = np.array_split(np.concatenate(half_squares)[order], _LEVELS)
    mean = np.array([level.mean() for level in levels])
    variance = np.array([squares.mean() for squares in spreads])
    weight = np.sqrt([len(level) for level in levels]) / np.maximum(variance, 1e-3)
    design = np.stack([np.ones_like(mean), mean], axis=1)
    (offset, gain), *_ = np.linalg.lstsq(design * weight[:, None], variance * weight, rcond=None)
    return Noise(max(math.sqrt(max(offset, 0.0)), _ROUNDING_DN), max(float(gain), 1e-6))


def advise_view(view: str, metering: Metered, request: Request, noise: Noise) -> ViewAdvice:
    """Return the bounds of a view's exposure."""
    white = metering.frame_format.white_dn - metering.frame_format.black_dn
    rates = []
    for by_exposure in metering.samples.values():
        rate = np.full(next(iter(by_exposure.values()))[0].shape, np.inf)
        for exposure_us, samples in sorted(by_exposure.items()):  # the longest that is not saturated counts
            mean = np.mean(samples, axis=0)
            rate = np.where(np.max(samples, axis=0) < white, mean / exposure_us, rate)
        rates.append(rate)
    shortest_metered_us = min(e for by_exposure in metering.samples.values() for e in by_exposure)
    longest_metered_us = max(e for by_exposure in metering.samples.values() for e in by_exposure)
    per_light = np.minimum(np.array(rates), white / shortest_metered_us)
    brightest = np.quantile(per_light, 1.0 - request.saturated_share, axis=1).max()
    best = per_light.max(axis=0)
    # The best of many lights is biased by noise: the highest of n values of pure noise is near sqrt(2 ln n) sigma.
    looks = math.sqrt(2.0 * math.log(max(2, len(rates)))) + _SEEN_SIGMA
    of_object = best * longest_metered_us > looks * noise.read_dn
    longest_us = _FULL * _UNSEEN_LIGHTS * white / max(brightest, 1e-12)
    saturated_at_shortest = bool((np.isinf(rates).mean(axis=1) > request.saturated_share).any())
    if not of_object.any():
        return ViewAdvice(view, longest_us, math.inf, 0.0, saturated_at_shortest)
    darkest = max(float(np.quantile(best[of_object], 1.0 - request.object_share)), 1e-12)
    shortest_us = _NOISE_MARGIN * noise.signal_for(request.snr) / darkest
    return ViewAdvice(view, longest_us, shortest_us, float(of_object.mean()), saturated_at_shortest)


def advise(views: Mapping[str, Metered], request: Request, *, longest_us: int) -> Advice:
    """Return the exposure or bracket for all views. LEDs can be on for an exposure of at most `longest_us`."""
    noise = noise_of(views.values())
    advices = tuple(advise_view(view, metered_view, request, noise) for view, metered_view in views.items())
    remarks = [
        f"view {a.view}: the pictures show only noise; is the object lit?" for a in advices if not a.object_share
    ]
    remarks += [
        f"view {a.view}: saturated at all metered exposures; meter again with this exposure"
        for a in advices
        if a.saturated_at_shortest
    ]
    low_us, high_us = _SHORTEST_US, longest_us
    brightest_us = min(a.longest_us for a in advices)
    shortest_times_us = [a.shortest_us for a in advices if a.object_share]
    shortest_us = max(shortest_times_us, default=brightest_us)
    if brightest_us < low_us:
        remarks.append(
            f"even with {low_us} us, more pixels are saturated than allowed: close the aperture or dim the lights"
        )
    if shortest_us > high_us:
        remarks.append(
            f"even {high_us} us is too short for the required signal-to-noise ratio: open the aperture or raise "
            "the gain"
        )
    first = _rounded_us(min(max(min(shortest_us, brightest_us), low_us), high_us), up=shortest_us <= brightest_us)
    if shortest_us <= brightest_us:
        return Advice(noise, advices, FixedExposure(kind="fixed", exposure_us=first), tuple(remarks))
    exposures_us = [first]
    while exposures_us[-1] < min(shortest_us, high_us) and len(exposures_us) < 16:
        exposures_us.append(_rounded_us(min(exposures_us[-1] * _BRACKET_STEP, shortest_us, high_us), up=True))
        if exposures_us[-1] <= exposures_us[-2]:
            exposures_us.pop()
            break
    if len(exposures_us) == 1:
        return Advice(noise, advices, FixedExposure(kind="fixed", exposure_us=first), tuple(remarks))
    bracket = BracketExposure(kind="bracket", exposures_us=tuple(min(e, high_us) for e in exposures_us))
    return Advice(noise, advices, bracket, tuple(remarks))


def write_plan(plan: Document, out: Path, exposure: FixedExposure | BracketExposure) -> None:
    """Copy a plan as it was read, including comments, with another exposure. `out` must be in the plan's folder,
    because the paths in a plan are relative to it. Raises InputError if `out` is elsewhere, or exists already."""
    from ruamel.yaml import YAML
    from ruamel.yaml.comments import CommentedMap

    folder = plan.path.resolve().parent
    if out.resolve().parent != folder:
        raise InputError(f"{out}: expected a file in the plan's folder, {folder}")
    yaml = YAML()
    yaml.preserve_quotes, yaml.width = True, 4096
    document = yaml.load(plan.text)
    exposure_map = CommentedMap(exposure.model_dump(mode="json"))
    exposure_map.fa.set_flow_style()
    document["exposure"] = exposure_map
    try:
        with out.open("x", encoding="utf-8") as file:
            yaml.dump(document, file)
    except FileExistsError as error:
        raise InputError(f"{out}: exists already; choose another name") from error


def _rounded_us(exposure_us: float, *, up: bool) -> int:
    """Round to two digits: 8137 becomes 8200 or 8100."""
    step = 10.0 ** max(0, math.floor(math.log10(max(exposure_us, 1.0))) - 1)
    return max(10, int((math.ceil if up else math.floor)(round(exposure_us / step, 6)) * step))
