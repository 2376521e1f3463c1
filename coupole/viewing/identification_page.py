"""`identification.html`: what identified spectra show, and which bands say so."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coupole.appearance.spectra.grid import Array
from coupole.errors import StorageError, reason
from coupole.heritage.analysis.identification import Evidence, PigmentFinding
from coupole.heritage.analysis.references import HeldOutRates
from coupole.storage.durable import write_synced
from coupole.viewing.page_parts import facts, page, section, table, text

PAGE = "identification.html"
_CANDIDATES = 6
_WIDTH, _LEFT, _CURVES, _BARS = 720.0, 46.0, 240.0, 110.0
_HEIGHT = _CURVES + _BARS + 60.0
_SIGNS = {"match": "ok", "mixture": "ok", "ambiguous": "stopped", "unknown": "stopped"}


def write(folder: Path, findings: list[PigmentFinding], library: str) -> Path:
    """Write the page of findings that share a library. Raises StorageError."""
    path = folder / PAGE
    parts = [
        section(f"s{number}", text(finding.name), _of_one(finding)) for number, finding in enumerate(findings)
    ]
    heading = "Identification of pigments"
    body = f"<h1>{heading}</h1><p>Library: <code>{text(library)}</code></p>"
    if len(findings) > 1:
        body += table(
            "Spectra",
            ("spectrum", "verdict", "class", "probability"),
            [
                (
                    f'<a href="#s{number}">{text(finding.name)}</a>',
                    _verdict(finding),
                    text(finding.class_name),
                    _percent(finding),
                )
                for number, finding in enumerate(findings)
            ],
        )
    body += "".join(parts) + section("library", "What the verdicts are worth", _worth(findings[-1].rates))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_synced(path, page(heading, body))
    except OSError as error:
        raise StorageError(f"{path}: {reason(error)}") from error
    return path


def _of_one(finding: PigmentFinding) -> str:
    nm = finding.evidence.wavelengths_nm
    second = finding.candidates[1].class_name
    best = finding.candidates[0]
    extent = f"{nm[0]:g} to {nm[-1]:g} nm{', near infrared too' if finding.near_infrared else ''}"
    body = facts(
        {
            "verdict": _verdict(finding),
            "why": text(finding.reason),
            "compared": "; ".join(map(text, (extent, *finding.remarks))),
            "not in the library": f"{finding.not_in_library:.0%}",
        }
    )
    body += table(
        "Parts of the mixture",
        ("class", "reference", "share of K/S"),
        [(text(part.class_name), text(part.name), f"{part.share:.0%}") for part in finding.parts],
    )
    body += table(
        "Most probable classes",
        ("class", "probability", "nearest reference"),
        [
            (text(candidate.class_name), f"{candidate.probability:.1%}", text(candidate.name))
            for candidate in finding.candidates[:_CANDIDATES]
        ],
    )
    return body + (
        f"<figure>{_evidence_svg(finding.evidence, best.class_name, second)}<figcaption>Above: the spectrum "
        f"(solid), the nearest reference of {text(best.class_name)} (long dashes) and of {text(second)} (short "
        "dashes), their K/S by the factors that suit best. Below: what each band says, upwards for the first "
        "class, downwards for the second, in units of the spread within classes.</figcaption></figure>"
    )


def _verdict(finding: PigmentFinding) -> str:
    return f'<span class="{_SIGNS[finding.verdict]}">{finding.verdict}</span>'


def _percent(finding: PigmentFinding) -> str:
    return f"{finding.candidates[0].probability:.0%}"


def _worth(rates: HeldOutRates) -> str:
    return (
        "<p>Each spectrum of the library was identified as if the library lacked it, and as if it lacked its "
        "class. In brackets are 95 % intervals (Clopper and Pearson). Another instrument, binder or ground does "
        "worse.</p>"
    ) + facts(
        {
            "first class right": text(rates.right),
            "match, right": text(rates.matches),
            "match, wrong": text(rates.false_matches),
            "unknown, class left out": text(rates.unknown),
        }
    )


def _evidence_svg(evidence: Evidence, best: str, second: str) -> str:
    nm = evidence.wavelengths_nm
    curves = (evidence.reflectance, evidence.best, evidence.runner_up)
    highest = max(0.1, 1.05 * max(float(curve.max()) for curve in curves))
    x = _LEFT + (_WIDTH - _LEFT - 10.0) * (nm - nm[0]) / (nm[-1] - nm[0])
    lines = [
        f'<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" fill="currentColor" font-size="12" '
        f'aria-label="Reflectance, and evidence by wavelength for {text(best)} against {text(second)}">'
    ]
    for curve, name, dashes in zip(curves, "YBR", ("", "9 4", "3 3"), strict=True):
        points = _points(x, 10.0 + _CURVES * (1.0 - curve / highest))
        lines.append(f'<polyline class="{name}" stroke-dasharray="{dashes}" points="{points}"/>')
    lines += [
        _label(_LEFT - 6, 10 + _CURVES * (1 - tick / highest) + 4, f"{tick:.0%}") for tick in _ticks(highest)
    ]
    middle = 30.0 + _CURVES + _BARS / 2
    lines.append(f'<line x1="{_LEFT:g}" x2="{_WIDTH - 10:g}" y1="{middle:g}" y2="{middle:g}"/>')
    strongest = max(1.0, float(np.abs(evidence.log_odds).max()))
    width = 0.8 * (_WIDTH - _LEFT - 10.0) / len(nm)
    for at, odds in zip(x, evidence.log_odds / strongest * _BARS / 2, strict=True):
        top, colour = (middle - odds, "b") if odds > 0.0 else (middle, "r")
        lines.append(
            f'<rect x="{at - width / 2:.1f}" y="{top:.1f}" width="{width:.1f}" height="{abs(odds):.1f}" '
            f'fill="var(--{colour})"/>'
        )
    lines.append(_label(_LEFT - 6, middle - _BARS / 2 + 10, f"{strongest:.0f}"))
    lines.append(_label(_LEFT - 6, middle + _BARS / 2, f"-{strongest:.0f}"))
    step = 50.0 if nm[-1] - nm[0] < 600.0 else 200.0
    for tick in np.arange(np.ceil(nm[0] / step) * step, nm[-1] + 1.0, step):
        at = _LEFT + (_WIDTH - _LEFT - 10.0) * (tick - nm[0]) / (nm[-1] - nm[0])
        lines.append(_label(at, _HEIGHT - 8, f"{tick:g}{' nm' if tick + step > nm[-1] else ''}", "middle"))
    return "".join(lines) + "</svg>"


def _points(x: Array, y: Array) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


def _ticks(highest: float) -> list[float]:
    step = next(step for step in (0.02, 0.05, 0.1, 0.2, 0.5) if highest / step <= 6.0 or step == 0.5)
    return [float(tick) for tick in np.arange(0.0, highest, step)]


def _label(x: float, y: float, words: str, anchor: str = "end") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{words}</text>'
