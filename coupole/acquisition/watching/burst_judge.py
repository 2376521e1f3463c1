"""Judges the looks of a burst: names each change, and the shots that it concerns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.watching.camera_noise import CameraNoise
from coupole.acquisition.watching.dark_frames import ambient_light, dark_level, tile_means
from coupole.acquisition.watching.findings import OF_THE_LIGHT, Found, Kind, SeenFrame
from coupole.acquisition.watching.frame_look import FrameLook
from coupole.acquisition.watching.neighbour_lights import foretelling, scatter_of, shares_over_neighbours
from coupole.acquisition.watching.sentinels import Change, change_between
from coupole.plan.shot_id import Led, Sentinel, ShotLabel
from coupole.plan.watch import SENTINELS, WatchLimits

_OPAQUE = 0.3
"""Greatest local change of brightness that a smudge on the lens can cause. A smudge is far out of focus, and
covers only a part of the aperture."""
_STILL_THERE = 0.5
"""Share of a local change that the last frame of its LED must still show. Noise is less than half of a change that
is found."""
_COMES_BACK_MM = 0.1
"""Displacement of the picture that is normal after the arm has left the view and come back. Makers of industrial
arms state a pose repeatability (ISO 9283) of some 0.02 to 0.06 mm. It counts for each of the two poses."""
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LightTable:
    """Lights of the dome as a view's target receives them, by LED."""

    directions: Mapping[int, Floats]
    """[3] unit vectors from the target."""
    light: Mapping[int, float]
    """Light of each LED, by the LED table."""


@dataclass
class FirstFrames:
    """Frames with which later ones are compared."""

    darks: dict[int, tuple[NDArray[np.float32], int]] = field(default_factory=dict)
    """Level and number of the session's first dark frames, by exposure, us."""
    sentinels: dict[int, dict[int, FrameLook]] = field(default_factory=dict)
    """The view's first frame of each LED, by exposure, us."""

    earlier: set[int] = field(default_factory=set)
    """Exposures, us, whose sentinels were first lit in an earlier session."""

    def begin_view(self) -> None:
        """Begin a view: the camera looks from another place."""
        self.sentinels.clear()
        self.earlier.clear()

    def note_earlier(self, exposure_us: int, led: int, look: FrameLook) -> None:
        """Note that an earlier session has the view's first frame of this LED."""
        self.sentinels.setdefault(exposure_us, {})[led] = look
        self.earlier.add(exposure_us)


