"""The uncertainty budget as an HTML page: result, dominant sources, accuracies beside the paper's, all inputs."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

from coupole.calibration.budget.accuracy import PAPER_SPREAD, SPREAD_WORDS, Accuracy, Case
from coupole.calibration.budget.budget import Budget, Spread
from coupole.calibration.budget.propagation import Validation
from coupole.calibration.report import HEAD, STYLE, table


def page(
    budget: Budget,
    sample_spread: Spread,
    cases: Sequence[Case],
    accuracies: Sequence[Accuracy],
    picture: bytes,
    doubts: Sequence[str] = (),
) -> str:
    """The whole page; `picture` is the PNG, `doubts` are reasons not to rely on the records."""
    data = base64.b64encode(picture).decode()
    doubt_lines = "".join(f"<p class=bad>{html.escape(doubt)}" for doubt in doubts)
    return (
        f"{HEAD}<title>Uncertainty budget</title><style>{STYLE}</style>"
        f"<h1>Uncertainty of a reflectance</h1>"
        f"<p>Light at {budget.geometry.incidence_deg:g} deg; relative to the value. {budget.numeric.trials} trials"
        f"{'' if budget.numeric.stable else ', too few for two digits of u'}.{doubt_lines}{_result(budget)}"
        f"<h2>Samples over a dome, 68 %</h2>{_spread_table(sample_spread)}"
        f"<h2>What dominates</h2>{_sources(budget)}"
        f'<img src="data:image/png;base64,{data}" alt="distribution, sources, samples">'
        f"<h2>Accuracies beside the paper's</h2><p>Standard uncertainties, all directions together; samples "
        "over a dome: their 68 % intervals."
        f"{_accuracies(cases, accuracies)}<h2>All inputs</h2>{_inputs(budget)}"
    )


def verdict(validation: Validation) -> str:
    """Say in words whether the linear formula is sufficient."""
    if not validation.sure:
        return "may do or not: more trials would tell"
    return "will do" if validation.is_within_tolerance else "will not do"


def _result(budget: Budget) -> str:
    rows = []
    for interval in budget.numeric.intervals:
        low, high = budget.relative(interval.coverage, interval.kind)
        rows.append(f"<td>{interval.coverage:.0%}<td>{interval.kind}<td class=n>{low:+.2%}<td class=n>{high:+.2%}")
    for interval in budget.linear.result.intervals:
        low, high = interval.low / budget.nominal - 1.0, interval.high / budget.nominal - 1.0
        rows.append(f"<td>{interval.coverage:.0%}<td>linear formula<td class=n>{low:+.2%}<td class=n>{high:+.2%}")
    checks = [
        f"<td>{v.coverage:.0%}<td class=n>{v.digits}<td class=n>{max(v.d_low, v.d_high) / budget.nominal:.3%}"
        f"<td class=n>{v.tolerance / budget.nominal:.3%}<td>{verdict(v)}"
        for v in budget.validations
    ]
    return (
        table("<th>coverage<th>interval<th class=n>from<th class=n>to", rows)
        + "<p>The linear formula against Monte Carlo (JCGM 101, section 8):"
        + table(
            "<th>coverage<th class=n>digits of u<th class=n>ends apart<th class=n>tolerance<th>linear formula",
            checks,
        )
    )


def _spread_table(sample_spread: Spread) -> str:
    rows = []
    for key, words in SPREAD_WORDS.items():
        (low, high), (paper_low, paper_high) = getattr(sample_spread, key), PAPER_SPREAD[key]
        rows.append(f"<td>{words}<td>[{low:+.2%}, {high:+.2%}]<td>[{paper_low:+.2%}, {paper_high:+.2%}]")
    return table("<th>samples<th>here<th>seed 003, section 6.1", rows)


def _sources(budget: Budget) -> str:
    rows = [
        f"<td>{html.escape(s.source)}<td>{html.escape(s.figure)}<td>{html.escape(s.said_by)}"
        f"<td class=n>{s.alone:.2%}<td class=n>{s.linear:.1%}<td class=n>{s.width_decrease:.1%}"
        for s in budget.shares
    ]
    head = "<th>source<th>taken as<th>said by"
    head += "<th class=n>alone<th class=n>of linear variance<th class=n>narrower without"
    return table(head, rows)


def _accuracies(cases: Sequence[Case], accuracies: Sequence[Accuracy]) -> str:
    rows = [
        f"<td>{html.escape(line.quantity)}<td>{html.escape(line.paper)}"
        + "".join(f"<td>{html.escape(line.cell(n))}" for n in range(len(cases)))
        for line in accuracies
    ]
    robot = "<td>robot's noise, found<td>" + "".join(f"<td>{html.escape(case.robot)}" for case in cases)
    head = "<th>what<th>paper" + "".join(f"<th>{html.escape(case.name)}" for case in cases)
    return table(head, [robot, *rows])


def _inputs(budget: Budget) -> str:
    rows = [
        f"<td>{html.escape(q.name)}<td class=n>{q.value:.6g}<td class=n>{q.u:.3g}<td>{q.shape}"
        f"<td>{html.escape(q.source)}"
        for q in budget.inputs.quantities
    ]
    return table("<th>input<th class=n>value<th class=n>u<th>distribution<th>said by", rows)
