"""Who lets the arm move and lamps shine, as a small machine that is searched whole.

The parts are those of `coupole.supervision`: the session's process with its supervising thread and its thread of
signals, the process that answers the arm, the arm's controller, the box with its watchdog, a person, and whatever
freezes, hangs or kills. Any part may take its next step before any other; `time passes` by one tick only when
each part that runs has had its turn. A thread that is late is one that hangs and returns. The main thread may give
up a call that hangs (`coupole.bounded.run_bounded`): it makes the cell safe, then leaves the thread behind, then
ends the process. The call may return at any moment meanwhile.

Times are ticks. The attention is `ATTENTION` of them; the others are as short as their order allows, since only
the order decides: a look < attention < a freeze that asks < the box's watchdog.

EKI's program on its controller, and ur-rtde's process with UR's program, are the answering process here: the same
rules hold for all three, carried otherwise.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

from coupole.supervision import ASKS_FROM_S, ATTENTION_S, HEARD_WITHIN_S, LOOK_S

assert LOOK_S < ATTENTION_S < HEARD_WITHIN_S < ASKS_FROM_S
ATTENTION, ASKS_FROM, WATCHDOG = 2, 3, 4
DELAY_LIMIT = 1
"""Ticks without an answer after which RSI ends, and its controller brakes."""
AT_ONCE = 4
"""Turns until what was set is obeyed, at the most: of the thread that had been allowed to command before, when it
commands, when it finds itself held, of the process that answers, and the one under way."""

RUNS, FROZEN, DEAD = "runs", "frozen", "dead"
REST, BRAKES, MOVES = "at rest", "brakes", "moves"
STANDS, ASKS, ALLOWED, WATCHES, ENDED = "stands", "asks", "allowed", "watches", "ended"
"""The supervising thread: waits for a person; is about to ask whether it may command; was allowed to; watches
what it commanded; has left."""
IDLE, SUSPENDED = "idle", "suspended"
STOP, MOVE, NOTHING = "stop", "move", ""
WAITED_FOR, MADE_SAFE, LEFT = "waited for", "made safe", "left behind"


class State(NamedTuple):
    process: str = RUNS
    thread: str = ASKS
    hangs: bool = False
    given_up: str = WAITED_FOR
    """The call in which the thread hung, if the main thread has made the cell safe since, and left it behind."""
    answering: str = RUNS
    arm: str = REST
    lamps: bool = False
    order: str = NOTHING
    """A command that the answering process has not taken yet."""
    lost: bool = False
    """The controller has ended RSI, and stopped the arm itself."""
    lapsed: bool = False
    # What Control holds.
    stop: bool = False
    pause: bool = False
    held: bool = False
    halting: bool = False
    unsure: bool = False
    signals: str = IDLE
    """What its thread does: `acts` or `waits` for a hold, Ctrl-Z or a stop."""
    heard: str = ""
    """A signal that it has not taken yet."""
    # Turns of this tick.
    thread_ran: bool = False
    answered: bool = False
    # Ticks since ...
    looked: int = 0
    """... the beat that the answering process knows."""
    mute: int = 0
    """... the controller's last answer."""
    quiet: int = 0
    """... the box heard its last command."""
    frozen: int = 0
    """... the process does not run."""
    # What the parts do not know, and the promises are about.
    unwatched: int = 0
    """Ticks since the supervising thread itself looked."""
    unanswered: int = 0
    unspoken: int = 0
    """Ticks since the session itself spoke to the box: the thread in its turn, or whoever made the cell safe."""
    owed: bool = False
    """A person is to be asked, and has not answered."""
    since: int = 0
    """Ticks, while all runs, since a word is owed or a stop was set."""
    slipped: bool = False
    """A command was allowed before a hold, and came after it."""
    stuck: bool = False
    """A command was given before the cell was made safe, and stuck in the call that was given up."""
    false_lapse: bool = False
    spared: int = 0
    """How much may still happen: freezes, hangs, deaths, signals, pauses. What mends them again is free."""


Step = tuple[str, State]
Rules = frozenset[str]
LATE = "a call that returns late goes on"
"""What is done wrongly on purpose; none in the model itself."""


