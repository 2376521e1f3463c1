"""The bursts of each view: the bursts of the plan, or the bursts that are chosen in the run
(`coupole.plan.choices`)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from coupole.acquisition.recorder import Recorder
from coupole.bounded import Workers
from coupole.plan import schedule
from coupole.plan.bursts import Burst
from coupole.plan.choices import (
    Choice,
    FrameSample,
    OpenView,
    before_last,
    has_enough,
    next_choice,
    refuse_beyond,
)
from coupole.plan.schedule import chosen_bursts
from coupole.plan.shot_id import ShotId, ShotLabel
from coupole.preflight.checking import LED_DUTIES
from coupole.preflight.choosers import chooser_of
from coupole.preflight.job import Job
from coupole.preflight.led_limits import BoardHeat
from coupole.storage.journal_events import BurstsChosen


@dataclass(frozen=True)
class _Next:
    """The next bursts of a view, and the heat of the boards after them."""

    choice: Choice
    bursts: list[Burst]
    boards: BoardHeat


class BurstsOfViews:
    """Bursts that each view of a job still gets. Views are named by their numbers in the job's schedule. Only one
    thread calls the methods."""

    def __init__(self, job: Job, recorder: Recorder) -> None:
        self._job, self._recorder = job, recorder
        self._chooser = chooser_of(job)
        self._choices: dict[str, list[Choice]] = {view: list(choices) for view, choices in job.choices.items()}
        self._open_views: dict[int, OpenView] = {}
        self._frames: dict[int, int] = {}
        """Frames of each view, as far as they are chosen."""
        self._boards = BoardHeat(job.cell.rig.led_limits, job.cell.leds)
        """Heat of the boards after the session's chosen bursts. Moves and waits, in which the boards cool, are not
        counted."""
        self._thinker = Workers(1, "choice")
        self._choice_ahead: Future[_Next | None] | None = None
        """The choice that is made while a burst is fired; None if there is none."""
        self._ahead: list[Burst] = []
        """Bursts that were chosen and noted while the last ones were fired."""
        self._taken_views: set[str] | None = (
            {choice.view for choice in job.chosen_views} if job.plan.chooses_views else None
        )
        """Names of the views that are taken, if views are chosen in the run; None if all are taken."""
        recorder.sample_frames(is_wanted=self._chooser is not None)

    def take(self, view: str) -> None:
        """Note that a view is taken, by its name, if views are chosen in the run."""
        if self._taken_views is not None:
            self._taken_views.add(view)
            self._frames.clear()

    def schedule_so_far(self) -> schedule.Schedule:
        """Return the job's schedule, with the chosen bursts in views that have enough."""
        whole = self._job.schedule
        return whole if self._chooser is None else whole.with_choices(self._choices)

    def is_taken(self, number: int) -> bool:
        """True if a view is taken, as far as this is known."""
        return self._taken_views is None or self._job.schedule.views[number].name in self._taken_views

    def bursts(self, number: int) -> tuple[Burst, ...]:
        """All bursts of a view, as far as they are known; none of a view that is not taken."""
        if not self.is_taken(number):
            return ()
        if self._chooser is None:
            return self._job.schedule.bursts[number]
        return chosen_bursts(self._open_view(number), self._choices_of(number))

    def bursts_left(self, number: int) -> list[Burst]:
        """Return the bursts with unproven frames. The bursts contain only unproven frames."""
        return schedule.bursts_left(self.bursts(number), self._recorder.proven())

    def may_want_more(self, number: int) -> bool:
        """True if more bursts may be chosen."""
        return self._chooser is not None and self.is_taken(number) and not has_enough(self._choices_of(number))

    def bound(self, number: int) -> tuple[Burst, ...]:
        """Return bursts that cost at least as much as all bursts of a view."""
        return self._job.schedule.bursts[number] if self.may_want_more(number) else self.bursts(number)

    def expected_frames(self, number: int) -> int:
        """Return the frames that a view gets, as far as this is known. If nothing is chosen yet, it is one frame
        for each LED, and marks."""
        if self._chooser is None or self._choices_of(number) or not self.is_taken(number):
            return self._frames.get(number) or self._frames.setdefault(number, _frames(self.bursts(number)))
        return len(self._open_view(number).burst(0).labels)

    def slots(self, number: int) -> int:
        """Frames that a view's file must have room for."""
        return _frames(self.bound(number))

    def think_ahead(self, number: int) -> None:
        """Begin to choose, in another thread, the bursts that follow the last chosen bursts of a view; these are
        about to be fired.
        """
        if (
            self._chooser is None
            or self._choice_ahead is not None
            or self._ahead
            or not self.may_want_more(number)
        ):
            return
        choices = tuple(self._choices_of(number))
        if choices:
            view = self._open_view(number)
            samples = before_last(choices, _Seen(view.name, choices, self._recorder))
            self._choice_ahead = self._thinker.submit(self._next_ahead, view, choices, samples)

    def following(self, number: int) -> Burst | None:
        """Return the first burst of the choice that `think_ahead` has begun, once it is made. The choice is on
        the disk when this returns. None if the choice is not made yet, or can only be made after the last chosen
        bursts.
        """
        if self._choice_ahead is not None and self._choice_ahead.done() and self._choice_ahead.exception() is None:
            following, self._choice_ahead = self._choice_ahead.result(), None
            self._ahead = self._note(number, following) if following else []
        return self._ahead[0] if self._ahead else None

    def more(self, number: int) -> list[Burst]:
        """Return the next bursts of a view, after all its known bursts were fired; none if the view has enough.
        The choice is on the disk when this returns. Raises RuntimeError if it exceeds the view's bound."""
        if self._choice_ahead is not None:
            future, self._choice_ahead = self._choice_ahead, None
            following = future.result()
            self._ahead = self._note(number, following) if following else []
        if self._ahead:
            bursts, self._ahead = self._ahead, []
            return bursts
        if self._chooser is None or not self.may_want_more(number):
            return []
        view, choices = self._open_view(number), tuple(self._choices_of(number))
        choice = next_choice(self._chooser, view, choices, _Seen(view.name, choices, self._recorder))
        return self._note(number, self._bursts_of(view, choices, choice))

    def end(self) -> None:
        """End the thread that chooses, once it is done. Does not wait for it."""
        self._thinker.end_soon()

    def _next_ahead(
        self, view: OpenView, choices: Sequence[Choice], samples: Mapping[ShotLabel, FrameSample]
    ) -> _Next | None:
        assert self._chooser is not None
        choice = self._chooser.choose_ahead(view, choices, samples)
        return None if choice is None else self._bursts_of(view, choices, choice)

    def _bursts_of(self, view: OpenView, choices: Sequence[Choice], choice: Choice) -> _Next:
        """Return the bursts of a choice. Raises RuntimeError if they exceed the view's bound."""
        choice = view.with_darks(choices, choice)
        bursts = [view.burst_of(burst) for burst in choice.bursts]
        refuse_beyond(view.bound, [*chosen_bursts(view, choices), *bursts])
        return _Next(choice, *self._cool(bursts))

    def _note(self, number: int, following: _Next) -> list[Burst]:
        """Bring a choice to the disk; return its bursts."""
        view, choice = self._open_view(number), following.choice
        self._recorder.note(
            BurstsChosen(view=view.name, bursts=choice.bursts, reason=choice.reason, figures=choice.figures)
        )
        self._recorder.commit(now=True)
        self._choices_of(number).append(choice)
        self._frames.pop(number, None)
        self._boards = following.boards
        return following.bursts

    def _open_view(self, number: int) -> OpenView:
        if number not in self._open_views:
            self._open_views[number] = self._job.schedule.open_view(number)
        return self._open_views[number]

    def _choices_of(self, number: int) -> list[Choice]:
        return self._choices.setdefault(self._job.schedule.views[number].name, [])

    def _cool(self, bursts: list[Burst]) -> tuple[list[Burst], BoardHeat]:
        """Return the same bursts, and the heat of the boards after them. The bursts are slowed down if the boards,
        which this session has already heated, would get too hot. Chosen LEDs may all be on one board."""
        for duty in (1.0, *LED_DUTIES):
            cool_bursts, boards = [_at_duty(burst, duty) for burst in bursts], deepcopy(self._boards)
            boards.light(cool_bursts)
            if not boards.heat().too_hot:
                break
        return cool_bursts, boards


