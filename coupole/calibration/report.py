"""The report of a calibration: one page (HTML) and one picture (PNG), and how both are written with the record."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.record import Parameter, Record, write_record
from coupole.errors import StorageError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEAD = (
    '<!doctype html><html lang="en"><meta charset="utf-8">'
    '<meta name="viewport" content="width=device-width,initial-scale=1">'
)
"""First words of every page of results."""
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:.5em 0}td,th{padding:.15em 1em .15em 0;text-align:left}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}
.bad{color:#b00}.ok{color:#070}img{max-width:100%}code{font-size:13px}
"""
BLUE, RED, GREY, DARK = "#2a6f97", "#c1121f", "#b8bec5", "#333333"


@dataclass(frozen=True)
class Outcome:
    """Result of a calibration: its record, the files beside it, and a function that draws it."""

    record: Record
    draw: Callable[[Figure], None]
    """Fills an empty figure of 1600 x 1200 pixels."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Files by name, as `record.files` lists them: tables and maps that are too large for YAML."""


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
        page.write_text(_page(outcome.record, picture), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{folder}: cannot write the report: {error.strerror}. Free its disk.") from error
    write_record(record_path, outcome.record)
    return page, png


def draw(outcome: Outcome) -> bytes:
    """The picture as PNG, 1600 x 1200."""
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
    for ax in figure.axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(colors=DARK)
        ax.title.set_fontsize(13)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


# -- the page ---------------------------------------------------------------------------------------------


def _page(record: Record, picture: bytes) -> str:
    name = html.escape(f"{record.kind} calibration {record.name}")
    simulated_note = "<p>Simulated: no real camera.</p>" if record.simulated else ""
    data = base64.b64encode(picture).decode()
    remarks = "".join(f"<li>{html.escape(remark)}" for remark in record.remarks)
    return (
        f"{HEAD}<title>{name}</title><style>{STYLE}</style><h1>{name}</h1>"
        f"{simulated_note}{_limits(record)}<h2>Result</h2>{_transforms(record)}{_parameters(record)}{_noise(record)}"
        + (f"<h2>Remarks</h2><ul>{remarks}</ul>" if remarks else "")
        + f'<h2>Residuals</h2><img src="data:image/png;base64,{data}" alt="residuals">{_validity(record)}'
    )


def table(head: str, rows: Sequence[str]) -> str:
    """An HTML table of rows of cells, as `<td>a<td>b`."""
    return f"<table><tr>{head}{''.join(f'<tr>{row}' for row in rows)}</table>"


def _limits(record: Record) -> str:
    verdict = "<p class=ok><b>Accepted.</b>" if record.is_accepted else "<p class=bad><b>Not accepted.</b>"
    rows = [
        f"<td>{html.escape(limit.what)}<td class=n>{limit.found:.3g}<td class=n>{limit.limit:.3g}"
        f"<td>{limit.unit}<td class={'ok>met' if limit.is_met else 'bad>missed'}"
        f"<td>{'' if limit.name is None else f'<code>{limit.name}</code>'}"
        f"{'' if limit.usual is None else f', usually {limit.usual:.3g}'}"
        for limit in record.limits
    ]
    return verdict + table("<th>limit<th class=n>found<th class=n>at most<th><th><th>set by --limit", rows)


def _transforms(record: Record) -> str:
    rows = []
    for name, pose in record.transforms.items():
        numbers = [*(f"{v:.4f}" for v in pose.translation_mm), *(f"{v:.5f}" for v in pose.abc_deg)]
        rows.append(f"<td>{html.escape(name)}" + "".join(f"<td class=n>{n}" for n in numbers))
    head = "<th>transform" + "".join(
        f"<th class=n>{h}" for h in ("x mm", "y mm", "z mm", "A deg", "B deg", "C deg")
    )
    return table(head, rows) if rows else ""


def _parameters(record: Record) -> str:
    rows = [_parameter(parameter) for parameter in record.parameters]
    rows += [
        f"<td>{html.escape(n)}<td class=n>{v:.6g}<td class=n>held<td><td><td>" for n, v in record.fixed.items()
    ]
    head = (
        "<th>parameter<th class=n>value<th class=n>expanded uncertainty (95 %)<th class=n>k"
        "<th class=n>degrees of freedom<th>most of it from"
    )
    return table(head, rows)


def _parameter(parameter: Parameter) -> str:
    k = float(coverage_factor(parameter.degrees_of_freedom))
    value = "" if parameter.value is None else f"{parameter.value:.{_decimals(k * parameter.u)}f}"
    freedom = f"{parameter.degrees_of_freedom:.0f}" if parameter.degrees_of_freedom < 1e5 else "many"
    return (
        f"<td>{html.escape(parameter.name)}<td class=n>{value}<td class=n>{k * parameter.u:.2g}<td class=n>{k:.2f}"
        f"<td class=n>{freedom}<td>{html.escape(parameter.dominated_by)}"
    )


def _decimals(uncertainty: float) -> int:
    """Number of decimals of a value that shows two digits of its uncertainty."""
    return int(np.clip(1 - np.floor(np.log10(max(uncertainty, 1e-12))), 0, 12))


def _noise(record: Record) -> str:
    rows = [
        f"<td>{html.escape(n.name)}<td class=n>{n.found:.3g}<td class=n>{f'{n.stated:.3g}' if n.stated else ''}"
        f"<td>{n.unit}<td class=n>{n.redundancy:.0f}"
        for n in record.noise
    ]
    return table("<th>noise of<th class=n>found<th class=n>stated<th><th class=n>redundancy", rows)


def _validity(record: Record) -> str:
    holds = record.validity.model_dump(exclude_none=True)
    rows = [
        f"<td>{html.escape(key.replace('_', ' '))}<td>{html.escape(str(value))}" for key, value in holds.items()
    ]
    rows += [f"<td>{html.escape(i.name)}<td><code>{i.sha256}</code>" for i in record.inputs]
    rows += [
        f"<td>made<td>{record.created:%Y-%m-%d %H:%M} UTC by {html.escape(record.software)}",
        f"<td>record<td><code>{record.sha256}</code>",
    ]
    return "<h2>Validity and inputs</h2>" + table("<th><th>", rows)