def steps(now: State, wrong: Rules = frozenset()) -> Iterator[Step]:
    """Every step that some part may take next."""
    if now.process == RUNS:
        if not now.hangs and not now.thread_ran:
            for what, then in thread_steps(now, wrong):
                yield f"thread: {what}", then._replace(thread_ran=True)
        for what, then in signal_steps(now, wrong):
            yield f"signals: {what}", then
        for what, then in person_steps(now, wrong):
            yield f"person: {what}", then
        for what, then in main_steps(now):
            yield f"main: {what}", then
    if now.answering == RUNS and not now.answered:
        what, then = answering_step(now, wrong)
        yield f"answering: {what}", then._replace(answered=True, mute=0, unanswered=0)
    yield from happenings(now, wrong)
    if _all_had_their_turn(now):
        yield "time passes", _later(now, wrong)


def thread_steps(now: State, wrong: Rules) -> Iterator[Step]:
    """The supervising thread: `ArmSupervisor.go`, the bursts, `Sequencer._wait_while_paused`."""
    sent = now.stuck and now.thread == ALLOWED  # nobody can call it back
    if now.given_up == LEFT and now.thread != ENDED and not sent and LATE not in wrong:
        yield "is interrupted", now._replace(thread=ENDED)
    elif now.thread == STANDS:
        yield from _standing(now)
    elif now.thread == ALLOWED and now.given_up != WAITED_FOR and not sent and LATE not in wrong:
        yield "is refused", now._replace(thread=ENDED)
    elif now.thread == ALLOWED:
        begun = _looked(now)._replace(thread=WATCHES, slipped=now.slipped or now.held, looked=0)
        yield "moves the arm", begun._replace(order=MOVE)
        if now.arm == REST and now.order == NOTHING:
            yield "lights lamps", begun._replace(lamps=True)
    elif now.thread != ENDED:
        yield from _asking(now, wrong)


def main_steps(now: State) -> Iterator[Step]:
    """The main thread: `coupole.bounded.run_bounded`."""
    if now.hangs and now.given_up == WAITED_FOR:
        stuck = now.thread == ALLOWED
        yield "makes safe", _safe(now)._replace(given_up=MADE_SAFE, stuck=stuck, since=0)
    elif now.given_up == MADE_SAFE and now.thread != ENDED:
        yield "leaves it behind", now._replace(given_up=LEFT)
    elif now.given_up == LEFT:
        yield "ends the process", now._replace(process=DEAD)


def _standing(now: State) -> Iterator[Step]:
    if now.halting:
        yield "waits until all is safe", now
    if now.held:
        yield "stands", now._replace(held=False)
    elif now.stop or (now.unsure and not now.halting):
        yield "leaves", _safe(now)._replace(thread=ENDED)
    elif not now.halting:
        yield ("stands still", now) if now.pause else ("goes on", now._replace(thread=ASKS))


def _asking(now: State, wrong: Rules) -> Iterator[Step]:
    """`Control.go_on`, before a command and in each turn of a motion or a burst."""
    stops = now.stop and "stop is for the thread that sleeps" not in wrong
    if stops or now.lost or now.answering == DEAD:
        yield "leaves", _safe(now)._replace(thread=ENDED)
    elif now.held or (now.pause and now.thread == ASKS):
        yield "is held", _safe(now)._replace(thread=STANDS)
    elif now.thread == ASKS:
        yield "may command", now._replace(thread=ALLOWED, lapsed=False)
    elif now.lapsed:
        yield "finds it braked", _safe(now)._replace(thread=ASKS)
    elif now.lamps or now.arm != REST or now.order:
        looked = _looked(now)
        yield "looks", looked._replace(looked=now.looked) if "beats once" in wrong else looked
    if now.thread == WATCHES and (now.lamps or (now.arm == REST and now.order == NOTHING)):
        yield "is done", now._replace(thread=ASKS, lamps=False)


def _looked(now: State) -> State:
    return now._replace(unwatched=0, looked=0, quiet=0, unspoken=0)


def _safe(now: State) -> State:
    """Lights off and the arm commanded to stop."""
    return now._replace(order=STOP, lamps=False, quiet=0, unspoken=0)


