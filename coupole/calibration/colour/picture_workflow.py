"""Reads a chart in plain pictures: from linear pictures to signals of the patches under even light.

The light over the chart comes from a picture of a white card in its place, or is found with the matrix from the
patches (`picture_light`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.colour.chart import Chart, KnownChart
from coupole.calibration.colour.chart_pictures import (
    PlacedChart,
    PlainPicture,
    PlainReading,
    place_chart,
    read_plain_patches,
)
from coupole.calibration.colour.chart_signals import COLOUR, ChartPicture, Reading, Signals, combined_signals
from coupole.calibration.colour.colour_workflow import Seen, balanced_of
from coupole.calibration.colour.drawing import ShownChart
from coupole.calibration.colour.image_quality import edges_of
from coupole.calibration.colour.picture_light import FoundLight, find_light, light_basis
from coupole.calibration.colour.slanted_edge import SlantedEdge
from coupole.calibration.light.records import Progress, counter
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

_GAMMA = (0.8, 1.25)
"""Slopes of the greys' logarithmic signals against their logarithmic luminance that count as linear. They leave
room for uneven light and stray light; sRGB's slope is 0.45."""
_LEAST_GREYS, _LEAST_RANGE = 3, 3.0
"""Least number of greys, and least ratio of their luminances, for a test of linearity."""
_ROUGH = 0.15
"""Largest departure of a white card's signals from a smooth light, in natural logarithms."""
_OFFSET_TOLD = 0.004
"""Signal of a perfect black, as a share of the perfect white's, from which it is reported."""
_TINT_TOLD, _TINT_REFUSED = 0.01, 0.05
"""Relative differences of the light's colour between pictures, from which they are reported and refused."""
_SHOWN_PX = 1200


@dataclass(frozen=True)
class SeenInPictures:
    """The chart as plain pictures show it."""

    sighting: Seen
    known_chart: KnownChart
    """The chart without patches that most pictures show badly."""


@dataclass(frozen=True)
class _ChartView:
    picture: PlainPicture
    place: PlacedChart
    plain: PlainReading

    @property
    def reading(self) -> Reading:
        return self.plain.reading


def see_in_pictures(
    pictures: Sequence[PlainPicture],
    known_chart: KnownChart,
    corners_px: Floats | None,
    white: PlainPicture | None,
    progress: Progress,
) -> SeenInPictures:
    """Read the chart in pictures of one camera under one light. The chart's place may differ between pictures.

    `corners_px` [4, 2] hold for all pictures. Raises InputError if no picture shows the chart, values are not
    linear, lights differ in colour, the white card is saturated or elsewhere, or too few patches are left.
    """
    _refuse_sizes(pictures, white)
    tell = counter(progress, len(pictures))
    views: list[_ChartView] = []
    remarks: list[str] = []
    for picture in pictures:
        try:
            place = place_chart(picture, known_chart, corners_px)
            polygons = place.polygons_px(known_chart.chart, known_chart.chart.patch_polygons_mm())
            plain = read_plain_patches(picture, polygons, known_chart.chart.patch_names)
        except InputError as error:
            if len(pictures) == 1:
                raise
            remarks.append(f"left out: {error}")
        else:
            views.append(_ChartView(picture, place, plain))
            if place.is_turned:
                remarks.append(f"{picture.name}: the chart is turned; its top left patch is at {_pixel(place)} px")
        tell()
    if not views:
        raise InputError(f"the chart was found in none of {len(pictures)} pictures; {remarks[0]}")
    kept_chart, views = _without_bad(known_chart, views, remarks)
    for view in views:
        _refuse_curved(view, kept_chart)
    _refuse_tints(views, kept_chart, remarks)
    names, labels = kept_chart.chart.patch_names, [view.picture.name for view in views]
    if white is None:
        sighting = _by_found_light(views, kept_chart, labels, remarks)
    else:
        lights, views = _by_white(views, kept_chart, white, remarks)
        sighting = Seen(
            combined_signals(names, [view.reading for view in views], lights, labels, are_pictures=True)
        )
    remarks += _offsets(sighting.signals, kept_chart)
    edges = _edges(views[0], kept_chart, remarks)
    shown_chart = _shown_chart(views[0], kept_chart)
    return SeenInPictures(
        replace(sighting, edges=edges, shown_chart=shown_chart, remarks=tuple(remarks)), kept_chart
    )


