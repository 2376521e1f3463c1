"""Light, time, calibrations, trouble and the technical tables of a run, as sections of its report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

from coupole.calibration.record import read_record
from coupole.errors import InputError
from coupole.pages.page_parts import Code, Inline, Link, Moment, Section, Table, Verdict
from coupole.storage import run_dose
from coupole.storage.journal_events import (
    BurstBegun,
    BurstEnded,
    BurstsChosen,
    Event,
    FaultNoted,
    FindingNoted,
    GapFound,
    SessionStopped,
    ViewChosen,
)
from coupole.storage.run import Run
from coupole.storage.run_status import KILLED, Session, Status
from coupole.viewing.run_sample import SampledView
from coupole.viewing.terminal import bytes_text, duration_text

_MOST_LINES = 30
"""Greatest number of lines of trouble. The other lines are only counted."""
_STOPPED_IN_0_1 = "Interrupted"
_CLOCK_SET_S = 5.0
"""Smaller differences of the machine's clock are ordinary corrections of the clock."""


def sign_of(state: str) -> Literal["ok", "stopped", "bad"]:
    """The colour of a run's state."""
    return "ok" if state == "done" else "bad" if state == "failed" else "stopped"


def light_in_words(run_status: Status, budget_lux_h: float | None) -> str:
    """Return the light of all sessions; for a burst whose end was not recorded, the planned light counts."""
    light_s = sum(session.light_s for session in run_status.sessions)
    budget = f" (the object may receive {budget_lux_h:g} in its life)" if budget_lux_h else ""
    return f"{run_status.dose_lux_h:.3f} lux h{budget}, LEDs on for {light_s:.1f} s"


def light(events: Sequence[Event], views: Iterable[SampledView], run_status: Status) -> Section:
    """Return the dose by view, at the point of the object that received most."""
    total = run_dose.lux_h_of_points(events)
    if not total:
        words = "The journal has no entry of light: it was not recorded, or no light was given."
        return Section("light", "Light on the object", notes=[words])
    point = total.index(max(total))
    rows = []
    for view in views:
        of_view = [e for e in events if isinstance(e, BurstBegun | BurstEnded) and e.view == view.name]
        lux_h = run_dose.lux_h_of_points(of_view)
        rows.append((view.name, f"{lux_h[point] if lux_h else 0.0:.3f}"))
    was_killed = any(session.outcome == "" for session in run_status.sessions)
    return Section(
        "light",
        "Light on the object",
        tables=[Table("Light on the point that received the most light", ("view", "lux h"), rows)],
        notes=["If a session was killed during a burst, the burst counts with its planned light."]
        if was_killed
        else [],
    )


def choices(events: Sequence[Event]) -> list[Section]:
    """Return the choices that were made in the run, with their reasons; none if the plan gives all bursts."""
    rows: list[Sequence[Inline]] = []
    for event in events:
        if isinstance(event, BurstsChosen):
            frames = sum(len(burst.leds) for burst in event.bursts)
            rows.append((event.view, event.reason, str(frames)))
    table = Table("Choices, in the order in which they were made", ("view", "choice", "frames"), rows)
    tables = [table] if rows else []
    if of_views := _choices_of_views(events):
        tables.insert(0, of_views)
    return [Section("choices", "Chosen in the run", tables=tables)] if tables else []


def _choices_of_views(events: Iterable[Event]) -> Table | None:
    """Return the views that were chosen, with the best alternatives; None if the plan gives the views."""
    rows: list[Sequence[Inline]] = []
    for event in events:
        if isinstance(event, ViewChosen):
            next_best = event.figures.get("next_best", ())
            texts = [f"{candidate['view']} ({candidate['score']:.3g})" for candidate in next_best]
            rows.append((event.view or "no more", event.reason, ", ".join(texts)))
    head = ("view", "choice", "next best, with their scores")
    return Table("Views, in the order in which they were chosen", head, rows) if rows else None


def duration_in_words(run_status: Status) -> str:
    """Return the duration of all sessions together."""
    total_s = sum(session.duration_s for session in run_status.sessions)
    pauses = sum(session.pauses for session in run_status.sessions)
    paused_s = sum(session.paused_s for session in run_status.sessions)
    count = len(run_status.sessions)
    pause_text = f"{pauses} {'pause' if pauses == 1 else 'pauses'} of {duration_text(paused_s)} in all"
    sessions = "1 session" if count == 1 else f"{count} sessions"
    return f"{duration_text(total_s)} in {sessions}, {pause_text if pauses else 'no pause'}"


