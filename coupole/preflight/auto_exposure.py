"""Chooses exposures in the run for each LED of a view, from the view's frames (`exposure: {kind: auto}`).

1. *First pass.* Some LEDs, spread over the dome, are taken with the middle one of the plan's exposure times. Some
   of them are taken twice, which gives the noise (`exposure_advice.noise_of_pairs`). LEDs that clip are taken
   again with a time four stops shorter. If all frames are dark, some LEDs are taken again with a time four stops
   longer.
2. *All LEDs.* The rates of the pixels (DN per us) give two limits for each LED of the first pass. Above the
   longest time, more than the allowed share of pixels is clipped. Below the shortest time, too few of the object's
   pixels reach the signal-to-noise ratio. For all other LEDs, both limits are scaled by the illuminance of the LED
   table, and interpolated by direction (logarithms, weighted by inverse squares of the distance). Within the
   limits, `exposure_times` chooses the times.
3. *Corrections.* Each LED's own frames are compared with the plan's limits; for clipping, all pixels count. An LED
   that does not meet the limits gets one more exposure, at most twice.

Pixels that get light only from other surfaces need not reach the signal-to-noise ratio (`exposure_evidence`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform, apply
from coupole.plan.choices import Choice, Chooser, ChosenBurst, FrameSample, OpenView
from coupole.plan.exposures import STEPS_PER_STOP, AutoExposure
from coupole.plan.led_table import LedTable
from coupole.plan.light_selection import first_lights
from coupole.plan.shot_id import ShotLabel
from coupole.preflight.exposure_evidence import FULL, QUANTILES, Evidence, Judgement
from coupole.preflight.exposure_times import LightLimits, Wish, chosen_times

Floats = NDArray[np.float64]

_UNSEEN_LIGHTS = 0.85
"""Factor on the longest time of LEDs that were not in the first pass, because they may be brighter than
interpolated."""
_NOISE_MARGIN = 1.05
_LEAST_RATE = 1e-9
_PROBE_STEPS = 4 * STEPS_PER_STOP
"""Steps between the exposures of the first pass, if one is not enough."""
_CORRECTION_STEPS = 2 * STEPS_PER_STOP
_DARK_SHARE = 0.02
"""Share of full scale that bright pixels of the first pass must reach; otherwise a longer exposure is taken."""
_BRIGHT_QUANTILE = 0.999
_NEIGHBOURS = 4
_BURST_S = 0.14
"""Duration of a burst, s, in addition to its steps, as in preflight."""
_CORRECTIONS, _BURSTS_OF_A_CORRECTION = 2, 2
_PROBE = "probe"


class AutoExposureChooser(Chooser):
    """The `Chooser` of plans with `exposure: {kind: auto}`."""

    def __init__(
        self, exposure: AutoExposure, leds: LedTable, base_from_support: Transform, *, emission: str = "lambertian"
    ) -> None:
        self._exposure, self._leds, self._emission = exposure, leds, emission
        self._base_from_support = base_from_support

    def choose(
        self, view: OpenView, choices: Sequence[Choice], samples: Mapping[ShotLabel, FrameSample]
    ) -> Choice:
        """See `coupole.plan.choices.Chooser`."""
        if not choices:
            return self._first_pass(view)
        lux_of_led = dict(zip(view.leds.tolist(), self._lux(view).tolist(), strict=True))
        evidence = Evidence(self._exposure, lux_of_led, choices[0].bursts[0].leds, samples)
        if not evidence.first_leds:
            return Choice(bursts=(), reason="no frame of the first pass is proven, so no exposure can be chosen")
        if len(choices) == 1 and (probes := self._probes(view, evidence)):
            reason = _in_words("the frames of the first pass are clipped or dark", probes)
            return Choice(bursts=tuple(probes), reason=reason, figures={_PROBE: True})
        rounds = len([choice for choice in choices[1:] if _PROBE not in choice.figures])
        if rounds == 0:
            return self._for_all(view, evidence, lux_of_led)
        return self._correction(evidence, is_over=rounds > _CORRECTIONS, again=rounds)

    # -- the first pass -----------------------------------------------------------------------------------

    def _first_pass(self, view: OpenView) -> Choice:
        place = len(self._exposure.exposures_us) // 2
        spread_leds = first_lights(view.leds, self._leds, self._exposure.first_lights).tolist()
        bursts = [self._burst(place, {*spread_leds, *view.leds_taken_twice})]
        if view.leds_taken_twice:
            bursts.append(self._burst(place, view.leds_taken_twice, repeat=1))
        return Choice(bursts=tuple(bursts), reason=_in_words("first pass over the dome", bursts))

    def _probes(self, view: OpenView, evidence: Evidence) -> list[ChosenBurst]:
        """Return more exposures of those first LEDs whose rates one exposure does not show."""
        leds, exposure = evidence.first_leds, self._exposure
        place = evidence.taken[leds[0]][0]
        first_samples = {led: evidence.sample(led, place) for led in leds}
        bursts = []
        clipped_leds = [led for led in leds if first_samples[led].clipped_share > exposure.clipped_share]
        if clipped_leds and place > 0:
            bursts.append(self._burst(max(0, place - _PROBE_STEPS), clipped_leds))
        bright_dn = np.median(
            [np.quantile(sample.signal_dn, _BRIGHT_QUANTILE) for sample in first_samples.values()]
        )
        longer = min(place + _PROBE_STEPS, len(exposure.exposures_us) - 1)
        if bright_dn < _DARK_SHARE * evidence.full_dn and view.leds_taken_twice and longer > place:
            dark_leds = [led for led in view.leds_taken_twice if led not in clipped_leds]
            bursts += (
                [self._burst(longer, dark_leds), self._burst(longer, dark_leds, repeat=1)] if dark_leds else []
            )
        return bursts

    # -- all LEDs -----------------------------------------------------------------------------------------

    def _for_all(self, view: OpenView, evidence: Evidence, lux_of_led: Mapping[int, float]) -> Choice:
        limits, group_of = self._limits(view, evidence, lux_of_led)
        bursts = [view.burst(place) for place in range(len(evidence.times_us))]
        wish = Wish(
            precisions=evidence.precisions(limits.rates),
            snr=_NOISE_MARGIN * self._exposure.snr,
            share=self._exposure.object_share,
            most=self._exposure.most_exposures,
            step_s=np.array([_period_s(burst) for burst in bursts]),
            burst_s=np.array([_BURST_S + b.duration_s - len(view.leds) * _period_s(b) for b in bursts]),
        )
        places_of_groups = chosen_times(limits, wish)
        leds_at: dict[int, list[int]] = {}
        for led, group in zip(view.leds.tolist(), group_of.tolist(), strict=True):
            taken_places = evidence.taken.get(led, [])
            new_places = self._still_needed(places_of_groups[group], taken_places)
            for place in new_places[: self._exposure.most_exposures - len(taken_places)]:
                leds_at.setdefault(place, []).append(led)
        chosen_bursts = sorted((self._burst(place, leds) for place, leds in leds_at.items()), key=_leds_of)
        figures = _figures(evidence) | {"groups": len(limits.counts)}
        reason = _in_words("all LEDs, by the first pass", chosen_bursts)
        return Choice(bursts=tuple(chosen_bursts), reason=reason, figures=figures)

    @staticmethod
    def _still_needed(places: Sequence[int], taken_places: Sequence[int]) -> list[int]:
        """Return the places among the exposure times that are still needed after exposures at `taken_places`: the
        ends of `places` that lie beyond `taken_places`."""
        if not taken_places:
            return list(places)
        ends = [places[0]] if places[0] < taken_places[0] else []
        ends += [places[-1]] if places[-1] > taken_places[-1] and places[-1] not in ends else []
        return ends

    def _limits(
        self, view: OpenView, evidence: Evidence, lux_of_led: Mapping[int, float]
    ) -> tuple[LightLimits, NDArray[np.int64]]:
        """Return the limits for groups of LEDs, from the limits of the first pass, and the group [leds] of each
        LED.

        All LEDs of a group have the same two limits: the exposure time from which they clip, and the time from
        which their dim pixels reach the ratio.
        """
        judgements = [evidence.judge(led) for led in evidence.first_leds]
        lux = np.array([lux_of_led[led] for led in view.leds.tolist()])
        first_lux = np.array([lux_of_led[led] for led in evidence.first_leds])
        weights = self._weights(view, evidence.first_leds)
        full_rates = np.array([max(judgement.full_rate, _LEAST_RATE) for judgement in judgements])
        lit_rates = np.stack([_lit_rates(judgement) for judgement in judgements])
        log_full = weights @ np.log(full_rates / first_lux)
        log_lit = weights @ np.log(lit_rates / first_lux[:, None])
        seen_before = np.isin(view.leds, evidence.first_leds)
        longest_us = (
            FULL * evidence.full_dn / (lux * np.exp(log_full)) * np.where(seen_before, 1.0, _UNSEEN_LIGHTS)
        )
        rates = (lux[:, None] * np.exp(log_lit)).astype(np.float32)
        dim_rates = rates[:, round((1.0 - self._exposure.object_share) * (QUANTILES - 1))]
        shortest_us = evidence.noise.signal_for(self._exposure.snr) / dim_rates
        longest = np.searchsorted(evidence.times_us, longest_us, side="right") - 1
        keys = np.stack([longest, np.searchsorted(evidence.times_us, shortest_us)], axis=1)
        pairs, group_of = np.unique(keys, axis=0, return_inverse=True)
        group_of = group_of.ravel()
        counts = np.bincount(group_of, minlength=len(pairs))
        log_rates = np.stack([np.log(rates[group_of == group]).mean(axis=0) for group in range(len(pairs))])
        return LightLimits(pairs[:, 0], np.exp(log_rates).astype(np.float32), counts), group_of

    def _weights(self, view: OpenView, first_leds: Sequence[int]) -> Floats:
        """Return the weights [leds, first] of the first LEDs for each LED, by the directions from the view's
        target. Only the nearest first LEDs have a weight."""
        target_mm = apply(self._base_from_support, np.array([view.target_mm or (0.0, 0.0, 0.0)]))
        ways, first_ways = (
            way / np.linalg.norm(way, axis=1, keepdims=True)
            for way in (
                self._leds.positions_mm[self._leds.rows(ids)] - target_mm for ids in (view.leds, first_leds)
            )
        )
        square = np.maximum(2.0 - 2.0 * ways @ first_ways.T, 1e-9)
        nearest = np.sort(square, axis=1)[:, [min(_NEIGHBOURS, len(first_leds)) - 1]]
        weights = np.where(square <= nearest, 1.0 / square, 0.0)
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    # -- corrections --------------------------------------------------------------------------------------

    def _correction(self, evidence: Evidence, *, is_over: bool, again: int) -> Choice:
        """Choose one more exposure for each LED that does not meet the plan's limits; none if all meet them, or if
        the rounds are over (`is_over`)."""
        exposure = self._exposure
        shorter: dict[int, int] = {}
        longer: dict[int, int] = {}
        clipped_count, noisy_count = 0, 0
        for led, places in evidence.taken.items():
            judgement = evidence.judge(led)
            remaining = exposure.most_exposures - len(places)
            if judgement.clipped_share > exposure.clipped_share:
                clipped_count += 1
                if remaining > 0 and places[0] > 0:
                    shorter[led], remaining = max(0, places[0] - _CORRECTION_STEPS * again), remaining - 1
            if judgement.reached_share < exposure.object_share:
                noisy_count += 1
                if remaining > 0 and (helping := evidence.place_that_helps(led)) is not None:
                    longer[led] = helping
        figures = _figures(evidence) | {
            "leds": len(evidence.taken),
            "clipped_leds": clipped_count,
            "noisy_leds": noisy_count,
        }
        if is_over or not (shorter or longer):
            return Choice(
                bursts=(), reason=_conclusion(len(evidence.taken), clipped_count, noisy_count), figures=figures
            )
        bursts = []
        for place, leds in (*_in_groups(shorter, min).items(), *_in_groups(longer, max).items()):
            lacking = [led for led in leds if place not in evidence.taken[led]]
            bursts += [self._burst(place, lacking)] if lacking else []
        reason = _in_words(f"{clipped_count} LEDs clip, {noisy_count} are too noisy", bursts)
        return Choice(bursts=tuple(_one_for_each_exposure(bursts)), reason=reason, figures=figures)

    # -- small things -------------------------------------------------------------------------------------

    def _lux(self, view: OpenView) -> Floats:
        """Return [leds] illuminance at the view's target by the LED table, relative to its median."""
        target_mm = np.array([view.target_mm or (0.0, 0.0, 0.0)])
        lux = self._leds.illuminance_lux(apply(self._base_from_support, target_mm), emission=self._emission)
        of_view = lux[0, self._leds.rows(view.leds)]
        relative: Floats = np.maximum(of_view / max(float(np.median(of_view)), 1e-12), 1e-3)
        return relative

    def _burst(self, place: int, leds: Iterable[int], *, repeat: int = 0) -> ChosenBurst:
        exposure_us = self._exposure.exposures_us[place]
        return ChosenBurst(exposure=place, exposure_us=exposure_us, repeat=repeat, leds=tuple(sorted(leds)))