def _refuse_sizes(pictures: Sequence[PlainPicture], white: PlainPicture | None) -> None:
    first = pictures[0]
    for picture in (*pictures[1:], *(() if white is None else (white,))):
        if picture.size_px != first.size_px:
            raise InputError(
                f"{picture.name}: {picture.size_px[0]} x {picture.size_px[1]} pixels, {first.name} has "
                f"{first.size_px[0]} x {first.size_px[1]}; expected pictures of one camera"
            )


def _pixel(place: PlacedChart) -> str:
    x, y = place.corners_px[0]
    return f"{x:.0f},{y:.0f}"


def _without_bad(
    known_chart: KnownChart, views: Sequence[_ChartView], remarks: list[str]
) -> tuple[KnownChart, list[_ChartView]]:
    """Return chart and readings without patches that are saturated, uneven or dark in most pictures. All of these
    are reported."""
    names = known_chart.chart.patch_names
    full = np.stack([view.reading.full for view in views])
    uneven = np.stack([view.plain.uneven for view in views])
    dark = ~full & ~np.stack([(view.reading.mean > 0.0).all(axis=1) for view in views])
    for marks, fault in ((full, "saturated"), (uneven, "uneven (dust, gloss, a shadow's edge)"), (dark, "dark")):
        if bad_patches := [
            f"{view.picture.name} on {', '.join(np.array(names)[row])}"
            for view, row in zip(views, marks, strict=True)
            if row.any()
        ]:
            remarks.append(f"{fault}, and left out: {'; '.join(bad_patches)}")
    bad = full | uneven | dark
    leave_out = 2 * bad.sum(axis=0) > len(views)
    kept_chart = known_chart.without([name for name, out in zip(names, leave_out, strict=True) if out])
    return kept_chart, [
        replace(view, plain=_kept_patches(view.plain, row, ~leave_out))
        for view, row in zip(views, bad, strict=True)
    ]


def _kept_patches(plain: PlainReading, bad: NDArray[np.bool_], keep: NDArray[np.bool_]) -> PlainReading:
    reading = plain.reading
    kept_reading = Reading(reading.mean[keep], reading.u[keep], reading.pixel_sd[keep], bad[keep])
    return PlainReading(kept_reading, plain.uneven[keep])


def _refuse_curved(view: _ChartView, known_chart: KnownChart) -> None:
    """Raise InputError if the greys show a transfer curve, or if it cannot be shown that a picture of 8 bits is
    linear."""
    grey = [n for n in known_chart.neutral if not view.reading.full[n]]
    luminance = known_chart.xyz[grey, 1]
    if len(grey) < _LEAST_GREYS or luminance.max() < _LEAST_RANGE * luminance.min():
        if view.picture.levels == 256:
            raise InputError(
                f"{view.picture.name}: 8 bits, and the chart has too few greys to test whether the values are "
                "linear; give RAW, 16 bit or OpenEXR"
            )
        return
    slope = float(np.polyfit(np.log(luminance), np.log(view.reading.mean[grey, 1]), 1)[0])
    if not _GAMMA[0] < slope < _GAMMA[1]:
        raise InputError(
            f"{view.picture.name}: its values are not linear: on the greys they are proportional to light to the "
            f"power of {slope:.2f}, expected 1. Give RAW, a linear TIFF or OpenEXR, or merge several exposures "
            "with `coupole bracket`; --srgb is only for pictures with the curve of sRGB and no other curve, not "
            "for linear ones"
        )


