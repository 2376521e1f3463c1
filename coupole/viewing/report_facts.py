"""Light, time, calibrations, trouble and the technical tables of a run, as sections of its report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from coupole.calibration.record import read_record
from coupole.errors import InputError
from coupole.storage import run_dose
from coupole.storage.journal_events import (
    BurstBegun,
    BurstEnded,
    BurstsChosen,
    Event,
    FaultNoted,
    GapFound,
    SessionStopped,
)
from coupole.storage.run import Run
from coupole.storage.run_status import KILLED, Session, Status
from coupole.viewing.page_parts import facts, link, moment, table, text
from coupole.viewing.run_sample import SampledView
from coupole.viewing.terminal import bytes_text, duration_text

_MOST_LINES = 30
"""Most lines of trouble; the rest is only counted."""
_STOPPED_IN_0_1 = "Interrupted"


def light_in_words(run_status: Status, budget_lux_h: float | None) -> str:
    """Return the light of all sessions; a burst whose end was not recorded counts as planned."""
    light_s = sum(session.light_s for session in run_status.sessions)
    budget = f" (the object may receive {budget_lux_h:g} in its life)" if budget_lux_h else ""
    return f"{run_status.dose_lux_h:.3f} lux h{budget}, LEDs on for {light_s:.1f} s"


def light(events: Sequence[Event], views: Iterable[SampledView], run_status: Status) -> str:
    """The dose by view, at the point of the object that received most."""
    total = run_dose.lux_h_of_points(events)
    if not total:
        return '<p class="note">The journal has no light: it was not recorded, or none was given.</p>'
    point = total.index(max(total))
    rows = []
    for view in views:
        of_view = [e for e in events if isinstance(e, BurstBegun | BurstEnded) and e.view == view.name]
        lux_h = run_dose.lux_h_of_points(of_view)
        rows.append((text(view.name), f"{lux_h[point] if lux_h else 0.0:.3f}"))
    was_killed = any(session.outcome == "" for session in run_status.sessions)
    note = (
        '<p class="note">A burst in which a session was killed counts as it was planned.</p>' if was_killed else ""
    )
    return table("Light on the point that received most", ("view", "lux h"), rows) + note


def choices(events: Iterable[Event]) -> str:
    """Choices that were made in the run, with their reasons; nothing where the plan says all."""
    rows = []
    for event in events:
        if isinstance(event, BurstsChosen):
            frames = sum(len(burst.leds) for burst in event.bursts)
            rows.append((text(event.view), text(event.reason), str(frames)))
    return table("Choices, in the order in which they were made", ("view", "choice", "frames"), rows)


def duration_in_words(run_status: Status) -> str:
    """Return the duration of all sessions together."""
    total_s = sum(session.duration_s for session in run_status.sessions)
    pauses = sum(session.pauses for session in run_status.sessions)
    paused_s = sum(session.paused_s for session in run_status.sessions)
    count = len(run_status.sessions)
    pause_text = f"{pauses} {'pause' if pauses == 1 else 'pauses'} of {duration_text(paused_s)} in all"
    sessions = "1 session" if count == 1 else f"{count} sessions"
    return f"{duration_text(total_s)} in {sessions}, {pause_text if pauses else 'no pause'}"


def sessions(run_status: Status) -> str:
    """Return a table of sessions: when each began, how long it took and was paused, and how it ended."""
    rows = []
    for number, session in enumerate(run_status.sessions, 1):
        outcome, reason = _end_of(session, run_status, last=number == len(run_status.sessions))
        pause_text = f"{session.pauses} ({duration_text(session.paused_s)})" if session.pauses else "none"
        rows.append((moment(session.begun), duration_text(session.duration_s), pause_text, outcome, text(reason)))
    return table("Sessions", ("begun (UTC)", "duration", "pauses", "ended", "why"), rows)


def _end_of(session: Session, run_status: Status, *, last: bool) -> tuple[str, str]:
    outcome = session.outcome or (
        run_status.state if last and run_status.state in ("running", "paused") else "killed"
    )
    return outcome, session.reason or (KILLED if outcome == "killed" else "")


def calibrations_in_words(run: Run) -> str:
    """The kinds that were in force."""
    stamps = run.about.get("calibrations", "none")
    return ", ".join(map(text, stamps)) if isinstance(stamps, dict) and stamps else "none in force"


def calibrations(run: Run) -> str:
    """The records that were in force: when they were made, until when they hold, and the run's copies."""
    stamps = run.about.get("calibrations", "none")
    if not isinstance(stamps, dict) or not stamps:
        return ""
    records = _records(run)
    rows = []
    for kind, digest in stamps.items():
        record, path = records.get(digest, (None, ""))
        date = f"{record.created:%Y-%m-%d}" if record else "the run has no readable copy"
        until = f"{record.validity.expires:%Y-%m-%d}" if record else ""
        rows.append((text(kind), date, until, link(path) if path else "", f"<code>{text(digest[:12])}</code>"))
    return table("Calibrations in force", ("kind", "made", "valid until", "record", "checksum"), rows)


