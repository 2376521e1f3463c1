"""What the model does, the classes that run in a session do: RSI's session and its shared memory, the attention of
the supervising thread, and Control, led along walks through the model and compared after every step.

One tick is one cycle of RSI, and the clock is the model's.
"""

from __future__ import annotations

import os
import random
import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest
from supervision_model import ASKS, ATTENTION, DEAD, MOVES, RUNS, WATCHES, State, Step, steps
from test_kuka_rsi import CONFIG, HOME_DEG, packet

from coupole import supervision
from coupole.acquisition.noted_devices import NotedDevice
from coupole.acquisition.observer import Control, Held
from coupole.errors import DeviceRefused, Interrupted
from coupole.supervision import Attention
from drivers.kuka.rsi import shared_state
from drivers.kuka.rsi.rsi_session import RsiSession

WALKS, LONGEST = 600, 150
HAPPENINGS, HAPPENS_SELDOM = 5, 0.15
CYCLE_NS = 4_000_000
FAR_DEG = 170.0
"""No motion arrives within a walk."""
STOPS = ("is held", "leaves", "finds it braked", "makes safe")
ANSWERS = {f"answering: {done}" for done in ("answers", "nobody looks", "has no parent", "is over")}


class Implementation:
    """The real parts of one session, without sockets and processes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns = CYCLE_NS
        monkeypatch.setattr(supervision, "time", SimpleNamespace(monotonic_ns=lambda: self.now_ns))
        memory = os.memfd_create("model")
        os.truncate(memory, shared_state.BLOCK_BYTES)
        self.driver, self.loop = shared_state.Block(memory), shared_state.Block(memory)
        os.close(memory)
        self.control, self.attention = Control(can_stand=True), Attention()
        config = replace(CONFIG, attention_s=ATTENTION * CYCLE_NS / 1e9, delay_limit=1)
        self.session = RsiSession(config)
        self.made_safe, no_rig = threading.Event(), cast("Any", None)
        box = SimpleNamespace(start=lambda: None)
        self.box = NotedDevice(box, "ledbox", no_rig, self.made_safe)
        self.number, self.ipoc, self.heard_ipoc = 0, 1000, 1000
        self.session.answer(packet(self.ipoc), self.now_ns)

    def send(self, verb: int) -> None:
        self.number += 1
        far_deg = -FAR_DEG if self.session.motion.commanded_deg[0] > 0.0 else FAR_DEG
        self.driver.write_command(shared_state.Command(self.number, verb, (far_deg, *HOME_DEG[1:])))

    def may_command(self) -> str:
        try:
            self.control.go_on()
        except (Held, Interrupted) as no:
            return type(no).__name__
        return ""

    def thread(self, what: str, before: State) -> None:
        if before.thread in (ASKS, WATCHES):
            assert self.may_command() == ("Interrupted" if before.stop else "Held" if before.held else "")
        if what == "stands":
            self.control.hold_pending.clear()
        elif what == "moves the arm":
            self.driver.write_looked(self.attention.begin())
            self.send(shared_state.MOVE)
        elif what == "is refused":
            with pytest.raises(DeviceRefused):
                self.box.start()
        elif what == "lights lamps" and not before.stuck:
            self.box.start()
        elif what == "looks" and (looked_ns := self.attention.look()):  # None before the first motion
            self.driver.write_looked(looked_ns)

    def signals(self, what: str) -> None:
        if what == "hears Ctrl-C":
            self.control.stop_by(2)
        elif what.startswith("hears"):
            self.control.halting.set()
            self.control.hold(what)
        elif what == "knows":
            self.control.halting.clear()

    def main(self, what: str) -> None:
        if what == "makes safe":
            self.made_safe.set()

    def person(self, what: str, *, by_key: bool) -> None:
        if what == "pauses":
            self.control.pause.set()
        elif what == "lets it go on":
            (self.control.toggle_pause if by_key else self.control.let_go_on)()

    def answering(self, what: str) -> None:
        """The body of `drivers.kuka.rsi.loop.serve`."""
        if self.loop.command_number() != self.session.command:
            self.session.obey(self.loop.read_command())
        self.session.attend(self.now_ns - self.loop.looked_ns())
        missed = (self.ipoc - self.heard_ipoc) // 4 - 1
        self.heard_ipoc = self.ipoc
        delay = self.session.delay + max(0, missed)
        self.session.answer(packet(self.ipoc, self.session.motion.commanded_deg, delay), self.now_ns)
        if what == "has no parent":
            self.session.leave()

    def time_passes(self) -> None:
        self.now_ns += CYCLE_NS
        self.ipoc += 4

    def follow(self, what: str, before: State, *, by_key: bool) -> None:
        part, _, done = what.partition(": ")
        if part == "thread":
            self.thread(done, before)
        elif part == "signals":
            self.signals(done)
        elif part == "person":
            self.person(done, by_key=by_key)
        elif part == "main":
            self.main(done)
        elif what in ANSWERS:
            self.answering(done)
        elif part == "time passes":
            self.time_passes()
        if done in STOPS:
            self.send(shared_state.STOP)

    def compare(self, what: str, now: State, lapses: int) -> None:
        control, session = self.control, self.session
        found = (
            control.stop.is_set(),
            control.pause.is_set(),
            control.hold_pending.is_set(),
            control.halting.is_set(),
        )
        assert found == (now.stop, now.pause, now.held, now.halting)
        if what in ANSWERS:
            assert session.motion.pursues == (now.arm == MOVES)
            assert session.lapses == lapses or now.lost
            assert (session.fault == shared_state.LATE) == now.lost

    def hears_no_word(self, now: State) -> None:
        """A person says that it goes on where the model does not let that count."""
        if now.process == RUNS and now.pause and all(what != "person: lets it go on" for what, _ in steps(now)):
            for word in (self.control.let_go_on, self.control.toggle_pause):
                word()
                assert self.control.pause.is_set(), "a word ended a hold"


def drawn(now: State, draw: random.Random) -> Step | None:
    """The next step; happenings are seldom, so that much is done between them."""
    possible = [step for step in steps(now) if step[0] != "arm: arrives"]
    usual = [step for step in possible if step[1].spared == now.spared]
    happens = not usual or draw.random() < HAPPENS_SELDOM
    return draw.choice(possible if happens else usual) if possible else None


def walk(draw: random.Random, parts: Implementation, way: list[str]) -> None:
    now, lapses = State(spared=HAPPENINGS), 0
    while len(way) < LONGEST and (step := drawn(now, draw)):
        what, then = step
        way.append(what)
        lapses += what == "answering: nobody looks"
        parts.follow(what, now, by_key=draw.random() < 0.5)
        parts.compare(what, then, lapses)
        parts.hears_no_word(then)
        now = then
        if now.answering == DEAD:
            return


def test_the_parts_that_run_follow_every_walk_through_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: set[str] = set()
    for seed in range(WALKS):
        way: list[str] = []
        try:
            walk(random.Random(seed), Implementation(monkeypatch), way)
        except AssertionError as error:
            raise AssertionError(f"walk {seed}: " + " | ".join(way)) from error
        taken |= set(way)
    assert taken >= MUST_BE_TAKEN


MUST_BE_TAKEN = {
    *ANSWERS,
    "person: lets it go on",
    "signals: hears it was to continue",
    "signals: hears it was to suspend",
    "signals: hears Ctrl-C",
    "thread: stands",
    "thread: goes on",
    "thread: finds it braked",
    "thread: is held",
    "thread: is refused",
    "main: makes safe",
}