@dataclass(frozen=True)
class BurstJudge:
    """Judge of the bursts of one view."""

    limits: WatchLimits
    noise: CameraNoise
    mm_per_bin: float
    """Length on the object that a bin has at the focus distance."""
    lights: LightTable
    first: FirstFrames

    def judge(self, frames: Sequence[SeenFrame], exposure_us: int) -> list[Found]:
        """Return findings in the frames of one burst; the strongest evidence comes first. The frames are in the
        order of time."""
        if ambient := self._ambient(frames, exposure_us):
            return [ambient]
        lit = [frame for frame in frames if isinstance(frame.label.light, Led | Sentinel)]
        by_sentinels = self._by_sentinels(lit, exposure_us)
        return [by_sentinels] if by_sentinels else self._by_neighbours(lit)

    # -- dark frames --------------------------------------------------------------------------------------

    def _ambient(self, frames: Sequence[SeenFrame], exposure_us: int) -> Found | None:
        places = [place for place, frame in enumerate(frames) if frame.label.is_dark]
        lit = [place for place, frame in enumerate(frames) if not frame.label.is_dark]
        middle = lit[len(lit) // 2] if lit else len(frames) // 2
        before = [frames[place] for place in places if place < middle]
        after = [frames[place] for place in places if place >= middle]
        if not before:
            return None
        reference_dn, count = self.first.darks.setdefault(exposure_us, (dark_level(before), len(before)))
        for later in (before, after):
            finding = ambient_light(reference_dn, count, later, self.noise, self.limits, exposure_us)
            if finding:
                spoilt = [
                    *(frame.label for frame in frames if frame.label.is_shot),
                    *(dark.label for dark in later),
                ]
                return replace(finding, labels=tuple(spoilt))
        return None

    # -- neighbouring lights ------------------------------------------------------------------------------

    def _by_neighbours(self, lit: Sequence[SeenFrame]) -> list[Found]:
        """Find LEDs whose pictures are much too dim or bright beside their neighbours."""
        shots = [frame for frame in lit if isinstance(frame.label.light, Led)]
        leds = [_led_of(frame.label) for frame in shots]
        weights = foretelling(np.array([self.lights.directions[led] for led in leds])) if shots else None
        if weights is None:
            return []
        tiles_dn = tile_means(np.stack([frame.look.mean_dn for frame in shots])).reshape(len(shots), -1)
        light = np.maximum([self.lights.light[led] for led in leds], 1e-9)
        shares = shares_over_neighbours(tiles_dn, light, weights)
        limit = max(self.limits.least_share, self.limits.sigmas * scatter_of(shares))
        over = np.abs(shares) / limit
        findings = []
        for frame in np.flatnonzero(over > 1.0):
            near = np.flatnonzero(weights[frame])
            if over[frame] < over[near].max():  # the neighbour is what differs
                continue
            share, label = float(shares[frame]), shots[frame].label
            words = (
                f"{label.light} differs by {share:+.0%} from the prediction by its neighbours and the LED table"
            )
            nearest = shots[int(near[np.argmax(weights[frame][near])])].look.mean_dn
            looks = nearest, shots[frame].look.mean_dn
            findings.append(Found("LED", (label,), abs(share), limit, OF_THE_LIGHT, words, *looks))
        return findings

    # -- sentinels ----------------------------------------------------------------------------------------

    def _by_sentinels(self, lit: Sequence[SeenFrame], exposure_us: int) -> Found | None:
        places = [place for place, frame in enumerate(lit) if isinstance(frame.label.light, Sentinel)]
        first = self.first.sentinels.setdefault(exposure_us, {})
        for place in places:
            first.setdefault(_led_of(lit[place].label), lit[place].look)
        known_places, changes = [], []
        for place in places:
            before = first[_led_of(lit[place].label)]
            change = None if before is lit[place].look else change_between(before, lit[place].look, self.noise)
            if change is not None:
                known_places.append(place)
                changes.append(change)
        if len(changes) < SENTINELS:
            return None
        series = _Series(lit, known_places, changes, first, exposure_us in self.first.earlier)
        for look_for in (self._thing, self._displacement, self._smudge, self._of_light):
            if finding := look_for(series):
                return finding
        return None

    def _places(self, series: _Series) -> _Places:
        """Return changes in places, as far as a displacement does not explain them better."""
        over, shares, stays = [], [], []
        last_of_led = {_led_of(series.lit[place].label): k for k, place in enumerate(series.places)}
        for place, change in zip(series.places, series.changes, strict=True):
            limit = np.maximum(self.limits.least_share, self.limits.sigmas * change.tile_sigmas)
            figure = np.abs(change.tile_shares) / limit
            worst = np.unravel_index(int(np.argmax(figure)), figure.shape)
            in_the_end = series.changes[last_of_led[_led_of(series.lit[place].label)]].tile_shares[worst]
            over.append(float(figure[worst]) if change.by_places >= change.by_shift else 0.0)
            shares.append(float(np.abs(np.where(figure > 1.0, change.tile_shares, 0.0)).max()))
            share = change.tile_shares[worst]
            stays.append(bool(share and in_the_end / share >= _STILL_THERE))
        return _Places(np.array(over) > 1.0, np.array(shares) > _OPAQUE, np.array(stays))

    def _place_found(
        self, kind: Kind, series: _Series, begin: int, end: int | None, words: Callable[[float], str]
    ) -> Found:
        """Return the finding of a change in places, with the figure of the place that is farthest beyond its
        limit."""
        change = series.changes[begin]
        limit = np.maximum(self.limits.least_share, self.limits.sigmas * change.tile_sigmas)
        worst = np.unravel_index(int(np.argmax(np.abs(change.tile_shares) / limit)), limit.shape)
        figure = float(change.tile_shares[worst])
        return series.finding(kind, begin, end, abs(figure), float(limit[worst]), OF_THE_LIGHT, words(figure))

    def _thing(self, series: _Series) -> Found | None:
        """Find a change in places that is too strong for a smudge, or that goes away."""
        places = self._places(series)
        is_passing = places.is_over & (places.is_strong | ~places.stays)
        if not is_passing.any():
            return None
        begin = end = int(np.argmax(is_passing))
        while end + 1 < len(is_passing) and places.is_over[end + 1]:
            end += 1
        count = f"{end - begin + 1} of {len(is_passing)} sentinels"
        return self._place_found(
            "thing in the field", series, begin, end, lambda _: f"something lay in the field, for {count}"
        )

    def _smudge(self, series: _Series) -> Found | None:
        """Find a change in places that stays in the picture while everything else is as before."""
        is_over = self._places(series).is_over
        if not is_over.any():
            return None
        return self._place_found(
            "smudge",
            series,
            int(np.argmax(is_over)),
            None,
            lambda figure: (
                f"a place in the picture has changed by {figure:+.1%} and remains changed: perhaps a smudge on "
                "the lens"
            ),
        )

    def _displacement(self, series: _Series) -> Found | None:
        """Find a motion of the object or the camera: the sentinels' pictures are displaced, and stay displaced."""
        shifts_mm = np.array([np.linalg.norm(change.shift_bins) for change in series.changes]) * self.mm_per_bin
        sigmas_mm = np.array([change.shift_sigma_bins for change in series.changes]) * self.mm_per_bin
        least_mm = self.limits.least_mm + (_COMES_BACK_MM if series.is_since_earlier else 0.0)
        limits_mm = np.maximum(least_mm, self.limits.sigmas * sigmas_mm)
        is_displacement = np.array([change.by_shift > change.by_places for change in series.changes])
        since = _lasting((shifts_mm > limits_mm) & is_displacement)
        if since is None or len(shifts_mm) - since < SENTINELS:
            return None
        figure, limit = float(np.median(shifts_mm[since:])), float(np.median(limits_mm[since:]))
        words = f"the picture is displaced by {figure:.2f} mm on the object: the object or the camera was moved"
        return series.finding("moved", since, None, figure, limit, "mm", words)

    def _of_light(self, series: _Series) -> Found | None:
        """Find a change of brightness: of one LED alone, of all LEDs in one step, or a drift of all."""
        gains = np.array([change.gain for change in series.changes])
        noise = max(change.gain_sigma for change in series.changes)
        limit = max(
            self.limits.least_share, self.limits.sigmas * float(np.hypot(noise, 2**0.5 * self.limits.led_flicker))
        )
        is_over = np.abs(gains) > limit
        leds = np.array([_led_of(series.lit[place].label) for place in series.places])
        changed_leds = np.unique(leds[is_over])
        if not len(changed_leds):
            return None
        largest = int(np.argmax(np.abs(gains)))
        figure, since = float(gains[largest]), int(np.argmax(is_over))
        share = f"{np.expm1(figure):+.1%}"
        if len(changed_leds) == 1:
            led = int(changed_leds[0])
            labels = tuple(f.label for f in series.lit if f.label.is_shot and _led_of(f.label) == led)
            words = f"{Led(led)} changed by {share} from flash to flash; the other sentinels did not change"
            finding = series.finding("LED", largest, None, abs(figure), limit, OF_THE_LIGHT, words)
            return replace(finding, labels=labels)
        if since == 0 and series.is_since_earlier:
            words = (
                f"all LEDs together differ by {share} from their light in the session before: check LEDs, "
                "camera and its settings"
            )
            return series.finding("drift", since, None, abs(figure), limit, OF_THE_LIGHT, words)
        if _is_step(np.array(series.places, float), gains):
            words = f"all light changed by {share} in one step: check gain and exposure of the camera"
            return series.finding("exposure step", since, None, abs(figure), limit, OF_THE_LIGHT, words)
        words = f"all light has drifted by {share}: perhaps LEDs, reference or camera are warming up"
        return series.finding("drift", since, None, abs(figure), limit, OF_THE_LIGHT, words)


@dataclass(frozen=True)
class _Places:
    """Changes in places, for each of the sentinels."""

    is_over: NDArray[np.bool_]
    is_strong: NDArray[np.bool_]
    """The change is too strong for a smudge."""
    stays: NDArray[np.bool_]
    """The last sentinel of the same LED shows the change too, at least in part."""


@dataclass(frozen=True)
class _Series:
    """Sentinels that could be compared with the first one of their LED, in the order of time."""

    lit: Sequence[SeenFrame]
    places: Sequence[int]
    """Place of each sentinel among the lit frames."""
    changes: Sequence[Change]
    first: Mapping[int, FrameLook]
    is_since_earlier: bool
    """True if the first frames come from an earlier session: the arm has left the view meanwhile, and come
    back."""

    def finding(
        self, kind: Kind, begin: int, end: int | None, figure: float, limit: float, unit: str, words: str
    ) -> Found:
        """Return a finding that shows in the sentinels from `begin` to `end` (None: the last). It concerns all
        shots from the sentinel before `begin` to the sentinel after `end`."""
        first_place = self.places[begin - 1] if begin else -1
        end_place = len(self.lit) if end is None or end + 1 == len(self.places) else self.places[end + 1]
        labels = tuple(f.label for f in self.lit[first_place + 1 : end_place] if f.label.is_shot)
        after = self.lit[self.places[begin]]
        before = self.first[_led_of(after.label)]
        return Found(kind, labels, figure, limit, unit, words, before.mean_dn, after.look.mean_dn)


def _is_step(times: Floats, gains: Floats) -> bool:
    """True if gains [n] at these times are nearer to a step than to a line that begins at some time. Step and line
    both begin at 0."""
    step_squares, line_squares = [], []
    for begin in range(len(gains)):
        later = gains[begin:]
        before = float(np.sum(gains[:begin] ** 2))
        step_squares.append(before + float(np.sum((later - later.mean()) ** 2)))
        for since in (
            times[begin - 1] if begin else 0.0,
            0.5 * (times[begin - 1] + times[begin]) if begin else 0.0,
        ):
            ramp = times[begin:] - since
            slope = float(ramp @ later) / max(float(ramp @ ramp), 1e-12)
            line_squares.append(before + float(np.sum((later - slope * ramp) ** 2)))
    return min(step_squares) <= min(line_squares)


def _led_of(label: ShotLabel) -> int:
    light = label.light
    assert isinstance(light, Led | Sentinel)
    return light.id if isinstance(light, Led) else light.led


def _lasting(is_over: NDArray[np.bool_]) -> int | None:
    """Return the first of the last values that are all above the limit; None if the last value is not above the
    limit."""
    if not len(is_over) or not is_over[-1]:
        return None
    within = np.flatnonzero(~is_over)
    return int(within[-1]) + 1 if len(within) else 0
