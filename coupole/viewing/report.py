"""`report.html` of a run: a picture, the measured views and their quality, light and time, then trouble, and
tables last.

It is made only from the run's folder. It can be made at any time, even while the run goes on, and after a crash.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from coupole.errors import InputError, StorageError
from coupole.pages.page_parts import Code, Inline, Link, Page, Section, Table, Verdict
from coupole.pages.page_rendering import write_page
from coupole.plan import yamlfile
from coupole.plan.plan import Plan
from coupole.storage import journal
from coupole.storage.journal_events import BurstsChosen, Event, FrameProven, ViewBegun, ViewChosen
from coupole.storage.run import Run, name_without_time
from coupole.storage.run_status import Status, status
from coupole.viewing import report_facts as run_facts
from coupole.viewing.report_pictures import (
    coverage_in_words,
    coverages,
    exposure_in_words,
    exposures,
    first_pictures,
    pictures,
)
from coupole.viewing.run_coverage import Coverage, coverage_of
from coupole.viewing.run_sample import SampledView, sampled_views


def write(run: Run, path: Path | None = None, *, in_use: bool | None = None) -> Path:
    """Write the run's report into its folder, or to another file; also of an incomplete run. A caller that knows
    about the run's lock may say whether it is `in_use`. Raises StorageError.
    """
    path = path or run.report_path
    write_page(path, _page(run, status(run, in_use=in_use)))
    return path


_MOST_ENDS = 2
"""Number of reasons, for which views have enough, that are shown at the top."""


def _page(run: Run, run_status: Status) -> Page:
    events = list(journal.read_events(run.journal_path))
    views = sampled_views(run, (event for event in events if isinstance(event, FrameProven)))
    object_coverage = _coverage(run, views)
    lines = run_facts.troubles(events, views, run_status)
    is_known = isinstance(object_coverage, Coverage)
    sections = [
        _measured_views(run, events, views),
        exposures(views, run.about.get("scaling") or ""),
        *run_facts.choices(events),
        *([coverages(object_coverage)] if isinstance(object_coverage, Coverage) else []),
        run_facts.light(events, views, run_status),
        run_facts.sessions(run_status),
        run_facts.calibrations(run),
        run_facts.trouble(lines),
        pictures(views),
        run_facts.technical(run, events, run_status),
    ]
    views_text = "1 view" if len(views) == 1 else f"{len(views)} views"
    return Page(
        title=f"{run.about.get('object') or name_without_time(run.folder.name)}: {views_text} acquired",
        pictures=first_pictures(views),
        summary=_summary(run, run_status, views),
        quality=_quality(events, views, object_coverage, lines),
        next_step=_next_step(run, run_status, views, has_mesh=is_known),
        remark="Simulated: no real light, no real object." if run.is_simulated else "",
        facts=_glance(run, run_status, views, object_coverage, lines),
        sections=sections,
    )


def _summary(run: Run, run_status: Status, views: Sequence[SampledView]) -> str:
    leds = max((view.leds for view in views), default=0)
    day = str(run.about.get("created", ""))[:10]
    under = f" under {leds} LEDs" if leds else ""
    return (
        f"The plan {name_without_time(run.folder.name)} was acquired{f' on {day}' if day else ''}: "
        f"{run_status.proven} of "
        f"{run_status.shots} shots are proven, in {len(views)} view{'' if len(views) == 1 else 's'}{under}."
    )


def _quality(
    events: Sequence[Event], views: Sequence[SampledView], object_coverage: Coverage | str, lines: Sequence[Inline]
) -> Inline:
    parts = [exposure_in_words(views) or "there is no picture yet"]
    if isinstance(object_coverage, Coverage):
        parts.append(coverage_in_words(object_coverage))
    ends = dict.fromkeys(e.reason for e in events if isinstance(e, BurstsChosen) and not e.bursts)
    parts += [e.reason for e in events if isinstance(e, ViewChosen) and not e.view]
    parts += list(ends)[:_MOST_ENDS]
    parts.append(f"{_things(lines)} went wrong" if lines else "nothing went wrong")
    sentence = "; ".join(parts)
    return f"{sentence[0].upper()}{sentence[1:]}."


def _next_step(run: Run, run_status: Status, views: Sequence[SampledView], *, has_mesh: bool) -> Inline:
    name = run.folder.name
    if run_status.go_on:
        return ["Take what is left, ", f"{run_status.left_in_words}: ", Code(run_status.go_on)]
    if run_status.missing:
        return ["Read ", Link("#trouble", "what went wrong"), "."]
    verdicts = {view.verdict() for view in views}
    if verdicts & {"over-exposed", "under-exposed"}:
        return ["Read ", Link("#exposure", "Exposure"), ", then acquire the plan again at another exposure."]
    if has_mesh:
        return ["Find its reflectance: ", Code(f"coupole reflectance {name} --out {name}-reflectance")]
    return ["Keep it safe: ", Code(f"coupole archive {name}")]


def _things(lines: Sequence[Inline]) -> str:
    return "one thing" if len(lines) == 1 else f"{len(lines)} things"


def _coverage(run: Run, views: Sequence[SampledView]) -> Coverage | str:
    """Return the object's coverage, or the reason why it is not known."""
    try:
        return coverage_of(run, views) or "not known: the object has no mesh, or no view a measured pose"
    except (InputError, StorageError, OSError, ValueError) as error:
        return f"not known: {str(error).splitlines()[0] if str(error) else type(error).__name__}"