def signal_steps(now: State, wrong: Rules) -> Iterator[Step]:
    """The thread of signals: `coupole.acquisition.signals`."""
    if now.signals == IDLE and now.heard:
        if now.heard == "stop":
            yield "hears Ctrl-C", now._replace(stop=True, since=0, heard="", signals="acts: stop")
        elif now.heard == "continue" and "nobody hears SIGCONT" in wrong:
            yield "hears nothing", now._replace(heard="")
        elif now.heard == "suspend" and "suspends first" in wrong:
            yield "suspends", _suspended(now._replace(held=True, pause=True, heard=""))
        else:
            held = now._replace(halting=True, held=True, pause=True, heard="")
            yield f"hears it was to {now.heard}", held._replace(signals=f"acts: {now.heard}")
    elif now.signals.startswith("acts"):
        then = IDLE if now.signals == "acts: stop" else now.signals.replace("acts", "waits")
        yield "makes safe", _safe(now)._replace(signals=then)
    elif now.signals.startswith("waits"):
        safe = (now.arm == REST and now.order != STOP) or now.lost
        if safe or now.answering != RUNS:
            told = now._replace(halting=False, signals=IDLE, unsure=not safe)
            yield "knows", _suspended(told) if now.signals.endswith("suspend") else told
    if "signals beat" in wrong and now.looked:
        yield "beats for the thread", now._replace(looked=0)
    if "pulse feeds the box" in wrong and now.quiet:
        yield "speaks to the box", now._replace(quiet=0)


def _suspended(now: State) -> State:
    return now._replace(process=FROZEN, signals=SUSPENDED, owed=True, since=0)


def person_steps(now: State, wrong: Rules) -> Iterator[Step]:
    """A person's word: key p, `coupole go-on`; see `Control.let_go_on`."""
    if not now.pause:
        return
    if now.halting and "a word while it is made safe" not in wrong:
        return
    if now.held and not now.halting and "a word before it stands" not in wrong:
        return
    answers = now.thread == STANDS and not now.held
    yield "lets it go on", now._replace(pause=False, owed=now.owed and not answers)


def answering_step(now: State, wrong: Rules) -> Step:
    """One packet: `drivers.kuka.rsi.loop.serve`. A command, then the watch, then the answer."""
    if now.lost and "a thawed process goes on" not in wrong:
        return "is over", now._replace(arm=REST, order=NOTHING)
    brakes = REST if now.arm == REST else BRAKES
    if now.process == DEAD:
        return "has no parent", now._replace(order=NOTHING, arm=REST if now.arm == BRAKES else brakes)
    arm = {STOP: brakes, MOVE: MOVES, NOTHING: REST if now.arm == BRAKES else now.arm}[now.order]
    now = now._replace(order=NOTHING)
    if arm == MOVES and now.looked > ATTENTION and "asks whether its parent lives" not in wrong:
        false = now.false_lapse or now.unwatched <= ATTENTION
        return "nobody looks", now._replace(arm=BRAKES, lapsed=True, false_lapse=false)
    return "answers", now._replace(arm=arm)


def happenings(now: State, wrong: Rules) -> Iterator[Step]:
    """What befalls the parts, as often as it is spared; the arm arrives, too."""
    less = now._replace(spared=now.spared - 1)
    if now.arm == MOVES and now.answering == RUNS and not now.lost:
        yield "arm: arrives", now._replace(arm=REST)
    if now.hangs and now.process == RUNS:
        yield "thread: returns", now._replace(hangs=False)
    if now.process == FROZEN:
        yield "process: goes on", _thawed(now)
    if now.answering == FROZEN:
        yield "answering: goes on", now._replace(answering=RUNS)
    if not now.spared:
        return
    if now.process == RUNS:
        yield "process: freezes", less._replace(process=FROZEN)
        yield "process: is killed", less._replace(process=DEAD)
        if now.thread in (WATCHES, ASKS, ALLOWED) and not now.hangs:
            yield "thread: hangs", less._replace(hangs=True)
        if not now.pause:
            yield "person: pauses", less._replace(pause=True)
        if not now.stop and not now.heard:
            yield "person: Ctrl-C", less._replace(heard="stop")
            yield "person: Ctrl-Z", less._replace(heard="suspend")
    if now.answering == RUNS:
        yield "answering: freezes", less._replace(answering=FROZEN)
        yield "answering: is killed", less._replace(answering=DEAD)


