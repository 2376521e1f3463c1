"""Sections of a run's report about what its pictures show: exposure, coverage of the mesh, the pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from coupole.preflight.framing import SHARP_PX
from coupole.viewing.page_parts import anchor, facts, picture, table, text
from coupole.viewing.progress import OVER_EXPOSED, UNDER_EXPOSED
from coupole.viewing.raw_preview import BINS
from coupole.viewing.run_coverage import MOST, Coverage
from coupole.viewing.run_sample import SampledExposure, SampledView
from coupole.viewing.view_colours import css, of_share

_WIDTH, _HEIGHT = 192, 56
_SPOKEN = {"R": "red", "G": "green", "B": "blue", "Y": "grey"}


def exposure_in_words(views: Sequence[SampledView]) -> str:
    """Return how many views are well, over- and under-exposed; empty without pictures."""
    verdicts = [verdict for view in views if (verdict := view.verdict())]
    counts = {verdict: verdicts.count(verdict) for verdict in ("well exposed", "over-exposed", "under-exposed")}
    phrases = [f"{count} of {len(verdicts)} views {verdict}" for verdict, count in counts.items() if count]
    return ", ".join(phrases)


def exposures(views: Sequence[SampledView], scaling: str) -> str:
    """A row for each exposure of each view. `scaling`: how a simulated cell chose its light; else empty."""
    rows = [
        (
            f'<a href="#view-{anchor(view.name)}">{text(view.name)}</a>',
            f"{exposure.exposure_us / 1e3:g} ms",
            f"{exposure.sample.pictures} of {exposure.frames}",
            f"{exposure.sample.brightest:.0%}",
            f"{exposure.sample.saturated_share:.2%}" + (f"<br>{text(exposure.worst)}" if exposure.worst else ""),
            _histogram(view.name, exposure),
            exposure.sample.verdict(),
        )
        for view in views
        for exposure in view.exposures
        if exposure.sample.pictures
    ]
    if not rows:
        return ""
    head = ("view", "exposure", "pictures looked at", "brightest", "saturated", "histogram", "verdict")
    colours = {name for view in views for exposure in view.exposures for name in exposure.histograms}
    lines = ", ".join(f"{_SPOKEN.get(name, name)}" for name in sorted(colours, key="RGBY".find))
    remark = f"<p>The light is simulated: {text(scaling)}. A real cell's may differ.</p>" if scaling else ""
    return (
        remark
        + table("Exposure of each view, by pictures spread over its lights", head, rows)
        + '<p class="note">Brightest: the highest 99.9 % quantile of a picture, as a share of full scale above '
        "black. Saturated: the largest share of a picture's pixels at full scale, and the shot that has it. "
        f"Over-exposed: more than {OVER_EXPOSED:.1%} saturated; under-exposed: the brightest of half of the "
        f"pictures is below {UNDER_EXPOSED:.0%}. Histograms: pixels (logarithmic) "
        f"from 0 to full scale, {lines}; dashed: black.</p>"
    )


def _histogram(view: str, exposure: SampledExposure) -> str:
    most = math.log1p(max((int(counts.max()) for counts in exposure.histograms.values()), default=1)) or 1.0
    lines = []
    for name, counts in exposure.histograms.items():
        heights = _HEIGHT * (1 - np.log1p(counts) / most)
        points = " ".join(f"{(n + 0.5) * _WIDTH / BINS:.1f},{y:.1f}" for n, y in enumerate(heights))
        lines.append(f'<polyline class="{name}" points="{points}"/>')
    black = exposure.black_share * _WIDTH
    lines.append(f'<line x1="{black:.1f}" x2="{black:.1f}" y1="0" y2="{_HEIGHT}"/>')
    caption = f"Histogram of view {view} at {exposure.exposure_us / 1e3:g} ms"
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" height="{_HEIGHT}" role="img" '
        f'aria-label="{text(caption)}">{"".join(lines)}</svg>'
    )


def coverage_in_words(coverage: Coverage) -> str:
    """The share of the surface that is in the pictures at all."""
    return f"{coverage.shares[0]:.0%} of the surface that can be seen from above the disk is in a view"


def coverages(coverage: Coverage) -> str:
    """Shares of the surface by number of views, drawings, and what each view has of the object."""
    size = " x ".join(
        f"{high - low:.0f}"
        for low, high in zip(coverage.placement.low_mm, coverage.placement.high_mm, strict=True)
    )
    at_least = ", ".join(
        f"{share:.0%} in {'one view' if n == 0 else f'{n + 1} views'} or more"
        for n, share in enumerate(coverage.shares)
    )
    near, far = coverage.sharp_mm
    drawings = "".join(
        f"<figure>{picture('png', data, f'The object {whence}, coloured by the number of views')}"
        f"<figcaption>{whence}</figcaption></figure>"
        for whence, data in coverage.drawings.items()
    )
    return (
        facts(
            {
                "surface": f"{at_least}; of what can be seen from above the disk ({coverage.reachable:.0%} of "
                "all)",
                "object": f"{size} mm",
                "sharp": f"{near:.0f} mm to {f'{far:.0f} mm' if math.isfinite(far) else 'infinity'} from the lens "
                f"(blurred over at most {SHARP_PX:g} pixels)",
            }
        )
        + f'<div class="drawings">{drawings}</div>{_legend()}'
        + table("What each view has of the object", _FRAMED, _framings(coverage))
        + '<p class="note">By the mesh, the measured poses and the rig\'s lens. Of the arm, which may stand in a '
        "view's way, nothing is counted; nor which lights reach a point.</p>"
    )


_FRAMED = ("view", "object in field", "of the field", "mm away", "sharp", "px per mm")


def _framings(coverage: Coverage) -> Iterable[Sequence[str]]:
    for view in coverage.views:
        away = f"{view.nearest_mm:.0f} to {view.farthest_mm:.0f}" if math.isfinite(view.nearest_mm) else "-"
        scale = f"{view.px_per_mm[0]:.1f} to {view.px_per_mm[1]:.1f}" if math.isfinite(view.px_per_mm[0]) else "-"
        shares = f"{view.in_field:.0%}", f"{view.fills:.0%}"
        yield text(view.view), *shares, away, f"{view.in_focus:.0%}", scale


def _legend() -> str:
    names = ("no view", "1 view", *(f"{n} views" for n in range(2, MOST)), f"{MOST} views or more")
    items = "".join(
        f'<li><span class="swatch" style="background:{css(of_share(n / MOST))}"></span>{name}</li>'
        for n, name in enumerate(names)
    )
    return f'<ul class="legend">{items}</ul>'


def pictures(views: Iterable[SampledView]) -> str:
    """The sampled pictures of each view; a view whose file cannot be read says so."""
    parts = []
    for view in views:
        heading = f'<h3 id="view-{anchor(view.name)}">{text(view.name)}</h3>'
        figures = "".join(
            f"<figure>{picture('jpeg', data, shot)}<figcaption>{text(shot)}</figcaption></figure>"
            for shot, data in view.pictures
        )
        trouble = f"<p class=bad>{text(view.trouble)}</p>" if view.trouble else ""
        parts.append(f'{heading}{trouble}<div class="pictures">{figures}</div>')
    return '<p class="note">Previews; saturated pixels are red.</p>' + "".join(parts) if parts else ""
