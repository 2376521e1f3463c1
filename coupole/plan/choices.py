"""Bursts that are chosen during a run, from the proven frames of their view.

A plan with a `Chooser` does not say which bursts a view gets. Before the run there are two lists for each view.
The first list has the bursts to choose *from* (each exposure with all LEDs). The second is a *bound*: its bursts
together are longer, hotter and larger, and give more light, than any choice. Preflight checks the bound as if it
were the plan. In the run the chooser is asked again and again, until it has enough:

    choice = chooser.choose(view, choices before, samples of the frames that are proven)

While the bursts of a choice are fired, the chooser may already say what follows them (`choose_ahead`), so that the
box need not wait for it.

A choice is written into the journal, with its reason, and synced before its first light. A resumed run repeats the
choices of its journal and goes on from there. So a chooser must be a function of its arguments alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from coupole.plan.base_model import ExposureUs, LedId, Model
from coupole.plan.bursts import Burst
from coupole.plan.shot_id import Dark, Led, Light, ShotLabel

MOST_BURSTS = 16
"""Greatest number of bursts of one view, if bursts are chosen."""
MOST_CHOICES = 6
"""Greatest number of choices for one view. Preflight includes the time that each choice takes."""
Number = Annotated[int, Field(ge=0, le=100_000)]


class ChosenBurst(Model):
    """One burst: LEDs at one exposure."""

    exposure: Number
    """Place among the plan's exposures, as in shot ids."""
    exposure_us: ExposureUs
    """The exposure time."""
    repeat: Number = 0
    """Number of the repeat, as in shot ids."""
    leds: tuple[LedId, ...]
    """LEDs, in the order of the LED table."""
    darks: Number = 0
    """Number of its dark frames and marks that are kept. Only the first burst of an exposure has them."""

    def labels(self) -> Iterator[ShotLabel]:
        """Yield the labels of the frames that it will give."""
        lights: list[Light] = [*map(Led, self.leds), *map(Dark, range(self.darks))]
        for light in lights:
            yield ShotLabel(light, self.exposure, self.repeat)


class Choice(Model):
    """The next bursts of a view. None means that the view has enough."""

    bursts: tuple[ChosenBurst, ...]
    """The bursts, in their order."""
    reason: str
    """The reason, in words for the journal and the report."""
    figures: dict[str, Any] = Field(default_factory=dict)
    """Numbers behind the reason, and the alternatives that were weighed, with values of JSON only."""


def has_enough(choices: Sequence[Choice]) -> bool:
    """True if the last of a view's choices says that the view needs no more."""
    return bool(choices) and not choices[-1].bursts


@dataclass(frozen=True)
class FrameSample:
    """The pixels of one proven frame that a chooser gets."""

    clipped_share: float
    """Share of all its pixels at the top of the range."""
    signal_dn: NDArray[np.int16]
    """[n] pixels above black, from Bayer cells that are spread evenly over the frame."""
    full_dn: int
    """Top of the range above black, DN."""


@dataclass(frozen=True)
class OpenView:
    """A view whose bursts are chosen."""

    name: str
    target_mm: tuple[float, float, float] | None
    """The point in the picture's middle, in the support frame; None if the plan gives joints."""
    bursts: tuple[Burst, ...]
    """Bursts from which the shots are chosen. There is one burst for each exposure and repeat, with all LEDs of
    the view.
    """
    bound: tuple[Burst, ...]
    """Bursts with at least as much light and time as any choice."""

    @cached_property
    def leds(self) -> NDArray[np.int64]:
        """[n] ids of the LEDs that may be lit, in the order of a burst."""
        lights = [label.light for label in self.bursts[0].labels if label]
        return np.array([light.id for light in lights if isinstance(light, Led)], np.int64)

    @property
    def leds_taken_twice(self) -> list[int]:
        """Ids of the LEDs that may be lit once more at one exposure."""
        again = [burst for burst in self.bound if burst.repeat]
        return sorted({int(led) for burst in again for led in burst.table["led"][burst.is_light()]})

    def burst(self, exposure: int, repeat: int = 0) -> Burst:
        """Return the burst of all LEDs. Raises KeyError for an exposure or repeat that the plan does not have."""
        for burst in self.bursts:
            if (burst.exposure_index, burst.repeat) == (exposure, repeat):
                return burst
        raise KeyError(f"{self.name}: the plan has no e{exposure}/r{repeat} to choose")

    def burst_of(self, chosen_burst: ChosenBurst) -> Burst:
        """Return the burst of a choice. Raises KeyError if the view has no such burst, time or LED."""
        whole = self.burst(chosen_burst.exposure, chosen_burst.repeat)
        if chosen_burst.exposure_us != whole.timing.exposure_us:
            raise KeyError(
                f"{self.name}: e{chosen_burst.exposure} was chosen as {chosen_burst.exposure_us} us, where the "
                f"run's plan has {whole.timing.exposure_us} us"
            )
        wanted_labels = set(chosen_burst.labels())
        if unknown := wanted_labels - set(whole.labels):
            raise KeyError(f"{self.name}: the plan has no {min(map(str, unknown))} to choose")
        return replace(whole.only(wanted_labels), view=self.name)

    def with_darks(self, choices: Sequence[Choice], choice: Choice) -> Choice:
        """Return the choice with dark frames in the first burst of each exposure, unless earlier `choices` have
        them."""
        with_darks = {burst.exposure for before in choices for burst in before.bursts}
        bursts = []
        for burst in choice.bursts:
            darks = 0 if burst.exposure in with_darks else _darks(self.burst(burst.exposure, burst.repeat))
            bursts.append(burst.model_copy(update={"darks": darks}))
            with_darks.add(burst.exposure)
        return choice.model_copy(update={"bursts": tuple(bursts)})


