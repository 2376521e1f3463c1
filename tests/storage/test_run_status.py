"""The story of a run's sessions: what stopped it, what failed, what is left, and how to go on."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cells
import pytest
from archives import make_run

from coupole.storage.journal import event_line
from coupole.storage.journal_events import (
    BurstBegun,
    BurstEnded,
    Continued,
    Event,
    FaultNoted,
    Paused,
    SessionResumed,
    SessionStarted,
    SessionStopped,
)
from coupole.storage.run import Run
from coupole.storage.run_status import Status, status
from coupole.viewing import report

T = "2026-01-01T00:00:{:06.3f}Z"


def told(run: Run, events: Sequence[Event], *, in_use: bool | None = None) -> Status:
    """Status of a run whose journal has these events, a second apart, before its frames."""
    lines = [line for line in run.journal_path.read_text().splitlines(keepends=True) if '"frame"' in line]
    lines += [event_line(event.model_copy(update={"t": T.format(n)})) for n, event in enumerate(events)]
    run.journal_path.write_text("".join(lines))
    return status(run, in_use=in_use)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return make_run(tmp_path, shots=2, missing=("side/led0001/e0",)).run


STOPPED = SessionStopped(outcome="interrupted", reason="stopped by the operator (SIGINT)")
FAULT = FaultNoted(kind="DeviceLost", message="the box is gone", device="ledbox")


def test_an_operators_stop_is_a_reason_and_no_fault(run: Run) -> None:
    found = told(run, [SessionStarted(), STOPPED])
    assert (found.state, found.reason, found.faults) == ("interrupted", "stopped by the operator (SIGINT)", [])


@pytest.mark.parametrize("set_s", [-7200, 86_400])
def test_a_clock_that_was_set_in_a_session_changes_no_duration_and_is_told(run: Run, set_s: int) -> None:
    begun = datetime(2026, 5, 1, tzinfo=UTC)
    times = [begun, begun + timedelta(seconds=set_s), begun + timedelta(seconds=23 + set_s)]
    events = [SessionStarted(), FAULT, SessionStopped(outcome="done", took_s=23.0)]
    run.journal_path.write_text(
        "".join(
            event_line(event.model_copy(update={"t": t.isoformat()}))
            for event, t in zip(events, times, strict=True)
        )
    )
    (session,) = status(run).sessions
    assert session.duration_s == 23.0
    assert session.clock_set_s == set_s
    page = report.write(run).read_text()
    assert f"the machine&#39;s clock was set by {set_s:+d} s" in page
    assert "23.0 s in 1 session" in page


def test_a_stop_that_version_0_1_noted_as_a_fault_is_none(run: Run) -> None:
    by_operator = FaultNoted(kind="Interrupted", message="stopped by the operator")
    found = told(run, [SessionStarted(), by_operator, SessionStopped(outcome="interrupted")])
    assert (found.reason, found.faults) == ("stopped by the operator", [])
    assert "Nothing went wrong" in report.write(run).read_text()


def test_a_hold_is_no_fault_and_the_reason_until_the_session_goes_on(run: Run) -> None:
    hold = FaultNoted(kind="Held", message="Ctrl-Z: the process stood for 3.0 s")
    held = told(run, [SessionStarted(), hold, Paused()], in_use=True)
    assert (held.state, held.reason, held.holds, held.faults) == ("paused", hold.message, [hold.message], [])
    later = [Continued(), SessionStopped(outcome="done")]
    done = told(run, [SessionStarted(), hold, Paused(), *later])
    assert (done.state, done.reason, done.holds, done.faults) == ("done", "", [hold.message], [])
    page = report.write(run).read_text()
    assert f"held: {hold.message}" in page


def test_a_failure_is_a_fault_and_the_reason(run: Run) -> None:
    found = told(run, [SessionStarted(), FAULT, SessionStopped(outcome="failed")])
    assert (found.state, found.reason, found.faults) == ("failed", "the box is gone", ["the box is gone"])
    page = report.write(run).read_text()
    trouble = page[page.index('id="trouble"') :]
    assert "the box is gone" in trouble[: trouble.index("</section>")]


def test_the_lock_tells_a_session_that_runs_from_one_that_was_killed(run: Run) -> None:
    assert told(run, [SessionStarted()]).state == "interrupted"
    with run.hold_lock():
        assert (status(run).state, status(run).go_on) == ("running", "")
        assert told(run, [SessionStarted(), Paused()]).state == "paused"
    assert "it was killed, or the power failed" in status(run).reason
    assert status(run).go_on == f"coupole acquire --resume {run.folder}"


def test_a_look_at_the_lock_does_not_keep_a_session_out(run: Run) -> None:
    assert not run.in_use
    with run.hold_lock():
        assert run.in_use
    assert not run.in_use


def test_sessions_have_durations_pauses_and_light(run: Run) -> None:
    burst = BurstEnded(view="top", steps=3, on_s=0.5, frames=3)
    events = [SessionStarted(), burst, Paused(), Continued(), STOPPED, SessionResumed(), burst, burst]
    first, second = told(run, events).sessions
    assert (first.duration_s, first.pauses, first.paused_s, first.light_s) == (4.0, 1, 1.0, 0.5)
    assert first.outcome == "interrupted"
    assert (second.duration_s, second.light_s, second.outcome) == (2.0, 1.0, "")


def test_a_report_can_be_made_after_a_crash(run: Run) -> None:
    """Also of a view whose file is damaged; the burst in which a session was killed counts as planned."""
    given = BurstEnded(view="top", steps=3, on_s=0.5, frames=3, given_lux_h=(0.1, 0.25))
    planned = BurstBegun(view="top", planned_lux_h=(0.1, 0.5))
    told(run, [SessionStarted(), planned, given, STOPPED, SessionResumed(), planned])
    run.view_path("top").write_bytes(b"damaged")
    ended = cells.here("report", run.folder, "--json")
    assert ended.code == 0, ended.err
    page = Path(ended.document["report"]).read_text()
    assert "<b class=stopped>interrupted</b>: its last session has no end" in page
    assert "0.750 lux h" in page
    assert "not a view file of a run" in page
    assert f"Take what is left, 1 frame: <code>coupole acquire --resume {run.folder}</code>" in page


def test_a_run_without_copies_is_resumed_with_its_plan_named(run: Run) -> None:
    path = run.folder / "run.json"
    about = json.loads(path.read_text())
    for what in ("plan", "rig"):
        del about[what]["stored"]
    path.write_text(json.dumps(about))
    assert Run(run.folder).go_on_command == f"coupole acquire {about['plan']['path']} --resume {run.folder}"