def _glance(
    run: Run,
    run_status: Status,
    views: Sequence[SampledView],
    object_coverage: Coverage | str,
    lines: Sequence[Inline],
) -> Mapping[str, Inline]:
    sign = run_facts.sign_of(run_status.state)
    why = f": {run_status.reason}" if run_status.reason and run_status.state != "done" else ""
    proven = f"{run_status.proven} of {run_status.shots} proven"
    taken_again = f", {run_status.reshot} re-shot, {run_status.darks_proven} dark frames"
    return {
        "outcome": [Verdict(run_status.state, sign), why],
        "run": run.folder.name,
        "object": run.about.get("object") or "none",
        "shots": [Verdict(proven, "ok" if run_status.missing == 0 else sign), taken_again],
        "exposure": _exposure_in_words(run, views),
        "coverage": coverage_in_words(object_coverage)
        if isinstance(object_coverage, Coverage)
        else object_coverage,
        "light": run_facts.light_in_words(run_status, run_status.dose_budget_lux_h or _plans_budget_lux_h(run)),
        "duration": run_facts.duration_in_words(run_status),
        "calibrations": run_facts.calibrations_in_words(run),
        "trouble": Link("#trouble", f"{_things(lines)} went wrong") if lines else "none",
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


def _measured_views(run: Run, events: Sequence[Event], views: Sequence[SampledView]) -> Section:
    """Return views, their lights and the proven part of them."""
    hidden_counts = {event.view: len(event.hidden_leds) for event in events if isinstance(event, ViewBegun)}
    rows: list[Sequence[Inline]] = []
    for view in views:
        share = f"{view.proven} of {view.expected_frames}"
        left_out = len(run.hidden_leds.get(view.name, ()))
        hidden_text = f"{left_out}, left out" if left_out else str(hidden_counts.get(view.name, "")) or "not known"
        times = ", ".join(f"{exposure.exposure_us / 1e3:g} ms" for exposure in view.exposures)
        proven: Inline = share if view.proven >= view.expected_frames else Verdict(share, "stopped")
        rows.append((view.name, proven, str(view.leds), times, str(view.darks), hidden_text))
    head = ("view", "frames proven", "LEDs", "exposures", "dark frames", "hidden LEDs")
    return Section(
        "measured",
        "What was measured",
        tables=[Table("Views, in the plan's order", head, rows)],
        notes=[
            "Proven: box and camera show which light and exposure the frame belongs to. Hidden: LEDs that light "
            "nothing that the view sees, because arm, camera or object hide it."
        ],
    )