def _refuse_tints(views: Sequence[_ChartView], known_chart: KnownChart, remarks: list[str]) -> None:
    """Raise InputError if the light's colour differs between pictures: a profile is valid for one light."""
    grey = list(known_chart.neutral)
    tints = []
    for view in views:
        good = [n for n in grey if not view.reading.full[n]]
        white = np.mean(view.reading.mean[good] / view.reading.mean[good, 1:2], axis=0)
        tints.append(white)
    apart = np.abs(np.array(tints) / tints[0] - 1.0).max(axis=1)
    worst = int(np.argmax(apart))
    words = f"{views[worst].picture.name}: its light differs in colour from the light of {views[0].picture.name}"
    if apart[worst] > _TINT_REFUSED:
        raise InputError(
            f"{words} by {apart[worst]:.0%}; a profile is valid for one light: calibrate for each light separately"
        )
    if apart[worst] > _TINT_TOLD:
        remarks.append(f"{words} by {apart[worst]:.1%}")


# -- the light over the chart ---------------------------------------------------------------------------------


def _by_white(
    views: Sequence[_ChartView], known_chart: KnownChart, white: PlainPicture, remarks: list[str]
) -> tuple[Floats, list[_ChartView]]:
    """Return [pictures, patches, 3], the card's signals, and readings that include the card's noise."""
    chart = known_chart.chart
    lights, noisy = [], []
    for view in views:
        polygons = view.place.polygons_px(chart, chart.patch_polygons_mm())
        plain = read_plain_patches(white, polygons, chart.patch_names)
        card = plain.reading
        if card.full.any() or plain.uneven.any() or not (card.mean > 0.0).all():
            faults = np.flatnonzero(card.full | plain.uneven | ~(card.mean > 0.0).all(axis=1))
            bad_patches = ", ".join(chart.patch_names[n] for n in faults[:8])
            raise InputError(
                f"--white {white.name}: saturated, dark or uneven where {view.picture.name} has the patches "
                f"{bad_patches}; expected a white card in the chart's place, exposed less"
            )
        _refuse_rough(white, card, chart)
        relative = card.u / card.mean
        u = np.sqrt(view.reading.u**2 + (view.reading.mean * relative) ** 2)
        noisy.append(replace(view, plain=replace(view.plain, reading=replace(view.reading, u=u))))
        lights.append(card.mean)
    spans = [float(np.ptp(np.log(light[:, 1]))) for light in lights]
    remarks.append(
        f"light over the chart by {white.name}: from patch to patch it differs by {np.expm1(max(spans)):.1%}"
    )
    return np.stack(lights), noisy


def _refuse_rough(white: PlainPicture, card: Reading, chart: Chart) -> None:
    """Raise InputError if the card's signals are not a smooth light."""
    light = np.log(card.mean)
    basis = np.column_stack([np.ones(len(light)), light_basis(chart.centres_mm)])
    smooth, *_ = np.linalg.lstsq(basis, light)
    worst = float(np.abs(light - basis @ smooth).max())
    if worst > _ROUGH:
        raise InputError(
            f"--white {white.name}: the light is not smooth: it departs by {worst:.0%} from patch to patch where "
            "the chart is; expected a white card that covers the chart's place, without shadows"
        )