def _records(run: Run) -> dict[str, tuple[Any, str]]:
    """Records among the run's copies, and their places, by their checksum."""
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


def troubles(events: Iterable[Event], views: Iterable[SampledView], run_status: Status) -> list[str]:
    """Return what went wrong, a line of HTML each."""
    lines = []
    for event in events:
        if isinstance(event, FaultNoted) and event.kind != _STOPPED_IN_0_1:
            lines.append(f"<li class=bad>{moment(event.t)} {text(event.message)}</li>")
        elif isinstance(event, GapFound):
            why = f"{event.missing} missing, {event.lost_in_transfer} lost in transfer, {event.surplus} surplus"
            dead = f"; LEDs without current: {', '.join(map(str, event.dead_leds))}" if event.dead_leds else ""
            reason = f" ({event.reason})" if event.reason else ""
            lines.append(f"<li>{moment(event.t)} view {text(event.view)}: {text(why + dead + reason)}</li>")
    if run_status.reshot:
        lines.append(f"<li>{run_status.reshot} frames were taken again</li>")
    lines += [f"<li class=bad>view {text(view.name)}: {text(view.trouble)}</li>" for view in views if view.trouble]
    lines += [
        f"<li>{moment(session.ended)} a session had no end: it was killed, or the power failed</li>"
        for number, session in enumerate(run_status.sessions, 1)
        if _end_of(session, run_status, last=number == len(run_status.sessions))[0] == "killed"
    ]
    return lines


def trouble(lines: Sequence[str]) -> str:
    """The list, cut off where it is long."""
    if not lines:
        return "<p>Nothing went wrong.</p>"
    more = len(lines) - _MOST_LINES
    rest = f"<li>and {more} more, in {link('journal.jsonl')}</li>" if more > 0 else ""
    return f"<ul>{''.join(lines[:_MOST_LINES])}{rest}</ul>"


# -- the technical --------------------------------------------------------------------------------------------


def technical(run: Run, events: Iterable[Event], run_status: Status) -> str:
    """Devices, software, clocks, counters, files."""
    about = run.about
    devices = [
        (text(kind), *(text(device.get(key) or "") for key in ("vendor", "model", "serial", "firmware")))
        for kind, device in about.get("devices", {}).items()
    ]
    software = about.get("software", {})
    return (
        facts(
            {
                "created": moment(about.get("created", "")),
                "operator": text(f"{about.get('operator', '')} on {about.get('host', 'an unnamed machine')}"),
                "software": text(f"{software.get('name', '')} {software.get('version', '')}"),
                "proof": text(run_status.proof),
                "licence": text(about.get("licence") or "not stated"),
                "contact": text(about.get("contact") or "not stated"),
            }
        )
        + table("Devices", ("device", "maker", "model", "serial number", "firmware"), devices)
        + _bursts(events)
        + _link_of_the_arm(events)
        + _files(run)
    )


def _bursts(events: Iterable[Event]) -> str:
    rows = []
    for burst in events:
        if isinstance(burst, BurstEnded) and burst.clocks:
            counters = Counter(burst.camera or {})
            clocks = [burst.clocks.get(name, math.nan) for name in _CLOCKS]
            row = [text(burst.view), str(burst.steps), str(burst.frames), f"{burst.on_s:.2f}"]
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
    return table("Bursts: the box's clock against the camera's, and the camera's counters", head, rows)


_CLOCKS = ("drift_ppm", "residual_rms_us", "residual_max_us")


def _link_of_the_arm(events: Iterable[Event]) -> str:
    rows = [
        (moment(event.t), ", ".join(f"{text(name)} {text(value)}" for name, value in event.robot.items()))
        for event in events
        if isinstance(event, SessionStopped) and event.robot
    ]
    return table("Link to the arm, at the end of each session", ("time (UTC)", "figures"), rows)


def _files(run: Run) -> str:
    names = ("README.txt", "run.json", "journal.jsonl", "manifest.sha256")
    paths = [run.folder / name for name in names]
    paths += [run.folder / entry["stored"] for entry in _stored_files(run)]
    paths += [run.view_path(view) for view in run.about["views"]]
    rows = [
        (link(str(path.relative_to(run.folder))), bytes_text(path.stat().st_size))
        for path in paths
        if path.is_file()
    ]
    return table("Files of the run", ("file", "size"), rows)


def _stored_files(run: Run) -> list[dict[str, Any]]:
    entries = [run.about["plan"], run.about["rig"], *run.about.get("files", [])]
    return [entry for entry in entries if entry.get("stored")]
