"""The uncertainty budget as a page: result, dominant sources, accuracies beside the paper's accuracies, all
inputs."""

from __future__ import annotations

from collections.abc import Sequence

from coupole.calibration.budget.accuracy import PAPER_SPREAD, SPREAD_WORDS, Accuracy, Case
from coupole.calibration.budget.budget import Budget, Spread
from coupole.calibration.budget.propagation import Validation
from coupole.pages.page_parts import Code, Inline, Link, Page, Picture, Section, Table, Verdict
from coupole.pages.page_rendering import render


def page(
    budget: Budget,
    sample_spread: Spread,
    cases: Sequence[Case],
    accuracies: Sequence[Accuracy],
    picture: bytes,
    doubts: Sequence[str] = (),
    traces: Sequence[str] = (),
) -> str:
    """Return the whole page as HTML. `picture` is the PNG, `doubts` are reasons not to rely on the records, and
    `traces` are the certificates of the records."""
    names = ", ".join(dict.fromkeys(case.name for case in cases))
    return render(
        Page(
            title=f"{names or 'The cell'}: uncertainty of a reflectance",
            pictures=[Picture("Distribution, sources, samples", picture, is_broad=True)],
            summary="The uncertainty of one reflectance was propagated through the measurement equation, with "
            "light at "
            f"{budget.geometry.incidence_deg:g} deg, by {budget.numeric.trials:,} trials.",
            quality=_quality(budget),
            next_step=_next_step(budget, doubts),
            sections=[
                Section("doubts", "Reasons for doubt", items=[Verdict(doubt, "bad") for doubt in doubts]),
                _result(budget),
                Section("samples", "Samples over a dome, 68 %", tables=[_spread_table(sample_spread)]),
                Section("sources", "What dominates", tables=[_sources(budget)]),
                Section(
                    "accuracies",
                    "Accuracies beside the paper's",
                    tables=[_accuracies(cases, accuracies)],
                    notes=[
                        "Standard uncertainties, all directions together; for samples over a dome, their 68 % "
                        "intervals."
                    ],
                ),
                Section("traceability", "Traceability", items=traces),
                Section("inputs", "All inputs", tables=[_inputs(budget)]),
            ],
        )
    )


def _quality(budget: Budget) -> str:
    interval = max(budget.numeric.intervals, key=lambda one: one.coverage)
    low, high = budget.relative(interval.coverage, interval.kind)
    stable = "" if budget.numeric.stable else "; the trials are too few for two digits"
    return f"{interval.coverage:.0%} of the trials lie from {low:+.2%} to {high:+.2%} of the value{stable}."


def _next_step(budget: Budget, doubts: Sequence[str]) -> Inline:
    if doubts:
        return ["Read the ", Link("#doubts", "reasons for doubt"), " before you use these figures."]
    if not budget.numeric.stable:
        return ["Ask for more trials: ", Code("--trials"), "."]
    largest = max(budget.shares, key=lambda share: share.width_decrease, default=None)
    if largest is None:
        return "Nothing: no source is stated."
    narrower = f"{largest.width_decrease:.0%} narrower"
    return f"To narrow it, begin with {largest.source}: without this source the interval is {narrower}."


def verdict(validation: Validation) -> str:
    """Return in words whether the linear formula is sufficient."""
    if not validation.sure:
        return "may or may not be good enough: more trials would show this"
    return "will do" if validation.is_within_tolerance else "will not do"


def _result(budget: Budget) -> Section:
    rows: list[tuple[str, ...]] = []
    for interval in budget.numeric.intervals:
        low, high = budget.relative(interval.coverage, interval.kind)
        rows.append((f"{interval.coverage:.0%}", interval.kind, f"{low:+.2%}", f"{high:+.2%}"))
    for interval in budget.linear.result.intervals:
        low, high = interval.low / budget.nominal - 1.0, interval.high / budget.nominal - 1.0
        rows.append((f"{interval.coverage:.0%}", "linear formula", f"{low:+.2%}", f"{high:+.2%}"))
    checks = [
        (
            f"{v.coverage:.0%}",
            str(v.digits),
            f"{max(v.d_low, v.d_high) / budget.nominal:.3%}",
            f"{v.tolerance / budget.nominal:.3%}",
            verdict(v),
        )
        for v in budget.validations
    ]
    title = "The linear formula against Monte Carlo (JCGM 101, section 8)"
    return Section(
        "result",
        "Result",
        tables=[
            Table("Intervals, relative to the value", ("coverage", "interval", "from", "to"), rows),
            Table(title, ("coverage", "digits of u", "ends apart", "tolerance", "linear formula"), checks),
        ],
    )


def _spread_table(sample_spread: Spread) -> Table:
    rows = []
    for key, words in SPREAD_WORDS.items():
        (low, high), (paper_low, paper_high) = getattr(sample_spread, key), PAPER_SPREAD[key]
        rows.append((words, f"[{low:+.2%}, {high:+.2%}]", f"[{paper_low:+.2%}, {paper_high:+.2%}]"))
    return Table("Samples over a dome", ("samples", "here", "Lucat et al. 2025, section 6.1"), rows)


def _sources(budget: Budget) -> Table:
    rows = [
        (s.source, s.figure, s.said_by, f"{s.alone:.2%}", f"{s.linear:.1%}", f"{s.width_decrease:.1%}")
        for s in budget.shares
    ]
    head = ("source", "taken as", "said by", "alone", "of linear variance", "narrower without")
    return Table("Sources", head, rows)


def _accuracies(cases: Sequence[Case], accuracies: Sequence[Accuracy]) -> Table:
    rows = [(line.quantity, line.paper, *(line.cell(n) for n in range(len(cases)))) for line in accuracies]
    robot = ("robot's noise, found", "", *(case.robot for case in cases))
    head = ("what", "paper", *(case.name for case in cases))
    return Table("Accuracies", head, [robot, *rows])


def _inputs(budget: Budget) -> Table:
    rows = [(q.name, f"{q.value:.6g}", f"{q.u:.3g}", q.shape, q.source) for q in budget.inputs.quantities]
    return Table("Inputs", ("input", "value", "u", "distribution", "said by"), rows)
