"""`report.html` of a run: what was measured and how well, light and time, then trouble; technical tables last.

It is made from the run's folder alone, at any time, also while the run goes on and after a crash.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from coupole.errors import InputError, StorageError
from coupole.plan import yamlfile
from coupole.plan.plan import Plan
from coupole.storage import journal
from coupole.storage.durable import write_synced
from coupole.storage.journal_events import Event, FrameProven, ViewBegun
from coupole.storage.run import Run
from coupole.storage.run_status import Status, status
from coupole.viewing import report_facts as run_facts
from coupole.viewing.page_parts import facts, page, section, table, text
from coupole.viewing.report_pictures import (
    coverage_in_words,
    coverages,
    exposure_in_words,
    exposures,
    pictures,
)
from coupole.viewing.run_coverage import Coverage, coverage_of
from coupole.viewing.run_sample import SampledView, sampled_views


def write(run: Run, path: Path | None = None, *, in_use: bool | None = None) -> Path:
    """Write the run's report into its folder, or to another file; also of an incomplete run. Whoever holds the
    run's lock says whether it is `in_use`."""
    path = path or run.report_path
    content = _page(run, status(run, in_use=in_use))
    try:
        write_synced(path, content)
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from error
    return path


def _page(run: Run, run_status: Status) -> str:
    events = list(journal.read_events(run.journal_path))
    views = sampled_views(run, (event for event in events if isinstance(event, FrameProven)))
    object_coverage = _coverage(run, views)
    lines = run_facts.troubles(events, views, run_status)
    sections = {
        "measured": ("What was measured", _measured_views(run, events, views)),
        "exposure": ("Exposure", exposures(views, run.about.get("scaling") or "")),
        "choices": ("Chosen in the run", run_facts.choices(events)),
        "coverage": (
            "Coverage of the object",
            coverages(object_coverage) if isinstance(object_coverage, Coverage) else "",
        ),
        "light": ("Light on the object", run_facts.light(events, views, run_status)),
        "time": ("Time", run_facts.sessions(run_status)),
        "calibrations": ("Calibrations", run_facts.calibrations(run)),
        "trouble": ("What went wrong", run_facts.trouble(lines)),
        "pictures": ("Pictures", pictures(views)),
        "technical": ("Devices and software", run_facts.technical(run, events, run_status)),
    }
    parts = {name: part for name, part in sections.items() if part[1]}
    remark = "<p>Simulated: no real light, no real object.</p>" if run.is_simulated else ""
    glance = facts(_glance(run, run_status, views, object_coverage, lines))
    body = "".join(section(name, *part) for name, part in parts.items())
    head = f"<header><h1>{text(run.folder.name)}</h1>{remark}</header>"
    return page(run.folder.name, f"{head}<main>{glance}{_contents(parts)}{body}</main>")


def _contents(sections: Mapping[str, tuple[str, str]]) -> str:
    links = "".join(f'<li><a href="#{name}">{heading}</a></li>' for name, (heading, _) in sections.items())
    return f'<nav aria-label="Contents"><ul>{links}</ul></nav>'


def _coverage(run: Run, views: Sequence[SampledView]) -> Coverage | str:
    """The object's coverage, or why it is not known."""
    try:
        return coverage_of(run, views) or "not known: the object has no mesh, or no view a measured pose"
    except (InputError, StorageError, OSError, ValueError) as error:
        return f"not known: {text(str(error).splitlines()[0] if str(error) else type(error).__name__)}"


def _glance(
    run: Run,
    run_status: Status,
    views: Sequence[SampledView],
    object_coverage: Coverage | str,
    lines: Sequence[str],
) -> dict[str, str]:
    kind = {"done": "ok", "failed": "bad"}.get(run_status.state, "stopped")
    why = f": {text(run_status.reason)}" if run_status.reason and run_status.state != "done" else ""
    whole = "ok" if run_status.missing == 0 else kind
    things = "one thing" if len(lines) == 1 else f"{len(lines)} things"
    return {
        "outcome": f"<b class={kind}>{run_status.state}</b>{why}",
        "go on with": f"<code>{text(run_status.go_on)}</code> ({run_status.frames_left} frames are left)"
        if run_status.go_on
        else "",
        "object": text(run.about.get("object") or "none"),
        "shots": f"<span class={whole}>{run_status.proven} of {run_status.shots} proven</span>, "
        f"{run_status.reshot} re-shot, {run_status.darks_proven} dark frames",
        "exposure": _exposure_in_words(run, views),
        "coverage": coverage_in_words(object_coverage)
        if isinstance(object_coverage, Coverage)
        else object_coverage,
        "light": run_facts.light_in_words(run_status, run_status.dose_budget_lux_h or _plans_budget_lux_h(run)),
        "duration": run_facts.duration_in_words(run_status),
        "calibrations": run_facts.calibrations_in_words(run),
        "trouble": f'<a href="#trouble">{things} went wrong</a>' if lines else "none",
    }


def _exposure_in_words(run: Run, views: Sequence[SampledView]) -> str:
    verdicts = exposure_in_words(views)
    return f"{verdicts}{' (by simulated light)' if run.is_simulated else ''}" if verdicts else "no picture yet"


def _plans_budget_lux_h(run: Run) -> float | None:
    """Read the dose budget from the plan, for runs whose journal has none; None if the plan has none or cannot be
    read."""
    try:
        plan = yamlfile.read_document(run.plan_path).validate(Plan)
    except (InputError, OSError):
        return None
    return plan.object.dose_budget_lux_h if plan.object else None


def _measured_views(run: Run, events: Sequence[Event], views: Sequence[SampledView]) -> str:
    """Views, their lights and what of them is proven."""
    hidden_counts = {event.view: len(event.hidden_leds) for event in events if isinstance(event, ViewBegun)}
    rows = []
    for view in views:
        share = f"{view.proven} of {view.expected_frames}"
        if view.proven < view.expected_frames:
            share = f"<span class=stopped>{share}</span>"
        left_out = len(run.hidden_leds.get(view.name, ()))
        hidden_text = f"{left_out}, left out" if left_out else str(hidden_counts.get(view.name, "")) or "not known"
        times = ", ".join(f"{exposure.exposure_us / 1e3:g} ms" for exposure in view.exposures)
        rows.append((text(view.name), share, str(view.leds), times, str(view.darks), hidden_text))
    head = ("view", "frames proven", "LEDs", "exposures", "dark frames", "hidden LEDs")
    return (
        table("Views, in the plan's order", head, rows)
        + '<p class="note">Proven: box and camera show of which light and exposure the frame is. Hidden: LEDs '
        "that light nothing which the view sees, because arm, camera or object stand between.</p>"
    )