def _thawed(now: State) -> State:
    """The process runs again. Of a long freeze the thread of signals hears (SIGCONT)."""
    heard, signals = now.heard, now.signals
    if signals == SUSPENDED:
        signals = IDLE
    elif now.frozen >= ASKS_FROM and not heard:
        heard = "continue"
    owed = now.owed or now.frozen >= ASKS_FROM
    return now._replace(process=RUNS, frozen=0, signals=signals, heard=heard, thread_ran=False, owed=owed, since=0)


def _all_had_their_turn(now: State) -> bool:
    if now.answering == RUNS and not now.answered:
        return False
    if now.process != RUNS:
        return True
    busy = bool(now.heard) if now.signals == IDLE else now.signals.startswith("acts")
    return not busy and (now.hangs or now.thread_ran or now.thread == ENDED)


def _later(now: State, wrong: Rules) -> State:
    all_run = now.process == now.answering == RUNS and not now.hangs
    then = now._replace(
        thread_ran=False,
        answered=False,
        looked=min(now.looked + 1, ATTENTION + 2),
        unwatched=min(now.unwatched + 1, ATTENTION + 3),
        mute=min(now.mute + 1, DELAY_LIMIT + 1),
        unanswered=min(now.unanswered + 1, DELAY_LIMIT + 2),
        quiet=min(now.quiet + 1, WATCHDOG + 1),
        unspoken=min(now.unspoken + 1, WATCHDOG + 2),
        frozen=min(now.frozen + 1, ASKS_FROM) if now.process == FROZEN else 0,
        since=min(now.since + 1, AT_ONCE) if all_run else 0,
    )
    if now.lost:
        then = then._replace(arm=REST if now.arm == BRAKES else now.arm)
    elif then.mute > DELAY_LIMIT and "RSI has no delay limit" not in wrong:
        then = then._replace(lost=True, arm=REST if now.arm == REST else BRAKES)
    if then.quiet > WATCHDOG:
        then = then._replace(lamps=False)
    return then


def told_apart(now: State) -> State:
    """The state without what no rule and no promise can see any more; two that differ in it alone are one."""
    if now.process == DEAD or (now.thread == ENDED and now.signals == IDLE):
        now = State(DEAD, ENDED, **{name: getattr(now, name) for name in _OUTLIVES})
    unseen: dict[str, int] = {}
    if now.arm == REST and now.order != MOVE:
        unseen |= _UNSEEN_AT_REST
    if not now.lamps:
        unseen |= _UNSEEN_IN_THE_DARK
    if now.lost:
        unseen |= _UNSEEN_WHEN_LOST if now.arm == REST else {"mute": 0}
    if now.since and not (now.owed or now.stop or now.given_up != WAITED_FOR):
        unseen["since"] = 0
    if now.slipped and not now.held and now.signals != SUSPENDED:
        unseen["slipped"] = False
    if now.thread_ran and now.process == FROZEN:
        unseen["thread_ran"] = False
    return now._replace(**unseen) if unseen else now


_UNSEEN_AT_REST, _UNSEEN_IN_THE_DARK = {"looked": 0, "unwatched": 0}, {"quiet": 0, "unspoken": 0}
_UNSEEN_WHEN_LOST = {"mute": 0, "unanswered": 0}
_OUTLIVES = ("answering", "arm", "lamps", "order", "lost", "answered", "looked", "mute", "quiet", "unwatched")
_OUTLIVES += ("unanswered", "unspoken", "false_lapse", "spared")


def search(wrong: Rules, broken: Callable[[State], bool], spared: int) -> tuple[int, list[str]]:
    """Number of states until all are known, or until one is `broken`, and then the shortest way there."""
    begin = State(spared=spared)
    came: dict[State, tuple[State, str] | None] = {begin: None}
    waiting = deque([begin])
    while waiting:
        now = waiting.popleft()
        if broken(now):
            return len(came), _way_to(now, came)
        for what, step in steps(now, wrong):
            if (then := told_apart(step)) not in came:
                came[then] = now, what
                waiting.append(then)
    return len(came), []


def _way_to(now: State, came: dict[State, tuple[State, str] | None]) -> list[str]:
    way = []
    while (before := came[now]) is not None:
        now, what = before
        way.append(what)
    return way[::-1]
