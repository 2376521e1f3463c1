"""Refusals of exports whose frames were discarded (`discard: after_fit`), before anything is written."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence

from coupole.errors import FrameDiscarded
from coupole.plan.shot_id import Led, ShotId
from coupole.storage.discarding import discarded_views, place_of_result
from coupole.storage.run import Run

Remedy = Callable[[Sequence[ShotId]], str]
"""Function of the shots whose frames are kept. It returns a sentence that says what can be exported instead."""


def refuse_discarded(run: Run, shots: Collection[ShotId], remedy: Remedy) -> None:
    """Raise FrameDiscarded if the frames of some of these shots were discarded."""
    events = discarded_views(run)
    gone_shots = {shot for event in events.values() for shot, _ in event.frames}
    matching_shots = [shot for shot in shots if shot in gone_shots]
    if not matching_shots:
        return
    result = place_of_result(run, events[matching_shots[0].view])
    raise FrameDiscarded(
        f"{run.folder}: {len(matching_shots)} of the {len(shots)} frames that are needed, such as "
        f"{matching_shots[0]}, were discarded when their samples were safe, as the plan said (`discard: "
        f"after_fit`). Nothing was written. {remedy([shot for shot in shots if shot not in gone_shots])}"
        f"`coupole export {result}` exports the result that was made of the samples"
    )


def refuse_discarded_lights(run: Run, views: Iterable[str], to: str) -> None:
    """Raise FrameDiscarded if frames of these views under single LEDs were discarded, because formats that show a
    view under all its LEDs need all of them."""
    names = set(views)
    shots = [shot for shot in run.proven() if shot.view in names and isinstance(shot.light, Led)]
    refuse_discarded(run, shots, lambda _: f"--to {to} needs the frames of all LEDs. ")
