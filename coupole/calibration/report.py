"""The report of a calibration: one page (HTML) and one picture (PNG). Both are written with the record."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.record import Parameter, Record, write_record
from coupole.calibration.traceability import traceability_section
from coupole.errors import StorageError
from coupole.pages.page_parts import Code, Inline, Link, Page, Picture, Section, Table, Verdict
from coupole.pages.page_rendering import render

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLUE, RED, GREY, DARK = "#2a6f97", "#c1121f", "#b8bec5", "#333333"


@dataclass(frozen=True)
class Outcome:
    """Result of a calibration: its record, the files beside it, and a function that draws it."""

    record: Record
    draw: Callable[[Figure], None]
    """Fills an empty figure of 1600 x 1200 pixels."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Files by name, as `record.files` lists them: tables and maps that are too large for YAML."""
    sections: Sequence[Section] = ()
    """Parts of the page in addition to the parts that all records have."""


def write_outcome(record_path: Path, outcome: Outcome) -> tuple[Path, Path]:
    """Write the record, its files, and `NAME.html` and `NAME.png` beside it; returns the last two paths.

    Raises StorageError.
    """
    folder, name = record_path.parent, outcome.record.name
    picture = draw(outcome)
    page, png = folder / f"{name}.html", folder / f"{name}.png"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file, content in outcome.files.items():
            (folder / file).write_bytes(content)
        png.write_bytes(picture)
        page.write_text(render(_page(outcome, picture)), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{folder}: cannot write the report: {error.strerror}. Free its disk.") from error
    write_record(record_path, outcome.record)
    return page, png


def draw(outcome: Outcome) -> bytes:
    """Return the picture as PNG, 1600 x 1200."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 12), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    outcome.draw(figure)
    record = outcome.record
    verdict = "accepted" if record.is_accepted else "NOT ACCEPTED"
    images = f": {len(record.images)} images" if record.images else ""
    title = f"{record.kind} calibration {record.name}{images}, {verdict}"
    figure.suptitle(title + (" (simulated)" if record.simulated else ""), fontsize=16, color=DARK)
    return png_of(figure)


def png_of(figure: Figure) -> bytes:
    """Return a drawn figure as PNG, in the style of all calibrations' pictures."""
    for ax in figure.axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(colors=DARK)
        ax.title.set_fontsize(13)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


# -- the page ---------------------------------------------------------------------------------------------


def _page(outcome: Outcome, picture: bytes) -> Page:
    record = outcome.record
    return Page(
        title=f"{record.name}: {record.kind} calibration, {'accepted' if record.is_accepted else 'not accepted'}",
        pictures=[Picture("Residuals and what was found", picture, is_broad=True)],
        summary=_summary(record),
        quality=_quality(record),
        next_step=_next_step(record),
        remark="Simulated: no real camera." if record.simulated else "",
        sections=[
            Section("limits", "Limits", tables=[_limits(record)]),
            Section("result", "Result", tables=[_transforms(record), _parameters(record), _noise(record)]),
            *outcome.sections,
            Section("remarks", "Remarks", items=record.remarks),
            traceability_section(record),
            _validity(record),
        ],
    )


def _summary(record: Record) -> str:
    sources = f"{len(record.images)} images" if record.images else f"{len(record.inputs)} files"
    return f"The {record.kind} calibration {record.name} was made on {record.created:%Y-%m-%d} from {sources}."


def _quality(record: Record) -> Inline:
    missed = [limit for limit in record.limits if not limit.is_met]
    verdict = Verdict("Accepted.", "ok") if record.is_accepted else Verdict("Not accepted.", "bad")
    if not record.limits:
        return verdict
    worst = max(record.limits, key=lambda limit: limit.found / limit.limit if limit.limit else limit.found)
    met = f"{len(missed)} of {len(record.limits)} limits are missed" if missed else "All limits are met"
    return [
        verdict,
        f" {met}; {'the worst' if missed else 'the nearest'}: {worst.what}, {worst.found:.3g} of at most "
        f"{worst.limit:.3g} {worst.unit}".rstrip(),
        ".",
    ]


def _next_step(record: Record) -> Inline:
    record_file = Code(f"{record.name}.yaml")
    if record.is_accepted:
        return [
            "Keep ",
            record_file,
            f" with the cell's records: it is valid until {record.validity.expires:%Y-%m-%d}.",
        ]
    return [
        "Remove the cause and calibrate again",
        [" (", Link("#remarks", "Remarks"), " say where to look)"] if record.remarks else "",
        "; the record is refused wherever records are used.",
    ]


def _limits(record: Record) -> Table:
    rows: list[Sequence[Inline]] = []
    for limit in record.limits:
        verdict = Verdict("met", "ok") if limit.is_met else Verdict("missed", "bad")
        usual = "" if limit.usual is None else f", usually {limit.usual:.3g}"
        option: Inline = [Code(limit.name), usual] if limit.name else usual
        rows.append((limit.what, f"{limit.found:.3g}", f"{limit.limit:.3g}", limit.unit, verdict, option))
    head = ("limit", "found", "at most", "unit", "verdict", "set by --limit")
    return Table("Figures that decide whether the record is accepted", head, rows)


def _transforms(record: Record) -> Table:
    rows = [
        (name, *(f"{v:.4f}" for v in pose.translation_mm), *(f"{v:.5f}" for v in pose.abc_deg))
        for name, pose in record.transforms.items()
    ]
    head = ("transform", "x mm", "y mm", "z mm", "A deg", "B deg", "C deg")
    return Table("Transforms", head, rows)


def _parameters(record: Record) -> Table:
    rows = [_parameter(parameter) for parameter in record.parameters]
    rows += [(name, f"{value:.6g}", "", "", "", "held, not fitted") for name, value in record.fixed.items()]
    head = (
        "parameter",
        "value",
        "expanded uncertainty (95 %)",
        "k",
        "degrees of freedom",
        "most of it from",
    )
    return Table("Parameters", head, rows)


def _parameter(parameter: Parameter) -> tuple[str, ...]:
    k = float(coverage_factor(parameter.degrees_of_freedom))
    value = "" if parameter.value is None else f"{parameter.value:.{_decimals(k * parameter.u)}f}"
    freedom = f"{parameter.degrees_of_freedom:.0f}" if parameter.degrees_of_freedom < 1e5 else "many"
    return (parameter.name, value, f"{k * parameter.u:.2g}", f"{k:.2f}", freedom, parameter.dominated_by)


def _decimals(uncertainty: float) -> int:
    """Return the number of decimals of a value that shows two digits of its uncertainty."""
    return int(np.clip(1 - np.floor(np.log10(max(uncertainty, 1e-12))), 0, 12))


def _noise(record: Record) -> Table:
    rows = [
        (n.name, f"{n.found:.3g}", f"{n.stated:.3g}" if n.stated else "", n.unit, f"{n.redundancy:.0f}")
        for n in record.noise
    ]
    return Table("Noise", ("noise of", "found", "stated", "unit", "redundancy"), rows)


def _validity(record: Record) -> Section:
    holds = record.validity.model_dump(exclude_none=True)
    facts: dict[str, Inline] = {key.replace("_", " "): str(value) for key, value in holds.items()}
    facts["made"] = f"{record.created:%Y-%m-%d %H:%M} UTC by {record.software}"
    facts["record"] = Code(record.sha256)
    rows = [(one.name, Code(one.sha256)) for one in record.inputs]
    inputs = Table("Files that it was made from", ("file", "SHA-256"), rows)
    return Section("validity", "Validity and inputs", facts=facts, tables=[inputs])
