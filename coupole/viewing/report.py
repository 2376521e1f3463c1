"""`report.html` of a run: figures, faults and pictures."""

from __future__ import annotations

import base64
import html
from collections import Counter
from pathlib import Path

from coupole.errors import StorageError
from coupole.plan.shot_id import ShotId
from coupole.storage import frame_file, journal
from coupole.storage.journal_events import BurstEnded, Event, FaultNoted, GapFound
from coupole.storage.run import Run, status
from coupole.viewing.raw_preview import develop, png

PICTURES_PER_VIEW = 12
THUMBNAIL_WIDTH_PX = 256
_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse}td,th{padding:.2em .8em .2em 0;text-align:left}
figure{display:inline-block;margin:.3em}figcaption{font-size:12px;color:#666}
img{display:block;background:#000}.bad{color:#b00}.ok{color:#070}svg{background:#f6f6f6}
"""


def write(run: Run) -> Path:
    """Write the run's report beside its journal, also for an incomplete run."""
    path = run.folder / "report.html"
    try:
        path.write_text(_page(run), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from error
    return path


def _page(run: Run) -> str:
    about, found = run.about, status(run)
    simulated = "Simulated: no real light, no real object." if about["simulated"] else ""
    whole = "ok" if found.missing == 0 else "bad"
    rows = {
        "created": about["created"],
        "operator": f"{about['operator']} on {about['host']}",
        "software": f"{about['software']['name']} {about['software']['version']}",
        "object": about["object"] or "none",
        "devices": "; ".join(f"{k}: {d['model']} {d['serial']}" for k, d in about["devices"].items()),
        "state": found.state,
        "proof": found.proof,
        "shots": f"<span class={whole}>{found.proven} of {found.shots} proven</span>, {found.reshot} re-shot, "
        f"{found.darks_proven} dark frames",
    }
    table = "".join(
        f"<tr><th>{key}<td>{value if key == 'shots' else html.escape(str(value))}" for key, value in rows.items()
    )
    events = list(journal.read(run.journal_path))
    name = html.escape(run.folder.name)
    return (
        f"<!doctype html><meta charset=utf-8><title>{name}</title><style>{_STYLE}</style><h1>{name}</h1>"
        f"<p>{simulated}</p><table>{table}</table>{_faults(events)}{_bursts(events)}"
        + "".join(_view(run, view) for view in about["views"])
    )


def _faults(events: list[Event]) -> str:
    lines = []
    for event in events:
        if isinstance(event, FaultNoted):
            lines.append(f"<li class=bad>{event.t} {html.escape(event.message)}")
        elif isinstance(event, GapFound):
            why = f"{event.missing} missing, {event.surplus} surplus {event.reason}"
            lines.append(f"<li>{event.t} {html.escape(event.view)}: {html.escape(why)}")
    return f"<h2>What went wrong</h2><ul>{''.join(lines)}</ul>" if lines else "<p>Nothing went wrong.</p>"


def _bursts(events: list[Event]) -> str:
    bursts = [event for event in events if isinstance(event, BurstEnded) and event.clocks]
    if not bursts:
        return ""
    rows = "".join(
        f"<tr><td>{html.escape(b.view)}<td>{b.steps}<td>{b.frames}<td>{b.on_s:.2f}"
        f"<td>{b.clocks['drift_ppm']:.2f}<td>{b.clocks['residual_rms_us']:.1f}"
        f"<td>{b.clocks['residual_max_us']:.1f}<td>{b.hottest_board_c}"
        for b in bursts
        if b.clocks
    )
    head = "<tr><th>view<th>steps<th>frames<th>light s<th>drift ppm<th>residual rms us<th>max us<th>board C"
    return f"<h2>Bursts: box against camera</h2><table>{head}{rows}</table>"


def _view(run: Run, view: str) -> str:
    path = run.view_path(view)
    if not path.exists():
        return ""
    try:
        layout, table = frame_file.read_layout(path), frame_file.read_frames(path)
        facts = frame_file.read_facts(path)
    except StorageError as error:
        return f"<h2>{html.escape(view)}</h2><p class=bad>{html.escape(str(error))}"
    shots = [
        (record["shot"].decode(), slot)
        for slot, record in enumerate(table)
        if record["state"] == frame_file.PROVEN and ShotId.parse(record["shot"].decode()).is_shot
    ]
    shots.sort()
    step = max(1, len(shots) // PICTURES_PER_VIEW)
    figures = []
    for shot, slot in shots[::step][:PICTURES_PER_VIEW]:
        raw = frame_file.read_frame(path, layout, slot)
        data = base64.b64encode(png(develop(raw, **facts), THUMBNAIL_WIDTH_PX)).decode()
        figures.append(
            f'<figure><img src="data:image/png;base64,{data}" alt="{html.escape(shot)}">'
            f"<figcaption>{html.escape(shot)}</figcaption></figure>"
        )
    count = Counter(int(record["state"]) for record in table)[frame_file.PROVEN]
    return f"<h2>{html.escape(view)}</h2><p>{count} proven frames</p>{''.join(figures)}"