def _lit_rates(judgement: Judgement) -> Floats:
    """Return [quantiles] rates of lit pixels, DN per us. An LED that lights no pixel counts as one that lights all
    pixels well."""
    rates = judgement.lit_rates if len(judgement.lit_rates) else np.full(QUANTILES, judgement.full_rate)
    return np.maximum(rates.astype(np.float64), _LEAST_RATE)


def _leds_of(burst: ChosenBurst) -> int:
    return len(burst.leds)


def _period_s(burst: Any) -> float:
    return float(burst.timing.period_us) * 1e-6


def _in_groups(place_of_led: Mapping[int, int], representative: Any) -> dict[int, list[int]]:
    """Group LEDs by place, into at most two groups. If there are more places, they are divided at the widest gap,
    and each group gets the place that its outermost LED needs."""
    places = sorted(set(place_of_led.values()))
    if not places:
        return {}
    parts = [places]
    if len(places) >= _BURSTS_OF_A_CORRECTION:
        widest = 1 + int(np.argmax(np.diff(places)))
        parts = [places[:widest], places[widest:]]
    place_for = {place: representative(part) for part in parts for place in part}
    leds_at: dict[int, list[int]] = {}
    for led, place in place_of_led.items():
        leds_at.setdefault(place_for[place], []).append(led)
    return leds_at