def sessions(run_status: Status) -> Section:
    """A table of sessions: when each began, how long it took and was paused, and how it ended."""
    rows: list[Sequence[Inline]] = []
    for number, session in enumerate(run_status.sessions, 1):
        outcome, reason = _end_of(session, run_status, last=number == len(run_status.sessions))
        pause_text = f"{session.pauses} ({duration_text(session.paused_s)})" if session.pauses else "none"
        rows.append((Moment(session.begun), duration_text(session.duration_s), pause_text, outcome, reason))
    head = ("begun (UTC)", "duration", "pauses", "ended", "why")
    notes = [
        f"In the session of {session.begun} the machine's clock was set by {session.clock_set_s:+.0f} s. Times "
        f"of day and pauses in this report are by that clock; the duration is not."
        for session in run_status.sessions
        if abs(session.clock_set_s) > _CLOCK_SET_S
    ]
    return Section("time", "Time", tables=[Table("Sessions", head, rows)], notes=notes)


def _end_of(session: Session, run_status: Status, *, last: bool) -> tuple[str, str]:
    outcome = session.outcome or (
        run_status.state if last and run_status.state in ("running", "paused") else "killed"
    )
    return outcome, session.reason or (KILLED if outcome == "killed" else "")


def calibrations_in_words(run: Run) -> str:
    """Return the kinds of records that were in force."""
    stamps = run.about.get("calibrations", "none")
    return ", ".join(stamps) if isinstance(stamps, dict) and stamps else "none in force"


def calibrations(run: Run) -> Section:
    """Return the records that were in force: their dates, their validity, and the run's copies."""
    stamps = run.about.get("calibrations", "none")
    rows: list[Sequence[Inline]] = []
    records = _records(run)
    for kind, digest in stamps.items() if isinstance(stamps, dict) else ():
        record, path = records.get(digest, (None, ""))
        date = f"{record.created:%Y-%m-%d}" if record else "the run has no readable copy"
        until = f"{record.validity.expires:%Y-%m-%d}" if record else ""
        rows.append((kind, date, until, Link(path) if path else "", Code(digest[:12])))
    head = ("kind", "made", "valid until", "record", "checksum")
    return Section("calibrations", "Calibrations", tables=[Table("Calibrations in force", head, rows)])


def _records(run: Run) -> dict[str, tuple[Any, str]]:
    """Return the records among the run's copies with their places, by their checksum."""
    records = {}
    for entry in run.about.get("files", []):
        path = entry.get("stored") or ""
        if "/calibrations/" not in path or not path.endswith((".yaml", ".yml")):
            continue
        try:
            record = read_record(run.folder / path)
        except (InputError, OSError, ValueError):
            continue
        records[record.sha256] = (record, path)
    return records


# -- trouble --------------------------------------------------------------------------------------------------


def troubles(events: Iterable[Event], views: Iterable[SampledView], run_status: Status) -> list[Inline]:
    """Return the things that went wrong, a line each."""
    lines: list[Inline] = []
    for event in events:
        if isinstance(event, FaultNoted) and event.kind != _STOPPED_IN_0_1:
            words = f"held: {event.message}" if event.is_hold else Verdict(event.message, "bad")
            lines.append([Moment(event.t), " ", words])
        elif isinstance(event, FindingNoted):
            figure = f"{event.figure:.3g} {event.unit}, the limit is {event.limit:.3g}"
            words = f" view {event.view}: {event.kind}: {event.message}; {len(event.shots)} shots ({figure}) "
            lines.append([Moment(event.t), words, Link(event.picture) if event.picture else ""])
        elif isinstance(event, GapFound):
            why = f"{event.missing} missing, {event.lost_in_transfer} lost in transfer, {event.surplus} surplus"
            dead = f"; LEDs without current: {', '.join(map(str, event.dead_leds))}" if event.dead_leds else ""
            reason = f" ({event.reason})" if event.reason else ""
            lines.append([Moment(event.t), f" view {event.view}: {why}{dead}{reason}"])
    if run_status.reshot:
        lines.append(f"{run_status.reshot} frames were taken again")
    lines += [Verdict(f"view {view.name}: {view.trouble}", "bad") for view in views if view.trouble]
    lines += [
        [Moment(session.ended), " a session had no end: it was killed, or the power failed"]
        for number, session in enumerate(run_status.sessions, 1)
        if _end_of(session, run_status, last=number == len(run_status.sessions))[0] == "killed"
    ]
    return lines