def _frames(bursts: Iterable[Burst]) -> int:
    return sum(len(burst.labels) for burst in bursts)


def _at_duty(burst: Burst, duty: float) -> Burst:
    """Return the burst with its LEDs lit for at most this share of a step."""
    period_us = int(np.ceil(burst.timing.on_us / duty))
    if period_us <= burst.timing.period_us:
        return burst
    timing = replace(burst.timing, period_us=period_us, bound="heat")
    return replace(burst, timing=timing).only({label for label in burst.labels if label})


class _Seen(Mapping[ShotLabel, FrameSample]):
    """Samples of the proven frames of a view's choices; they are read when they are requested."""

    def __init__(self, view: str, choices: Sequence[Choice], recorder: Recorder) -> None:
        self._view, self._recorder = view, recorder
        proven = recorder.proven()
        chosen_labels = (label for choice in choices for burst in choice.bursts for label in burst.labels())
        self._labels = dict.fromkeys(label for label in chosen_labels if ShotId(view, label) in proven)

    def __getitem__(self, label: ShotLabel) -> FrameSample:
        if label not in self._labels:
            raise KeyError(str(label))
        return self._recorder.sample(ShotId(self._view, label))

    def __iter__(self) -> Iterator[ShotLabel]:
        return iter(self._labels)

    def __len__(self) -> int:
        return len(self._labels)
