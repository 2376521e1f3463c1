"""Sections of a run's report about its pictures: exposure, coverage of the mesh, and the pictures."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from coupole.pages.page_parts import Drawing, Inline, Legend, Link, Picture, Section, Shape, Table, Verdict, anchor
from coupole.preflight.framing import SHARP_PX
from coupole.viewing.progress import OVER_EXPOSED, UNDER_EXPOSED
from coupole.viewing.raw_preview import BINS
from coupole.viewing.run_coverage import MOST, Coverage
from coupole.viewing.run_sample import SampledExposure, SampledView
from coupole.viewing.view_colours import css, of_share

_WIDTH, _HEIGHT = 192, 56
_SPOKEN = {"R": "red", "G": "green", "B": "blue", "Y": "grey"}
_MOST_FIRST = 3
"""Number of views at the top of the page."""


def first_pictures(views: Iterable[SampledView]) -> list[Picture]:
    """Return the first views. A view is shown as the mean of its pictures, as if many lights were on together."""
    with_pictures = [view for view in views if view.pictures][:_MOST_FIRST]
    return [
        Picture(f"{view.name}: mean of {len(view.pictures)} pictures, each under one LED", _mean(view), "jpeg")
        for view in with_pictures
    ]


def _mean(view: SampledView) -> bytes:
    """Return the mean of a view's pictures as a JPEG. The brightest two hundredth of the pixels are white."""
    from PIL import Image

    total: NDArray[np.float64] | None = None
    for _, data in view.pictures:
        with Image.open(io.BytesIO(data)) as picture:
            pixels = np.asarray(picture.convert("RGB"), np.float64)
        total = pixels if total is None else total + pixels
    assert total is not None
    white = max(float(np.quantile(total, 0.995)), 1.0)
    buffer = io.BytesIO()
    Image.fromarray(np.rint(255 * np.clip(total / white, 0, 1)).astype(np.uint8)).save(buffer, "JPEG", quality=88)
    return buffer.getvalue()


def exposure_in_words(views: Sequence[SampledView]) -> str:
    """Return how many views are well, over- and under-exposed; empty without pictures."""
    verdicts = [verdict for view in views if (verdict := view.verdict())]
    counts = {verdict: verdicts.count(verdict) for verdict in ("well exposed", "over-exposed", "under-exposed")}
    phrases = [f"{count} of {len(verdicts)} views {verdict}" for verdict, count in counts.items() if count]
    return ", ".join(phrases)


def exposures(views: Sequence[SampledView], scaling: str) -> Section:
    """Return a row for each exposure of each view. `scaling` says how a simulated cell chose its light; it is
    empty for a real cell."""
    rows: list[Sequence[Inline]] = [
        (
            Link(f"#view-{anchor(view.name)}", view.name),
            f"{exposure.exposure_us / 1e3:g} ms",
            f"{exposure.sample.pictures} of {exposure.frames}",
            f"{exposure.sample.brightest:.0%}",
            f"{exposure.sample.saturated_share:.2%}" + (f", {exposure.worst}" if exposure.worst else ""),
            _histogram(view.name, exposure),
            exposure.sample.verdict(),
        )
        for view in views
        for exposure in view.exposures
        if exposure.sample.pictures
    ]
    if not rows:
        return Section("exposure", "Exposure")
    head = ("view", "exposure", "pictures looked at", "brightest", "saturated", "histogram", "verdict")
    colours = {name for view in views for exposure in view.exposures for name in exposure.histograms}
    lines = ", ".join(f"{_SPOKEN.get(name, name)}" for name in sorted(colours, key="RGBY".find))
    return Section(
        "exposure",
        "Exposure",
        words=[f"The light is simulated: {scaling}. The exposure in a real cell may differ."] if scaling else [],
        tables=[Table("Exposure of each view, by pictures spread over its lights", head, rows)],
        notes=[
            "Brightest: the highest 99.9 % quantile of a picture, as a share of full scale above black. "
            "Saturated: the largest share of a picture's pixels at full scale, and the shot that has it. "
            f"Over-exposed: more than {OVER_EXPOSED:.1%} saturated; under-exposed: the brightest of half of the "
            f"pictures is below {UNDER_EXPOSED:.0%}. Histograms: pixels (logarithmic) from 0 to full scale, "
            f"{lines}; dashed: black."
        ],
    )


