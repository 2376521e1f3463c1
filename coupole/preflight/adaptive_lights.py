"""Chooses LEDs in the run, from the frames under earlier LEDs of the view (`lights: {kind: adaptive}`).

The first burst is spread over the dome. For each further burst `next_lights` gives the expected error of pictures
for the LEDs not yet lit, and the LEDs that would add most information. The second burst follows from the frames of
the first. Each later burst is chosen while the one before it is fired, from the frames before that one, so that
the box does not wait. Only the decision to end a view uses all frames. Pixels are divided by the illuminance that
the LED table gives at the view's target. Mesh and records are not needed: only the frames are used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform, apply
from coupole.plan.choices import Choice, Chooser, ChosenBurst, FrameSample, OpenView
from coupole.plan.led_table import LedTable
from coupole.plan.plan_lights import AdaptiveLights, Lights
from coupole.plan.shot_id import Led, ShotLabel
from coupole.preflight.next_lights import FEWEST_TAKEN, NextLights, next_lights, spread_lights

Floats = NDArray[np.float64]

_SITES = 2048
"""Approximate number of pixels that are used to judge LEDs."""


class AdaptiveLightsChooser(Chooser):
    """The `Chooser` of plans with `lights: {kind: adaptive}` in some view; other views get all their LEDs."""

    def __init__(
        self,
        lights: Mapping[str, Lights],
        leds: LedTable,
        base_from_support: Transform,
        *,
        emission: str = "lambertian",
    ) -> None:
        """`lights` has the plan's lights by name of view."""
        self._lights, self._leds, self._emission = lights, leds, emission
        self._base_from_support = base_from_support

    def choose(
        self, view: OpenView, choices: Sequence[Choice], samples: Mapping[ShotLabel, FrameSample]
    ) -> Choice:
        """See `coupole.plan.choices.Chooser`."""
        lights = self._lights[view.name]
        if not isinstance(lights, AdaptiveLights):
            every_id = tuple(view.leds.tolist())
            return self._choice(view, () if choices else every_id, "all LEDs, as the plan says")
        if not choices:
            spread_ids = view.leds[spread_lights(self._ways(view), np.arange(len(view.leds)), lights.first_lights)]
            first_ids = self._affordable(view, lights, spread_ids[: lights.until.lights].tolist(), 0, 0)
            reason = f"{len(first_ids)} LEDs spread over the dome"
            return self._choice(
                view,
                first_ids,
                reason if first_ids else "`seconds` or `lux_h` of `until` do not allow a single LED",
            )
        return self._next(view, lights, choices, samples)

    def choose_ahead(
        self, view: OpenView, choices: Sequence[Choice], samples: Mapping[ShotLabel, FrameSample]
    ) -> Choice | None:
        """See `coupole.plan.choices.Chooser`. None for the second burst of a view, and if the view ends."""
        lights = self._lights[view.name]
        if not isinstance(lights, AdaptiveLights) or len(choices) < 2:
            return None
        choice = self._next(view, lights, choices, samples, coming=choices[-1])
        return choice if choice.bursts else None

    def _next(
        self,
        view: OpenView,
        lights: AdaptiveLights,
        choices: Sequence[Choice],
        samples: Mapping[ShotLabel, FrameSample],
        *,
        coming: Choice | None = None,
    ) -> Choice:
        """Return the next bursts; the frames of the choice `coming` are not there yet."""
        lit_ids = [led for choice in choices for burst in choice.bursts for led in burst.leds]
        coming_ids = [led for burst in (coming.bursts if coming else ()) for led in burst.leds]
        is_seen = [ShotLabel(Led(led), view.bursts[0].exposure_index, 0) in samples for led in lit_ids]
        seen_ids = [led for led, was_proven in zip(lit_ids, is_seen, strict=True) if was_proven]
        if len(lit_ids) == len(view.leds):
            return Choice(bursts=(), reason="all LEDs of the view are lit")
        if len(seen_ids) < FEWEST_TAKEN:
            return Choice(bursts=(), reason=f"{len(seen_ids)} frames are proven: too few for a choice")
        values = self._values(view, seen_ids, samples)
        unlit_rows = np.flatnonzero(~np.isin(view.leds, lit_ids))
        count = min(lights.burst_lights, lights.until.lights - len(lit_ids))
        following = next_lights(
            values,
            self._ways(view),
            _rows(view, seen_ids),
            unlit_rows,
            count,
            coming_lights=_rows(view, coming_ids),
        )
        next_ids = view.leds[following.lights].tolist()
        affordable_ids = self._affordable(view, lights, next_ids, len(lit_ids), len(choices))
        figures = _figures(view, following, len(lit_ids), len(seen_ids))
        if reason := _enough(lights, figures, len(affordable_ids)):
            return Choice(bursts=(), reason=reason, figures=figures)
        errors = f"{100.0 * figures['relit_rms']:.2f} %, {100.0 * figures['relit_rms_after']:.2f} % after them"
        reason = f"the {len(affordable_ids)} LEDs that add the most information: expected error {errors}"
        return self._choice(view, affordable_ids, reason, figures)

    def _affordable(
        self, view: OpenView, lights: AdaptiveLights, ids: list[int], lit_before: int, bursts_before: int
    ) -> list[int]:
        """Return the first of the LEDs, as many as time and light allow after `lit_before` in `bursts_before`.
        Each LED is assumed to be as bright as the brightest."""
        until, whole = lights.until, view.bursts[0]
        count = len(ids)
        if until.seconds is not None:
            period_s = whole.timing.period_us * 1e-6
            marks_s = whole.duration_s - len(view.leds) * period_s
            left_s = until.seconds - lit_before * period_s - (bursts_before + 1) * marks_s
            count = min(count, int(left_s / period_s) if left_s > 0 else 0)
        if until.lux_h is not None:
            led_lux_h = float(self._lux(view).max()) * whole.timing.on_us / 3.6e9
            count = min(count, max(0, int(until.lux_h / led_lux_h) - lit_before))
        return ids[:count]

    def _values(self, view: OpenView, seen_ids: Sequence[int], samples: Mapping[ShotLabel, FrameSample]) -> Floats:
        """Return [seen, sites], the signal for unit illuminance."""
        exposure = view.bursts[0].exposure_index
        signals = [samples[ShotLabel(Led(led), exposure, 0)].signal_dn for led in seen_ids]
        step = max(1, len(signals[0]) // _SITES) | 1  # odd: pixels of all colours
        lux = self._lux(view)[_rows(view, seen_ids)]
        signals_dn = np.stack([signal[::step] for signal in signals]).astype(np.float64)
        return np.asarray(signals_dn / (lux / lux.mean())[:, None])

    def _choice(
        self, view: OpenView, ids: Sequence[int], reason: str, figures: Mapping[str, Any] | None = None
    ) -> Choice:
        burst = view.bursts[0]
        chosen_burst = ChosenBurst(
            exposure=burst.exposure_index, exposure_us=burst.timing.exposure_us, leds=tuple(sorted(ids))
        )
        return Choice(bursts=(chosen_burst,) if len(ids) else (), reason=reason, figures=dict(figures or {}))

    def _target_base_mm(self, view: OpenView) -> Floats:
        return np.asarray(apply(self._base_from_support, np.array([view.target_mm or (0.0, 0.0, 0.0)])))

    def _lux(self, view: OpenView) -> Floats:
        """[leds] illuminance at the view's target by the LED table, lux."""
        lux = self._leds.illuminance_lux(self._target_base_mm(view), emission=self._emission)[0]
        of_view = lux[self._leds.rows(view.leds)]
        return np.asarray(np.maximum(of_view, 1e-6 * float(of_view.max())))

    def _ways(self, view: OpenView) -> Floats:
        """[leds, 3] unit vectors from the view's target."""
        ways = self._leds.positions_mm[self._leds.rows(view.leds)] - self._target_base_mm(view)
        return np.asarray(ways / np.linalg.norm(ways, axis=1, keepdims=True))


def _rows(view: OpenView, ids: Sequence[int]) -> NDArray[np.int64]:
    """Rows of the view's LEDs."""
    row_of_id = {led: row for row, led in enumerate(view.leds.tolist())}
    return np.array([row_of_id[led] for led in ids], np.int64)


def _figures(view: OpenView, following: NextLights, lit: int, seen: int) -> dict[str, Any]:
    return {
        "lights": lit,
        "seen": seen,
        "relit_rms": float(f"{following.expected_rms:.4g}"),
        "relit_rms_after": float(f"{following.expected_rms_after:.4g}"),
        "first": [int(led) for led in view.leds[following.lights[:1]]],
        "next_best": [int(view.leds[light]) for light in following.alternatives],
    }


def _enough(lights: AdaptiveLights, figures: Mapping[str, Any], affordable: int) -> str:
    """Return the reason why no more LEDs are lit; empty if there is none."""
    error_text, until = f"expected error {100.0 * figures['relit_rms']:.2f} %", lights.until
    if until.relit_rms is not None and figures["relit_rms"] <= until.relit_rms:
        return f"enough by `relit_rms`: {error_text} of at most {100.0 * until.relit_rms:g} %"
    if figures["lights"] >= until.lights:
        return f"enough by `lights`: {until.lights} LEDs are lit; {error_text}"
    return f"enough by `seconds` or `lux_h`: the plan allows no more LEDs; {error_text}" if affordable == 0 else ""