def _darks(burst: Burst) -> int:
    return sum(label is not None and label.is_dark for label in burst.labels)


class Chooser(Protocol):
    """Chooses the bursts of views. There is one object for a whole plan."""

    def choose(
        self, view: OpenView, choices: Sequence[Choice], samples: Mapping[ShotLabel, FrameSample]
    ) -> Choice:
        """Return the next bursts of a view after these `choices`, all of which have been fired. `samples` has
        their proven frames. A frame of an earlier session is read when it is requested. The same arguments must
        give the same choice, because a resumed run depends on it."""
        ...

    def choose_ahead(
        self, view: OpenView, choices: Sequence[Choice], samples: Mapping[ShotLabel, FrameSample]
    ) -> Choice | None:
        """Return the next bursts while the last of these `choices` is being fired. `samples` has the proven frames
        of the choices before it. None means that its frames are needed; then `choose` is asked. Again, the same
        arguments must give the same choice. It is called in a thread of its own."""
        del view, choices, samples
        return None


def next_choice(
    chooser: Chooser, view: OpenView, choices: Sequence[Choice], samples: Mapping[ShotLabel, FrameSample]
) -> Choice:
    """Return a view's next choice after these, all of which were fired; `samples` has their proven frames. The
    choice is the same as the one that `choose_ahead` gave, or would have given, while the last of these was fired.
    So it does not depend on when a run was interrupted.
    """
    ahead = chooser.choose_ahead(view, choices, before_last(choices, samples)) if choices else None
    return ahead or chooser.choose(view, choices, samples)


def before_last(
    choices: Sequence[Choice], samples: Mapping[ShotLabel, FrameSample]
) -> dict[ShotLabel, FrameSample]:
    """Return the samples of all choices but the last."""
    labels = (label for choice in choices[:-1] for burst in choice.bursts for label in burst.labels())
    return {label: samples[label] for label in labels if label in samples}


def bound_of(whole: Sequence[Burst], frames_of_light: int, again: Collection[int]) -> tuple[Burst, ...]:
    """Return the bound of a view whose bursts are chosen from `whole` (shortest exposure first). The bound has the
    `frames_of_light` longest bursts with all LEDs. It has the two longest of these once more, with the LEDs
    `again`. The bound also has marks and dark frames for all further bursts that a view may have.
    """
    in_first = [burst for burst in whole if burst.repeat == 0]
    longest = in_first[-1]
    bursts = in_first[-frames_of_light:]
    for burst in [burst for burst in whole if burst.repeat == 1][-2:]:
        bursts.append(burst.only({ShotLabel(Led(led), burst.exposure_index, 1) for led in again}))
    darks = {label for label in longest.labels if label and label.is_dark}
    for number in range(MOST_BURSTS - len(bursts)):
        shorter_burst = (
            in_first[-frames_of_light - 1 - number] if number < len(in_first) - frames_of_light else None
        )
        marks = longest.only(darks if shorter_burst else set())
        if shorter_burst is not None:
            labels = tuple(
                ShotLabel(label.light, shorter_burst.exposure_index, 0) if label else None
                for label in marks.labels
            )
            marks = replace(marks, labels=labels, exposure_index=shorter_burst.exposure_index)
        bursts.append(marks)
    return tuple(bursts)


def bound_of_lights(whole: Burst, sizes: Iterable[int]) -> tuple[Burst, ...]:
    """Return the bound of a view whose LEDs are chosen among the LEDs of the burst `whole`. It has the first LEDs
    of `whole`, in bursts of these sizes."""
    labels = [label for label in whole.labels if label and label.is_shot]
    darks = {label for label in whole.labels if label and label.is_dark}
    bursts, begin = [], 0
    for size in sizes:
        if part := labels[begin : begin + size]:
            bursts.append(whole.only({*part, *(darks if begin == 0 else ())}))
        begin += size
    return tuple(bursts)


def refuse_beyond(bound: Sequence[Burst], bursts: Sequence[Burst]) -> None:
    """Raise RuntimeError if `bursts`, all chosen bursts of a view, exceed its bound, which preflight has checked.
    The chosen bursts must not be more, have more frames, or light LEDs for longer than the bound. The LEDs are
    compared in the order of their times.
    """
    allowed_us = sorted(_on_us(bound).values(), reverse=True)
    asked_us = sorted(_on_us(bursts).items(), key=lambda item: -item[1])
    allowed_us += [0] * (len(asked_us) - len(allowed_us))
    too_long = {led for (led, on_us), most_us in zip(asked_us, allowed_us, strict=False) if on_us > most_us}
    frames = sum(label is not None for burst in bursts for label in burst.labels)
    allowed_frames = sum(label is not None for burst in bound for label in burst.labels)
    if too_long or frames > allowed_frames or len(bursts) > len(bound):
        raise RuntimeError(
            f"{bound[0].view}: {len(bursts)} bursts with {frames} frames were chosen, where preflight has "
            f"checked {len(bound)} with {allowed_frames}; LEDs that would be lit for longer: "
            f"{sorted(too_long)[:5]}"
        )


def _on_us(bursts: Iterable[Burst]) -> Counter[int]:
    on_us: Counter[int] = Counter()
    for burst in bursts:
        for step in np.flatnonzero(burst.is_light()):
            on_us[int(burst.table["led"][step])] += int(burst.table["on_us"][step])
    return on_us