def _one_for_each_exposure(bursts: Iterable[ChosenBurst]) -> list[ChosenBurst]:
    """Return the bursts, joined to one burst for each exposure. The smallest burst is first, because its table
    reaches the box soonest."""
    leds_at: dict[int, ChosenBurst] = {}
    for burst in bursts:
        before = leds_at.get(burst.exposure)
        leds = tuple(sorted({*burst.leds, *(before.leds if before else ())}))
        leds_at[burst.exposure] = burst.model_copy(update={"leds": leds})
    return sorted(leds_at.values(), key=lambda burst: (len(burst.leds), burst.exposure))


def _in_words(purpose: str, bursts: Iterable[ChosenBurst]) -> str:
    parts = [
        f"{len(burst.leds)} LEDs at {burst.exposure_us / 1e3:g} ms" + (" again" if burst.repeat else "")
        for burst in bursts
    ]
    return f"{purpose}: {', '.join(parts) or 'no more'}"


def _conclusion(leds: int, clipped_count: int, noisy_count: int) -> str:
    if not clipped_count and not noisy_count:
        return f"all {leds} LEDs are exposed as requested"
    parts = [f"{clipped_count} of {leds} LEDs clip more than allowed"] if clipped_count else []
    parts += [f"{noisy_count} of {leds} LEDs are noisier than requested"] if noisy_count else []
    return f"{' and '.join(parts)}; the plan allows no more exposures"


def _figures(evidence: Evidence) -> dict[str, Any]:
    noise = evidence.noise
    return {"read_dn": round(noise.read_dn, 4), "gain_dn": round(noise.gain_dn, 6)}