def _histogram(view: str, exposure: SampledExposure) -> Drawing:
    most = math.log1p(max((int(counts.max()) for counts in exposure.histograms.values()), default=1)) or 1.0
    shapes = []
    for name, counts in exposure.histograms.items():
        heights = _HEIGHT * (1 - np.log1p(counts) / most)
        points = " ".join(f"{(n + 0.5) * _WIDTH / BINS:.1f},{y:.1f}" for n, y in enumerate(heights))
        shapes.append(Shape("polyline", {"class": name, "points": points}))
    black = round(exposure.black_share * _WIDTH, 1)
    shapes.append(Shape("line", {"x1": black, "x2": black, "y1": 0, "y2": _HEIGHT}))
    title = f"Histogram of view {view} at {exposure.exposure_us / 1e3:g} ms"
    return Drawing(title, _WIDTH, _HEIGHT, shapes, most_px=_WIDTH)


def coverage_in_words(coverage: Coverage) -> str:
    """Return the share of the surface that is in at least one picture."""
    return f"{coverage.shares[0]:.0%} of the surface that can be seen from above the disk is in a view"


def coverages(coverage: Coverage) -> Section:
    """Return shares of the surface by number of views, drawings, and each view's share of the object."""
    size = " x ".join(
        f"{high - low:.0f}"
        for low, high in zip(coverage.placement.low_mm, coverage.placement.high_mm, strict=True)
    )
    at_least = ", ".join(
        f"{share:.0%} in {'one view' if n == 0 else f'{n + 1} views'} or more"
        for n, share in enumerate(coverage.shares)
    )
    near, far = coverage.sharp_mm
    return Section(
        "coverage",
        "Coverage of the object",
        figures=[
            Picture(whence, data, alternative=f"The object {whence}, coloured by the number of views")
            for whence, data in coverage.drawings.items()
        ],
        figure_size="medium",
        legend=_legend(),
        facts={
            "surface": f"{at_least}; of the surface that can be seen from above the disk "
            f"({coverage.reachable:.0%} of all)",
            "object": f"{size} mm",
            "sharp": f"{near:.0f} mm to {f'{far:.0f} mm' if math.isfinite(far) else 'infinity'} from the lens "
            f"(blurred over at most {SHARP_PX:g} pixels)",
        },
        tables=[Table("How much of the object each view shows", _FRAMED, list(_framings(coverage)))],
        notes=[
            "Computed from the mesh, the measured poses and the rig's lens. The computation does not consider "
            "whether the arm hides a point, nor which lights reach the point."
        ],
    )


_FRAMED = ("view", "object in field", "of the field", "mm away", "sharp", "px per mm")


def _framings(coverage: Coverage) -> Iterable[Sequence[str]]:
    for view in coverage.views:
        away = f"{view.nearest_mm:.0f} to {view.farthest_mm:.0f}" if math.isfinite(view.nearest_mm) else "-"
        scale = f"{view.px_per_mm[0]:.1f} to {view.px_per_mm[1]:.1f}" if math.isfinite(view.px_per_mm[0]) else "-"
        shares = f"{view.in_field:.0%}", f"{view.fills:.0%}"
        yield view.view, *shares, away, f"{view.in_focus:.0%}", scale


def _legend() -> Legend:
    names = ("no view", "1 view", *(f"{n} views" for n in range(2, MOST)), f"{MOST} views or more")
    return Legend({name: css(of_share(n / MOST)) for n, name in enumerate(names)})


def pictures(views: Iterable[SampledView]) -> Section:
    """Return the sampled pictures of each view. If a view's file cannot be read, its picture is replaced by a
    sentence."""
    parts = [
        Section(
            f"view-{anchor(view.name)}",
            view.name,
            words=[Verdict(view.trouble, "bad")] if view.trouble else [],
            figures=[Picture(shot, data, "jpeg") for shot, data in view.pictures],
            figure_size="small",
        )
        for view in views
    ]
    words = ["Previews; saturated pixels are red."] if parts else []
    return Section("pictures", "Pictures", words=words, sections=parts)