def _by_found_light(
    views: Sequence[_ChartView], known_chart: KnownChart, labels: Sequence[str], remarks: list[str]
) -> Seen:
    names = known_chart.chart.patch_names
    basis = light_basis(known_chart.chart.centres_mm)
    readings = [view.reading for view in views]

    def signals_and_lights(without: int | None) -> tuple[Signals, list[FoundLight]]:
        lights = [_light_of(reading, known_chart, basis, without) for reading in readings]
        factors = np.stack([np.repeat(light.factor()[:, None], 3, axis=1) for light in lights])
        return combined_signals(names, readings, factors, labels, are_pictures=True), lights

    signals, lights = signals_and_lights(None)
    widest = max((light.span for light in lights), key=lambda span: span[0])
    remarks.append(
        f"light over the chart, with the lens's fall-off, found from the patches: it differs by {widest[0]:.1%} "
        f"(u {widest[1]:.1%}), and is corrected by a smooth factor; a picture of a white card (--white) is more "
        "reliable"
    )
    mean_covariance = np.mean([light.covariance for light in lights], axis=0)
    light_u = replace(lights[0], covariance=mean_covariance).effects()
    return Seen(signals, light_u=light_u, signals_without=[signals_and_lights(n)[0] for n in range(len(names))])


def _light_of(reading: Reading, known_chart: KnownChart, basis: Floats, without: int | None) -> FoundLight:
    """Find the light of one picture from its good patches, all or all but one."""
    patch_signals = balanced_of(Signals(reading.mean, reading.u, reading.pixel_sd, ()), known_chart)
    good = ~reading.full
    if without is not None:
        good[without] = False
    for patch in np.flatnonzero(~good)[::-1]:
        patch_signals = patch_signals.without(int(patch))
    return find_light(patch_signals, basis[good], basis)


def _offsets(signals: Signals, known_chart: KnownChart) -> list[str]:
    """Return a sentence if straight lines through the greys do not end at 0. Neither form of the profile can
    describe such an offset."""
    grey = list(known_chart.neutral)
    luminance = known_chart.xyz[grey, 1]
    if len(grey) < _LEAST_GREYS or luminance.max() < _LEAST_RANGE * luminance.min():
        return []
    weight = 1.0 / (0.02 + luminance)[:, None]
    line = np.column_stack([np.ones(len(grey)), luminance])
    (offset, slope), *_ = np.linalg.lstsq(line * weight, signals.mean[grey] * weight)
    share = offset / slope
    if np.abs(share).max() < _OFFSET_TOLD:
        return []
    words = ", ".join(f"{value:+.1%}" for value in share)
    return [
        f"the greys show an offset of {words} of white in red, green and blue: a black level that was not taken "
        "off, or stray light. The offset makes dark colours wrong, and the uncertainty does not include this "
        "error"
    ]


# -- beside the colours ---------------------------------------------------------------------------------------


def _edges(view: _ChartView, known_chart: KnownChart, remarks: list[str]) -> dict[str, tuple[SlantedEdge, ...]]:
    chart = known_chart.chart
    if not chart.edges:
        return {}
    polygons = view.place.polygons_px(chart, chart.edge_polygons_mm())
    full = np.repeat(view.picture.full[..., None], 3, axis=2)
    nothing = np.empty((0, 4, 2))
    values = view.picture.values.astype(np.float64)
    picture = ChartPicture(view.picture.name, values, full, COLOUR, nothing, polygons, np.ones(0))
    try:
        return edges_of(picture, [edge.name for edge in chart.edges])
    except InputError as error:
        remarks.append(f"sharpness is not stated: {error}")
        return {}


def _shown_chart(view: _ChartView, known_chart: KnownChart) -> ShownChart:
    values = np.nan_to_num(view.picture.values, nan=0.0)
    factor = max(1.0, max(values.shape[:2]) / _SHOWN_PX)
    size = (round(values.shape[1] / factor), round(values.shape[0] / factor))
    small = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
    grey = list(known_chart.neutral)
    brightest = view.reading.mean[grey[int(np.argmax(known_chart.xyz[grey, 1]))]]
    eye = np.clip(small / (1.1 * np.maximum(brightest, 1e-12)), 0.0, 1.0) ** (1.0 / 2.2)
    polygons = view.place.polygons_px(known_chart.chart, known_chart.chart.patch_polygons_mm())
    return ShownChart(
        np.asarray(eye, np.float64),
        (polygons + 0.5) / factor - 0.5,
        known_chart.chart.patch_names,
        view.picture.name,
    )
