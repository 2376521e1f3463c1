"""The report of a commissioning: one HTML page beside its record."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from coupole.pages.page_charts import bars
from coupole.pages.page_parts import Code, Inline, Link, Page, Plot, Section, Table, Verdict, anchor
from coupole.pages.page_rendering import write_page
from coupole.preflight.commissioned import STEPS, CommissioningRecord, StepResult
from coupole.preflight.commissioned_rig import Step

_MOST_BARS = 12


def write(record_path: Path, record: CommissioningRecord) -> Path:
    """Write `NAME.html` beside the record `NAME.yaml`; returns its path. Raises StorageError."""
    path = record_path.with_suffix(".html")
    write_page(path, page(record))
    return path


def page(record: CommissioningRecord) -> Page:
    """The page: one section for each step, in their order."""
    results = {step: record.result(step) for step in STEPS}
    open_steps = [step for step, result in results.items() if result is None or not result.has_passed]
    return Page(
        title=f"{record.rig}: commissioned, {'passed' if record.has_passed else 'not passed'}",
        pictures=_limits(results),
        summary=f"{sum(result is not None for result in results.values())} of {len(STEPS)} steps of the "
        f"commissioning of {record.rig} were done.",
        quality=_quality(record, results),
        next_step=_next_step(record, open_steps),
        remark="Simulated: no real cell." if record.simulated else "",
        sections=[
            Section(
                "steps",
                "Steps",
                tables=[
                    Table("Steps, in their order", ("step", "verdict", "person", "ended (UTC)"), _rows(results))
                ],
            ),
            *(_step(step, result) for step, result in results.items()),
            Section("record", "Record", facts={"made by": record.software, "record": Code(record.sha256 or "")}),
        ],
    )


def _limits(results: dict[Step, StepResult | None]) -> list[Plot]:
    """Each figure as a share of its limit."""
    shares = [
        (f"{step}: {limit.what}", limit.found / limit.limit)
        for step, result in results.items()
        for limit in (result.limits if result else ())
        if limit.limit > 0
    ]
    nearest = sorted(shares, key=lambda share: -share[1])[:_MOST_BARS]
    return (
        [bars("The figures nearest to their limits, as shares of the limits", nearest, "limit")] if nearest else []
    )


def _quality(record: CommissioningRecord, results: dict[Step, StepResult | None]) -> Inline:
    limits = [limit for result in results.values() if result for limit in result.limits]
    missed_count = sum(not limit.is_met for limit in limits)
    verdict = Verdict("Passed.", "ok") if record.has_passed else Verdict("Not passed.", "bad")
    return [verdict, f" {len(limits) - missed_count} of {len(limits)} limits are met."]


def _next_step(record: CommissioningRecord, open_steps: Sequence[Step]) -> Inline:
    if not open_steps:
        return (
            "Nothing: repeat a step when its part of the rig or its device has changed; the program asks for it."
        )
    links: list[Inline] = [Link(f"#{anchor(step)}", step) for step in open_steps]
    line: list[Inline] = ["Remove the cause, then give ", Code("coupole commission"), " again; open: "]
    for number, link in enumerate(links):
        line += [", " if number else "", link]
    return [*line, "."]


def _rows(results: dict[Step, StepResult | None]) -> list[Sequence[Inline]]:
    return [
        (
            Link(f"#{anchor(step)}", step),
            _verdict(result),
            result.person if result else "",
            f"{result.ended:%Y-%m-%d %H:%M}" if result else "",
        )
        for step, result in results.items()
    ]


def _verdict(result: StepResult | None) -> Verdict:
    if result is None:
        return Verdict("not done", "bad")
    return Verdict("passed", "ok") if result.has_passed else Verdict("not passed", "bad")


def _step(step: Step, result: StepResult | None) -> Section:
    name = anchor(step)
    if result is None:
        return Section(name, step, words=[Verdict("Not done.", "bad")])
    limits: list[Sequence[Inline]] = [
        (
            limit.what,
            f"{limit.found:.4g}",
            f"{limit.limit:.4g}",
            limit.unit,
            Verdict("met", "ok") if limit.is_met else Verdict("missed", "bad"),
        )
        for limit in result.limits
    ]
    answers: list[Sequence[Inline]] = [
        (limit.question, Verdict("yes", "ok") if limit.yes else Verdict("no", "bad")) for limit in result.answers
    ]
    settings: dict[str, Inline] = {
        key: Code(str(value)) for key, value in (*result.devices.items(), *result.settings.items())
    }
    return Section(
        name,
        [f"{step}: ", _verdict(result)],
        words=[
            f"{result.person}, {result.ended:%Y-%m-%d %H:%M} UTC",
            *([Verdict(result.failure, "bad")] if result.failure else []),
        ],
        items=result.remarks,
        tables=[
            Table("Limits", ("limit", "found", "at most", "unit", "verdict"), limits),
            Table("What the person saw", ("asked", "answer"), answers),
        ],
        sections=[Section(f"{name}-settings", "devices and settings", facts=settings, is_folded=True)],
    )