def trouble(lines: Sequence[Inline]) -> Section:
    """Return the list, shortened if it is long."""
    more = len(lines) - _MOST_LINES
    rest: list[Inline] = [[f"and {more} more, in ", Link("journal.jsonl")]] if more > 0 else []
    words = [] if lines else ["Nothing went wrong."]
    return Section("trouble", "What went wrong", words=words, items=[*lines[:_MOST_LINES], *rest])


# -- the technical --------------------------------------------------------------------------------------------


def technical(run: Run, events: Sequence[Event], run_status: Status) -> Section:
    """Devices, software, clocks, counters, files."""
    about = run.about
    devices = [
        (str(kind), *(str(device.get(key) or "") for key in ("vendor", "model", "serial", "firmware")))
        for kind, device in about.get("devices", {}).items()
    ]
    head = ("device", "maker", "model", "serial number", "firmware")
    return Section(
        "technical",
        "Devices and software",
        facts=_origin(about, run_status),
        tables=[Table("Devices", head, devices), _bursts(events), _link_of_the_arm(events), _files(run)],
    )


def _origin(about: Mapping[str, Any], run_status: Status) -> Mapping[str, Inline]:
    software = about.get("software", {})
    return {
        "created": Moment(about.get("created", "")),
        "operator": f"{about.get('operator', '')} on {about.get('host', 'an unnamed machine')}",
        "software": f"{software.get('name', '')} {software.get('version', '')}",
        "proof": run_status.proof,
        "licence": about.get("licence") or "not stated",
        "contact": about.get("contact") or "not stated",
    }


def _bursts(events: Iterable[Event]) -> Table:
    rows = []
    for burst in events:
        if isinstance(burst, BurstEnded) and burst.clocks:
            counters = Counter(burst.camera or {})
            clocks = [burst.clocks.get(name, math.nan) for name in _CLOCKS]
            row = [burst.view, str(burst.steps), str(burst.frames), f"{burst.on_s:.2f}"]
            row += [f"{value:.1f}" for value in clocks]
            row += [str(counters[name]) for name in ("lost_transfers", "over_triggers")]
            rows.append([*row, "" if burst.hottest_board_c is None else f"{burst.hottest_board_c:.1f}"])
    clocks_head = ("drift ppm", "residual rms us", "residual max us")
    head = (
        "view",
        "steps",
        "frames",
        "light s",
        *clocks_head,
        "lost transfers",
        "edges while busy",
        "hottest board C",
    )
    return Table("Bursts: the box's clock against the camera's, and the camera's counters", head, rows)


_CLOCKS = ("drift_ppm", "residual_rms_us", "residual_max_us")


def _link_of_the_arm(events: Iterable[Event]) -> Table:
    rows = [
        (Moment(event.t), ", ".join(f"{name} {value}" for name, value in event.robot.items()))
        for event in events
        if isinstance(event, SessionStopped) and event.robot
    ]
    return Table("Link to the arm, at the end of each session", ("time (UTC)", "figures"), rows)


def _files(run: Run) -> Table:
    names = ("README.txt", "run.json", "journal.jsonl", "manifest.sha256")
    paths = [run.folder / name for name in names]
    paths += [run.folder / entry["stored"] for entry in _stored_files(run)]
    paths += [run.view_path(view) for view in run.views]
    rows = [
        (Link(str(path.relative_to(run.folder))), bytes_text(path.stat().st_size))
        for path in paths
        if path.is_file()
    ]
    return Table("Files of the run", ("file", "size"), rows)


def _stored_files(run: Run) -> list[dict[str, Any]]:
    entries = [run.about["plan"], run.about["rig"], *run.about.get("files", [])]
    return [entry for entry in entries if entry.get("stored")]
