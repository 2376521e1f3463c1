"""The promises of docs/reference/safety.md hold in every state that the model of supervision can reach, and each
is broken by a model that is wrong on purpose."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from supervision_model import (
    ALLOWED,
    AT_ONCE,
    ATTENTION,
    BRAKES,
    DELAY_LIMIT,
    FROZEN,
    LATE,
    LEFT,
    MADE_SAFE,
    MOVES,
    RUNS,
    STANDS,
    SUSPENDED,
    WAITED_FOR,
    WATCHDOG,
    State,
    search,
)


def acts(now: State) -> bool:
    """A lamp is lit or the arm moves, and not by a command that was stuck in a call that was given up."""
    return (now.lamps or now.arm == MOVES) and not now.stuck


PROMISES: dict[str, Callable[[State], bool]] = {
    "The supervising thread has checked a moving arm within 0.1 s and a cycle, or the arm brakes": (
        lambda now: now.arm != MOVES or now.unwatched <= ATTENTION + 1 or now.unanswered > 0
    ),
    "An arm that is not answered brakes within the controller's limit": (
        lambda now: now.arm != MOVES or now.unanswered <= DELAY_LIMIT
    ),
    "Once the controller has ended RSI, nothing moves the arm, whichever process continues": lambda now: (
        not (now.lost and now.arm == MOVES)
    ),
    "Lamps are dark when the session has not spoken to the box for the watchdog's time": (
        lambda now: not now.lamps or now.unspoken <= WATCHDOG
    ),
    "After a freeze that needs a confirmation, or Ctrl-Z, nothing moves or is lit before a person confirms": (
        lambda now: not (now.owed and now.since >= AT_ONCE and acts(now))
    ),
    "A confirmation does not end a pause while the cell is still being made safe, or before the session has "
    "paused": (lambda now: now.pause or not (now.held or now.halting)),
    "After a stop nothing moves and no lamp is lit": (
        lambda now: not (now.stop and now.since >= AT_ONCE and acts(now))
    ),
    "After a call was given up nothing moves and no lamp is lit": (
        lambda now: now.given_up == WAITED_FOR or not (now.since >= AT_ONCE and acts(now))
    ),
    "A motion that is checked in time is never ended by the watch": lambda now: not now.false_lapse,
    "Ctrl-Z stops the process when all is safe; only an action that was allowed before the pause may follow": (
        lambda now: now.signals != SUSPENDED or not (now.lamps or now.arm == MOVES) or now.slipped or now.unsure
    ),
}

ATTENDED, ANSWERED, OVER, DARK, ASKED, WORD, STOPPED, GIVEN_UP, TRUE_LAPSE, SUSPENDS = PROMISES

WRONG = {
    "asks whether its parent lives": ATTENDED,
    "signals beat": ATTENDED,
    "RSI has no delay limit": ANSWERED,
    "a thawed process goes on": OVER,
    "pulse feeds the box": DARK,
    "nobody hears SIGCONT": ASKED,
    "a word while it is made safe": WORD,
    "a word before it stands": WORD,
    "stop is for the thread that sleeps": STOPPED,
    LATE: GIVEN_UP,
    "beats once": TRUE_LAPSE,
    "suspends first": SUSPENDS,
}
"""What is wrong, and what it breaks."""


SAFETY = Path(__file__).parents[2] / "docs/reference/safety.md"


def test_the_promises_are_those_of_the_reference() -> None:
    section = SAFETY.read_text(encoding="utf-8").partition("**Checked by a model.**")[2].partition("\n## ")[0]
    promised = re.findall(r"^\d+\. (.+?)\.$", section, re.MULTILINE)
    assert promised == list(PROMISES)


def broken(now: State) -> bool:
    return not all(holds(now) for holds in PROMISES.values())


def test_every_promise_holds_whichever_part_takes_its_step_first(request: pytest.FixtureRequest) -> None:
    happenings = 4 if request.config.getoption("--full") else 3
    states, way = search(frozenset(), broken, happenings)
    assert not way, "\n".join(way)
    assert states > 100_000


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_variant_breaks_its_promise(wrong: str) -> None:
    _, way = search(frozenset({wrong}), lambda now: not PROMISES[WRONG[wrong]](now), 1)
    print(wrong, *way, sep="\n  ")
    assert way, "the search has not found it"
    assert len(way) < 25


@pytest.mark.parametrize(
    "reached",
    [
        lambda now: now.owed and now.thread == STANDS and not now.pause,
        lambda now: now.slipped and now.lamps,
        lambda now: now.lapsed and now.arm == BRAKES and now.process == RUNS,
        lambda now: now.lost and now.arm == BRAKES,
        lambda now: now.process == FROZEN and now.arm == MOVES,
        lambda now: now.unsure and now.thread == STANDS,
        lambda now: now.thread == ALLOWED and now.held,
        lambda now: now.lamps and now.unspoken == WATCHDOG,
        lambda now: now.given_up == LEFT and now.stuck and now.lamps,
        lambda now: now.given_up == MADE_SAFE and now.thread == ALLOWED and not (now.stuck or now.hangs),
    ],
)
def test_what_the_promises_are_about_is_reached(reached: Callable[[State], bool]) -> None:
    """A search that comes nowhere breaks no promise."""
    assert search(frozenset(), reached, 2)[1]
