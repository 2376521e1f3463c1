"""The report of a commissioning: one HTML page beside its record."""

from __future__ import annotations

import html
from pathlib import Path

from coupole.calibration.report import HEAD, STYLE, table
from coupole.errors import StorageError
from coupole.preflight.commissioned import STEPS, CommissioningRecord, StepResult


def write(record_path: Path, record: CommissioningRecord) -> Path:
    """Write `NAME.html` beside the record `NAME.yaml`; returns its path. Raises StorageError."""
    path = record_path.with_suffix(".html")
    try:
        path.write_text(page(record), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{path}: cannot write the report: {error.strerror}. Free its disk.") from error
    return path


def page(record: CommissioningRecord) -> str:
    """The page as HTML."""
    name = html.escape(f"Commissioning of {record.rig}")
    verdict = "<p class=ok><b>Passed.</b>" if record.has_passed else "<p class=bad><b>Not passed.</b>"
    remark = "<p>Simulated: no real cell." if record.simulated else ""
    parts = []
    for step in STEPS:
        result = record.result(step)
        parts.append(f"<h2>{step}</h2><p class=bad>Not done." if result is None else _step(result))
    return (
        f"{HEAD}<title>{name}</title><style>{STYLE}</style><h1>{name}</h1>"
        f"{verdict}{remark}{''.join(parts)}<p>Made by {html.escape(record.software)}; record "
        f"<code>{record.sha256}</code>"
    )


def _step(result: StepResult) -> str:
    limits = [
        f"<td>{html.escape(entry.what)}<td class=n>{entry.found:.4g}<td "
        f"class=n>{entry.limit:.4g}<td>{html.escape(entry.unit)}"
        f"<td class={'ok>met' if entry.is_met else 'bad>missed'}"
        for entry in result.limits
    ]
    answers = [
        f"<td>{html.escape(entry.question)}<td class={'ok>yes' if entry.yes else 'bad>no'}"
        for entry in result.answers
    ]
    remarks = "".join(f"<li>{html.escape(remark)}" for remark in result.remarks)
    settings = [
        f"<td>{html.escape(key)}<td><code>{html.escape(str(value))}</code>"
        for key, value in (*result.devices.items(), *result.settings.items())
    ]
    failure = f"<p class=bad>{html.escape(result.failure)}" if result.failure else ""
    return (
        f"<h2>{result.step}: <span class={'ok>passed' if result.has_passed else 'bad>not passed'}</span></h2>"
        f"<p>{html.escape(result.person)}, {result.ended:%Y-%m-%d %H:%M} UTC{failure}"
        + (table("<th>limit<th class=n>found<th class=n>at most<th><th>", limits) if limits else "")
        + (table("<th>asked<th>answer", answers) if answers else "")
        + (f"<ul>{remarks}</ul>" if remarks else "")
        + f"<details><summary>devices and settings</summary>{table('<th><th>', settings)}</details>"
    )
