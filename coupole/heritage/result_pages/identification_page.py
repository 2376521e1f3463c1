"""`identification.html`: findings about identified spectra, with the evidence of each band."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coupole.appearance.spectra.grid import Array
from coupole.errors import StorageError, reason
from coupole.heritage.analysis.identification import Evidence, PigmentFinding
from coupole.heritage.analysis.references import HeldOutRates
from coupole.heritage.result_pages.identification_record import Origin, new_record, write_record
from coupole.heritage.result_pages.line_profile import LineProfile
from coupole.heritage.result_pages.report_parts import (
    compared_section,
    confusions_of,
    facts_of,
    fit_plots,
    limits_section,
    remark_of,
    signature_section,
    words_of,
)
from coupole.pages.page_charts import mark, points
from coupole.pages.page_parts import (
    Code,
    Drawing,
    Figure,
    Inline,
    Link,
    Page,
    Picture,
    Plot,
    Section,
    Shape,
    Table,
    Verdict,
)
from coupole.pages.page_rendering import write_page
from coupole.storage.durable import make_folder

PAGE = "identification.html"
_CANDIDATES = 6
_WIDTH, _LEFT, _CURVES, _BARS = 720.0, 46.0, 240.0, 110.0
_HEIGHT = _CURVES + _BARS + 60.0


def write(
    folder: Path, findings: Sequence[PigmentFinding], origin: Origin, profile: LineProfile | None = None
) -> Path:
    """Write the page of findings that share a library, and its record; with a profile, the points' line. Raises
    StorageError."""
    path = folder / PAGE
    try:
        make_folder(folder)
    except OSError as error:
        raise StorageError(f"{path}: {reason(error)}") from error
    results = {} if profile is None else {"line": profile.document()}
    record = new_record(origin, findings, results)
    files = [] if profile is None else profile.write(folder)
    write_page(path, _page(findings, origin, record, profile))
    write_record(folder, record, [path, *files])
    return path


def _page(
    findings: Sequence[PigmentFinding], origin: Origin, record: dict[str, Any], profile: LineProfile | None
) -> Page:
    first = findings[0]
    is_one = len(findings) == 1
    pictures: list[Figure] = [_plot(first)]
    if profile is not None:
        pictures = [Picture("Classes along the line, and the reflectance", profile.png(), is_broad=True)]
    subject, of_line = first.name if is_one else f"{len(findings)} spectra", ""
    if profile is not None:
        subject, of_line = f"{len(findings)} points along a line", f" along {profile.length_mm:.1f} mm"
    return Page(
        title=f"{subject}: pigments identified",
        pictures=pictures,
        summary=[
            f"Reflectance{of_line} was compared with the library ",
            Code(origin.library.name),
            ", band by band.",
        ],
        quality=_quality(findings),
        next_step=_next_step(findings),
        remark=remark_of(origin),
        facts=facts_of(origin),
        sections=[
            Section("spectra", "Spectra", tables=[] if is_one else [_overview(findings)]),
            *(
                finding_section(number, finding, has_evidence=bool(number or profile))
                for number, finding in enumerate(findings)
            ),
            reliability_section(findings[-1].rates),
            compared_section(origin),
            limits_section(),
            signature_section(origin, record),
        ],
    )


def _quality(findings: Sequence[PigmentFinding]) -> Inline:
    if len(findings) == 1:
        only = findings[0]
        return [_verdict(only), f": {words_of(only)}"]
    counts = [
        (word, sum(finding.verdict == word for finding in findings))
        for word in ("match", "mixture", "ambiguous", "unknown")
    ]
    return f"Of {len(findings)} spectra: {', '.join(f'{count} {word}' for word, count in counts if count)}."


def _next_step(findings: Sequence[PigmentFinding]) -> Inline:
    if all(finding.verdict in ("match", "mixture") for finding in findings):
        return [
            "Weigh it by ",
            Link("#library", "how reliable the verdicts are"),
            "; confirm the result by another method before you publish it.",
        ]
    return (
        "If a verdict is ambiguous or unknown, add references of the classes in question, or use another method."
    )


def _overview(findings: Sequence[PigmentFinding]) -> Table:
    rows: list[Sequence[Inline]] = [
        (Link(f"#s{number}", finding.name), _verdict(finding), finding.class_name, _percent(finding))
        for number, finding in enumerate(findings)
    ]
    return Table("Spectra", ("spectrum", "verdict", "class", "probability"), rows)


def finding_section(
    number: int, finding: PigmentFinding, *, has_evidence: bool = True, name: str = "", is_folded: bool = False
) -> Section:
    """The section of one spectrum. Without `has_evidence` its evidence is the picture at the top."""
    nm = finding.evidence.wavelengths_nm
    extent = f"{nm[0]:g} to {nm[-1]:g} nm{', near infrared too' if finding.near_infrared else ''}"
    parts = [
        (part.class_name, part.name, f"{part.share:.0%}", f"{part.interval[0]:.1%} to {part.interval[1]:.1%}")
        for part in finding.parts
    ]
    candidates = [
        (candidate.class_name, f"{candidate.probability:.1%}", candidate.name)
        for candidate in finding.candidates[:_CANDIDATES]
    ]
    return Section(
        f"s{number}",
        name or finding.name,
        words=[words_of(finding)],
        figures=[_plot(finding)] if has_evidence else [],
        figure_size="wide",
        facts={
            "verdict": _verdict(finding),
            "why": finding.reason,
            "could be confused with": confusions_of(finding),
            "compared": "; ".join((extent, *finding.remarks)),
            "not in the library": f"{finding.not_in_library:.0%}",
        },
        tables=[
            Table("Parts of the mixture", ("class", "reference", "share of K/S", "95 % interval"), parts),
            Table("Most probable classes", ("class", "probability", "nearest reference"), candidates),
        ],
        notes=[] if has_evidence else ["The evidence of its bands is the picture at the top."],
        sections=[Section(f"s{number}-fit", "Measured against fitted", figures=fit_plots(finding))],
        is_folded=is_folded,
    )


def _plot(finding: PigmentFinding) -> Plot:
    best, second = (candidate.class_name for candidate in finding.candidates[:2])
    words = (
        f"Above: the spectrum (solid), the nearest reference of {best} (long dashes) and of {second} (short "
        "dashes), "
        "each with K/S scaled to fit the spectrum best. Below: the evidence of each band, upwards for the first "
        "class, downwards for the second, in units of the spread within classes"
    )
    title = f"{finding.name}: reflectance, and evidence by wavelength for {best} against {second}"
    return Plot(Drawing(title, _WIDTH, _HEIGHT, _shapes(finding.evidence)), words=words)


def _verdict(finding: PigmentFinding) -> Verdict:
    return Verdict(finding.verdict, "ok" if finding.verdict in ("match", "mixture") else "stopped")


def _percent(finding: PigmentFinding) -> str:
    return f"{finding.candidates[0].probability:.0%}"


def reliability_section(rates: HeldOutRates) -> Section:
    """Return the rates at which the library is right about its own spectra."""
    return Section(
        "library",
        "How reliable the verdicts are",
        words=[
            "Each spectrum of the library was identified as if the library lacked it, and as if it lacked its "
            "class. In "
            "brackets are 95 % intervals (Clopper and Pearson). With another instrument, binder or ground the "
            "rates are worse."
        ],
        facts={
            "first class right": str(rates.right),
            "match, right": str(rates.matches),
            "match, wrong": str(rates.false_matches),
            "unknown, class left out": str(rates.unknown),
        },
    )


def _shapes(evidence: Evidence) -> list[Shape]:
    """Return three curves at the top, a bar for each band below, and their scales."""
    nm = evidence.wavelengths_nm
    curves = (evidence.reflectance, evidence.best, evidence.runner_up)
    highest = max(0.1, 1.05 * max(float(curve.max()) for curve in curves))
    x = np.asarray(_LEFT + (_WIDTH - _LEFT - 10.0) * (nm - nm[0]) / (nm[-1] - nm[0]))
    shapes = [
        Shape(
            "polyline", {"class": name, "stroke-dasharray": dashes, "points": points(x, _height(curve / highest))}
        )
        for curve, name, dashes in zip(curves, "YBR", ("none", "9 4", "3 3"), strict=True)
    ]
    scale = [
        mark(_LEFT - 6, float(_height(np.array(tick / highest))) + 4, f"{tick:.0%}", "end")
        for tick in _ticks(highest)
    ]
    return [*shapes, *scale, *_bands(evidence, x), *_wavelengths(nm)]


def _height(share: Array) -> Array:
    return np.asarray(10.0 + _CURVES * (1.0 - share))


def _bands(evidence: Evidence, x: Array) -> list[Shape]:
    middle = 30.0 + _CURVES + _BARS / 2
    shapes = [Shape("line", {"x1": _LEFT, "x2": _WIDTH - 10, "y1": middle, "y2": middle})]
    strongest = max(1.0, float(np.abs(evidence.log_odds).max()))
    width = 0.8 * (_WIDTH - _LEFT - 10.0) / len(x)
    for at, odds in zip(x, evidence.log_odds / strongest * _BARS / 2, strict=True):
        top, kind = (middle - odds, "for") if odds > 0.0 else (middle, "against")
        size = {"width": f"{width:.1f}", "height": f"{abs(odds):.1f}"}
        shapes.append(Shape("rect", {"x": f"{at - width / 2:.1f}", "y": f"{top:.1f}", **size, "class": kind}))
    shapes.append(mark(_LEFT - 6, middle - _BARS / 2 + 10, f"{strongest:.0f}", "end"))
    return [*shapes, mark(_LEFT - 6, middle + _BARS / 2, f"-{strongest:.0f}", "end")]


def _wavelengths(nm: Array) -> list[Shape]:
    step = 50.0 if nm[-1] - nm[0] < 600.0 else 200.0
    shapes = []
    for tick in np.arange(np.ceil(nm[0] / step) * step, nm[-1] + 1.0, step):
        at = _LEFT + (_WIDTH - _LEFT - 10.0) * (tick - nm[0]) / (nm[-1] - nm[0])
        shapes.append(mark(float(at), _HEIGHT - 8, f"{tick:g}{' nm' if tick + step > nm[-1] else ''}", "middle"))
    return shapes


def _ticks(highest: float) -> list[float]:
    step = next(step for step in (0.02, 0.05, 0.1, 0.2, 0.5) if highest / step <= 6.0 or step == 0.5)
    return [float(tick) for tick in np.arange(0.0, highest, step)]
