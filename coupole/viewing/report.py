"""`report.html` of a run: what an operator asks first, then pictures, then the technical figures.

It is made from the run's folder alone, at any time, also while the run goes on and after a crash.
"""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from coupole.errors import StorageError
from coupole.storage import journal
from coupole.storage.durable import write_synced
from coupole.storage.journal_events import BurstEnded, Event, FaultNoted, FrameProven, GapFound
from coupole.storage.run import Run
from coupole.storage.run_status import KILLED, Status, status
from coupole.storage.view_reader import read_view
from coupole.viewing.progress import ViewExposure
from coupole.viewing.raw_preview import develop, png
from coupole.viewing.terminal import duration_text

NAME = "report.html"
PICTURES_PER_VIEW = 12
THUMBNAIL_WIDTH_PX = 256
_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse}td,th{padding:.2em .8em .2em 0;text-align:left;vertical-align:top}
figure{display:inline-block;margin:.3em}figcaption{font-size:12px;color:#666}
img{display:block;background:#000}.bad{color:#b00}.ok{color:#070}.stopped{color:#950}code{background:#eee}
"""


def write(run: Run, path: Path | None = None, *, in_use: bool | None = None) -> Path:
    """Write the run's report into its folder, or to another file; also of an incomplete run. Whoever holds the
    run's lock says whether it is `in_use`."""
    path = path or run.folder / NAME
    page = _page(run, status(run, in_use=in_use))
    try:
        write_synced(path, page)
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from error
    return path


def _page(run: Run, found: Status) -> str:
    events = list(journal.read(run.journal_path))
    proven = [event for event in events if isinstance(event, FrameProven)]
    views = [
        _view(run, view, [event for event in proven if event.shot.view == view]) for view in run.about["views"]
    ]
    name = html.escape(run.folder.name)
    simulated = "<p>Simulated: no real light, no real object." if run.simulated else ""
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{name}</title><style>{_STYLE}</style><h1>{name}</h1>{simulated}"
        f"{_rows(_answers(run, found))}{_exposures(views)}{_faults(events)}{_sessions(found)}"
        + "".join(f"<h2>{html.escape(view.name)}</h2><p>{view.said}{''.join(view.figures)}" for view in views)
        + f"<h2>Devices and software</h2>{_rows(_technical(run, found))}{_bursts(events)}"
    )


def _rows(rows: dict[str, str]) -> str:
    """A table of HTML values by name."""
    return "<table>" + "".join(f"<tr><th>{name}<td>{value}" for name, value in rows.items()) + "</table>"


# -- what an operator asks first ------------------------------------------------------------------------------


def _answers(run: Run, found: Status) -> dict[str, str]:
    kind = {"done": "ok", "failed": "bad"}.get(found.state, "stopped")
    why = f": {html.escape(found.reason)}" if found.reason and found.state != "done" else ""
    whole = "ok" if found.missing == 0 else kind
    rows = {
        "outcome": f"<b class={kind}>{found.state}</b>{why}",
        "shots": f"<span class={whole}>{found.proven} of {found.shots} proven</span>, {found.reshot} re-shot, "
        f"{found.darks_proven} dark frames",
    }
    if found.go_on:
        rows["go on with"] = f"<code>{html.escape(found.go_on)}</code> ({found.frames_left} frames are left)"
    return {
        **rows,
        "object": html.escape(run.about.get("object") or "none"),
        "light": _light(found),
        "duration": _duration(found),
        "calibrations": _calibrations(run.about.get("calibrations", "none")),
    }


def _light(found: Status) -> str:
    """Of all sessions; a burst whose end was not recorded counts as planned."""
    light_s = sum(session.light_s for session in found.sessions)
    return f"{found.dose_lux_h:.3f} lux h, LEDs on for {light_s:.1f} s"


def _duration(found: Status) -> str:
    total_s = sum(session.duration_s for session in found.sessions)
    pauses, paused_s = (
        sum(session.pauses for session in found.sessions),
        sum(session.paused_s for session in found.sessions),
    )
    sessions = "1 session" if len(found.sessions) == 1 else f"{len(found.sessions)} sessions"
    paused = f"{pauses} pauses of {duration_text(paused_s)} in all" if pauses else "no pause"
    return f"{duration_text(total_s)} in {sessions}, {paused}"


def _calibrations(stamped: Any) -> str:
    if not isinstance(stamped, dict):
        return "none in force"
    return ", ".join(f"{html.escape(kind)} <code>{digest[:12]}</code>" for kind, digest in stamped.items())


def _exposures(views: Iterable[_View]) -> str:
    rows = "".join(
        f"<tr><td>{html.escape(view.name)}<td>{', '.join(f'{us:,}' for us in view.exposures_us)}"
        f"<td>{view.exposure.brightest:.0%}<td>{view.exposure.saturated:.2%}<td>{view.exposure.verdict()}"
        for view in views
        if view.exposure.pictures
    )
    head = "<tr><th>view<th>exposures, us<th>brightest<th>saturated<th>verdict"
    note = (
        "<p>By the pictures below: brightest is the highest 99.9 % quantile as a share of full scale above black, "
        "saturated the largest share of a picture's pixels at full scale."
    )
    return f"<h2>Exposure</h2><table>{head}{rows}</table>{note}" if rows else ""


def _faults(events: list[Event]) -> str:
    lines = []
    for event in events:
        if isinstance(event, FaultNoted) and event.kind != "Interrupted":  # so noted by version 0.1
            lines.append(f"<li class=bad>{event.t} {html.escape(event.message)}")
        elif isinstance(event, GapFound):
            why = f"{event.missing} missing, {event.surplus} surplus {event.reason}"
            lines.append(f"<li>{event.t} {html.escape(event.view)}: {html.escape(why)}")
    return f"<h2>What went wrong</h2><ul>{''.join(lines)}</ul>" if lines else "<p>Nothing went wrong."


def _sessions(found: Status) -> str:
    rows = ""
    for number, session in enumerate(found.sessions, 1):
        last = number == len(found.sessions)
        outcome = session.outcome or (found.state if last and found.state in ("running", "paused") else "killed")
        reason = session.reason or (KILLED if outcome == "killed" else "")
        rows += (
            f"<tr><td>{session.begun}<td>{duration_text(session.duration_s)}<td>{session.pauses}"
            f"<td>{outcome}<td>{html.escape(reason)}"
        )
    head = "<tr><th>begun (UTC)<th>duration<th>pauses<th>ended<th>why"
    return f"<h2>Sessions</h2><table>{head}{rows}</table>" if rows else ""


# -- pictures -------------------------------------------------------------------------------------------------


@dataclass
class _View:
    """A view's pictures and its exposure, by a sample of its proven shots."""

    name: str
    said: str = ""
    figures: list[str] = field(default_factory=list)
    exposures_us: tuple[int, ...] = ()
    exposure: ViewExposure = field(default_factory=ViewExposure)


def _view(run: Run, name: str, proven: list[FrameProven]) -> _View:
    found = _View(name, f"{len(proven)} proven frames")
    shots = sorted((event for event in proven if event.shot.is_shot), key=lambda event: str(event.shot))
    if not shots:
        return found
    path = run.view_path(name)
    try:
        file = read_view(path, shots)
        found.exposures_us = tuple(sorted({int(file.records[event.index]["exposure_us"]) for event in shots}))
        step = max(1, len(shots) // PICTURES_PER_VIEW)
        for event in shots[::step][:PICTURES_PER_VIEW]:
            raw = file.pixels(event.index)
            found.exposure.add(raw, black_dn=file.black_dn, white_dn=file.white_dn)
            shown = develop(np.asarray(raw), pattern=file.pattern, black_dn=file.black_dn, white_dn=file.white_dn)
            data = base64.b64encode(png(shown, THUMBNAIL_WIDTH_PX)).decode()
            shot = html.escape(str(event.shot))
            picture = f'<img src="data:image/png;base64,{data}" alt="{shot}">'
            found.figures.append(f"<figure>{picture}<figcaption>{shot}</figcaption></figure>")
    except (StorageError, IndexError, ValueError) as error:
        found.said = f"<span class=bad>{html.escape(str(error))}</span>"
    return found


# -- the technical --------------------------------------------------------------------------------------------


def _technical(run: Run, found: Status) -> dict[str, str]:
    about = run.about
    devices = about.get("devices", {})
    software = about.get("software", {})
    rows = {
        "created": about.get("created", ""),
        "operator": f"{about.get('operator', '')} on {about.get('host', '')}",
        "software": f"{software.get('name', '')} {software.get('version', '')}",
        "devices": "; ".join(f"{kind}: {one['model']} {one['serial']}" for kind, one in devices.items()),
        "proof": found.proof,
        "licence": about.get("licence") or "not stated",
        "contact": about.get("contact") or "not stated",
    }
    return {name: html.escape(str(value)) for name, value in rows.items()}


def _bursts(events: list[Event]) -> str:
    bursts = [event for event in events if isinstance(event, BurstEnded) and event.clocks]
    if not bursts:
        return ""
    rows = "".join(
        f"<tr><td>{html.escape(b.view)}<td>{b.steps}<td>{b.frames}<td>{b.on_s:.2f}"
        f"<td>{b.clocks.get('drift_ppm', math.nan):.2f}<td>{b.clocks.get('residual_rms_us', math.nan):.1f}"
        f"<td>{b.clocks.get('residual_max_us', math.nan):.1f}<td>{b.hottest_board_c}"
        for b in bursts
        if b.clocks
    )
    head = "<tr><th>view<th>steps<th>frames<th>light s<th>drift ppm<th>residual rms us<th>max us<th>board C"
    return f"<h2>Bursts: box against camera</h2><table>{head}{rows}</table>"
