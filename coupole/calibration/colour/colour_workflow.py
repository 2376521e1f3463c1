"""Makes the record of a colour profile from a chart's signals."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from coupole.calibration.acceptance import against_limits
from coupole.calibration.artefact import used_as
from coupole.calibration.colour.acceptance import COLOUR
from coupole.calibration.colour.chart import KnownChart
from coupole.calibration.colour.chart_signals import ChartPicture, Reading, Signals, combined_signals, read_patches
from coupole.calibration.colour.chart_views import ChartReader, ChartSetting, key_of, mean_picture, white_of
from coupole.calibration.colour.colorimetry import de00, lab_of
from coupole.calibration.colour.colour_profile import (
    FORMS,
    Balanced,
    Form,
    LeftOut,
    Profile,
    better,
    covariance_of,
    fit_profile,
    leave_out,
)
from coupole.calibration.colour.drawing import ShownChart, draw_colour
from coupole.calibration.colour.icc_profile import icc_profile
from coupole.calibration.colour.image_quality import (
    Figure,
    colour_figures,
    edge_figures,
    edges_of,
    noise_figures,
    sentence_of,
    tone_figures,
    uniformity_figure,
)
from coupole.calibration.colour.slanted_edge import SlantedEdge
from coupole.calibration.light.frames import CHANNELS, LightFrames, PlainSources
from coupole.calibration.light.radiometric_record import Findings, sealed_outcome
from coupole.calibration.light.records import Progress, counter
from coupole.calibration.record import Parameter
from coupole.calibration.report import Outcome
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats
from coupole.errors import InputError
from coupole.pages.page_parts import Section, Table

MATRIX = "xyz_d50_from_balanced."
"""First part of the name of each coefficient of the matrix. X, Y or Z follows, then r, g or b."""
_TERMS = ("r", "g", "b", "sqrt_rg", "sqrt_rb", "sqrt_gb")
_MOST_EDGE_PICTURES = 8
_SHARE = 0.95
"""Share of further colours for which a bound of the error is stated."""


@dataclass(frozen=True)
class Seen:
    """Signals and edges seen on the chart, and a picture of the white sheet if there is one."""

    signals: Signals
    edges: Mapping[str, Sequence[SlantedEdge]] = field(default_factory=dict)
    white: ChartPicture | None = None
    light_u: Floats | None = None
    """Errors of the light, as in `Balanced.light_u`."""
    signals_without: Sequence[Signals] | None = None
    """Signals of all patches, once for each patch, under a light that was found without that patch. None if the
    light is known."""
    shown_chart: ShownChart | None = None
    """The chart in a plain picture."""
    remarks: tuple[str, ...] = ()
    """Sentences about plain pictures: patches that were left out, turned pictures, and the light that was
    found."""


@dataclass(frozen=True)
class Origin:
    """Sources of the record."""

    sources: LightFrames | PlainSources
    size_px: tuple[int, int]
    """Width and height of the pictures."""
    inputs: tuple[tuple[str, str], ...]
    """Name and SHA-256 of further files."""


def see_in_runs(frames: LightFrames, setting: ChartSetting, white: LightFrames | None, progress: Progress) -> Seen:
    """Read the chart in runs, under all suitable lights. `white` are frames of a white sheet in its place. Raises
    InputError if white frames are missing, and like `combined_signals` and `edges_of`."""
    reader = ChartReader(frames, setting)
    names = setting.chart.patch_names
    whites = {} if white is None else white_of(white, setting)
    tell = counter(progress, len(reader.suitable_frames()))
    readings: list[Reading] = []
    lights: list[Floats] = []
    lit: list[str] = []
    sharp: list[ChartPicture] = []
    for frame, picture in reader.pictures():
        if white is None:
            lights.append(np.repeat(picture.light[:, None], 3, axis=1))
        elif key_of(frame) not in whites:
            raise InputError(f"--white: has no frame of {' under '.join(key_of(frame))}; acquire the same plan")
        else:
            lights.append(read_patches(replace(whites[key_of(frame)], patches_px=picture.patches_px), names).mean)
        readings.append(read_patches(picture, names))
        lit.append(str(frame.shot.light))
        if setting.chart.edges and len(sharp) < _MOST_EDGE_PICTURES and frame.view == frames.lit[0].view:
            sharp.append(picture)
        tell()
    signals = combined_signals(names, readings, np.stack(lights), lit)
    edges = edges_of(mean_picture(sharp), [edge.name for edge in setting.chart.edges]) if sharp else {}
    return Seen(signals, edges, next(iter(whites.values()), None))


@dataclass(frozen=True)
class _Made:
    """Both forms of the profile, and the chosen one."""

    profiles: Mapping[Form, Profile]
    left_out: Mapping[Form, LeftOut]
    form: Form

    @property
    def chosen_profile(self) -> Profile:
        return self.profiles[self.form]

    @property
    def left_out_errors(self) -> LeftOut:
        return self.left_out[self.form]


def colour_outcome(
    measurements: Seen,
    known_chart: KnownChart,
    origin: Origin,
    request: Request,
    progress: Progress,
) -> Outcome:
    """Return the record of a profile. Beside it are the profile as an ICC file and a table of the patches."""
    forms, balanced_signals = make_profiles(measurements, known_chart, progress)
    lab = lab_of(forms.chosen_profile.xyz(balanced_signals.signal))
    figures = figures_of(measurements, known_chart, forms, balanced_signals, lab)
    covariances = covariance_of(balanced_signals, forms.profiles["matrix"])
    edges = [(name, colours[1]) for name, colours in measurements.edges.items()]
    outcome = sealed_outcome(
        "colour",
        request,
        origin.sources,
        origin.size_px,
        Findings(
            _parameters(forms.profiles["matrix"], covariances, len(balanced_signals.signal)),
            np.asarray(sum(covariances)),
            limits=against_limits(
                COLOUR, request.limits, {"mean": forms.left_out_errors.mean, "worst": forms.left_out_errors.worst}
            ),
            files={
                f"{request.name}.icc": icc_profile(
                    forms.chosen_profile, forms.profiles["matrix"], request.name, request.now
                ),
                f"{request.name}.csv": _patch_table(known_chart, balanced_signals, forms, lab).encode(),
            },
            fixed_figures=_fixed_figures(forms, figures),
            remarks=(
                _choice_remark(forms),
                *(sentence_of(figure) for figure in figures),
                *measurements.signals.remarks,
                *measurements.remarks,
            ),
            more_inputs=origin.inputs,
            artefacts=used_as("chart", known_chart.chart.artefact),
        ),
        partial(draw_colour, known_chart, lab, forms.left_out_errors.de, edges, measurements.shown_chart),
    )
    return replace(outcome, sections=[_patch_section(known_chart, forms, lab)])


def balanced_of(signals: Signals, known_chart: KnownChart, light_u: Floats | None = None) -> Balanced:
    """Return the signals with the colours of their patches."""
    chart = known_chart.chart
    return Balanced(signals.mean, signals.u, known_chart.xyz, chart.u_lab, known_chart.neutral, light_u=light_u)


def make_profiles(measurements: Seen, known_chart: KnownChart, progress: Progress) -> tuple[_Made, Balanced]:
    """Return both forms with their errors on left-out patches."""
    balanced_signals = balanced_of(measurements.signals, known_chart, measurements.light_u)
    seen_without = (
        None
        if measurements.signals_without is None
        else [balanced_of(signals, known_chart) for signals in measurements.signals_without]
    )
    tell: Callable[[], None] = counter(progress, len(FORMS) * len(balanced_signals.signal))
    profiles = {form: fit_profile(balanced_signals, form) for form in FORMS}
    de00_of = {form: leave_out(balanced_signals, form, tell, seen_without) for form in FORMS}
    return _Made(profiles, de00_of, better(de00_of["matrix"], de00_of["root-polynomial"])), balanced_signals


def figures_of(
    measurements: Seen, known_chart: KnownChart, profile_choice: _Made, patch_signals: Balanced, lab: Floats
) -> list[Figure]:
    """Return all figures of image quality that these pictures give."""
    figures = colour_figures(profile_choice.left_out_errors.de)
    figures += tone_figures(lab, known_chart.lab, known_chart.neutral)
    figures += noise_figures(
        patch_signals.signal, measurements.signals.pixel_sd, profile_choice.chosen_profile, known_chart.neutral
    )
    if measurements.edges:
        figures += edge_figures(measurements.edges)
    if measurements.white is not None:
        figures.append(uniformity_figure(measurements.white))
    return figures


def _choice_remark(profile_choice: _Made) -> str:
    errors = "; ".join(
        f"{form}: mean {form_de00.mean:.2f}, 95 % {form_de00.quantile(0.95):.2f}, largest {form_de00.worst:.2f}"
        for form, form_de00 in profile_choice.left_out.items()
    )
    bound, share = profile_choice.left_out_errors.bound(_SHARE)
    return (
        f"CIEDE2000 of patches left out: {errors}. The ICC profile has the {profile_choice.form}; {share:.0%} of "
        f"colours like the chart's have an error of at most {bound:.2f} by it"
    )


def _patch_section(known_chart: KnownChart, profile_choice: _Made, lab: Floats) -> Section:
    de_used = de00(lab, known_chart.lab)
    rows = [
        (name, *(f"{value:.1f}" for value in (*true, *seen_lab)), f"{with_it:.2f}", f"{without_it:.2f}")
        for name, true, seen_lab, with_it, without_it in zip(
            known_chart.chart.patch_names,
            known_chart.lab,
            lab,
            de_used,
            profile_choice.left_out_errors.de,
            strict=True,
        )
    ]
    head = ("patch", "L*", "a*", "b*", "L* found", "a* found", "b* found", "dE00", "dE00, left out")
    caption = (
        f"Patches by the {profile_choice.form}, under D50; the last column by a profile made without the patch"
    )
    return Section("patches", "Patches", tables=[Table(caption, head, rows)])


def _parameters(matrix: Profile, covariances: Sequence[Floats], patches: int) -> list[Parameter]:
    """Return the matrix's coefficients, row by row."""
    parameters = []
    origins = ("noise of signals", "patches' own values", "light over the chart")
    for n, (axis, channel) in enumerate((axis, channel) for axis in "XYZ" for channel in "rgb"):
        variances = [float(covariance[n, n]) for covariance in covariances]
        parameters.append(
            Parameter(
                name=f"{MATRIX}{axis}{channel}",
                value=float(matrix.coefficients[n // 3, n % 3]),
                u=float(np.sqrt(sum(variances))),
                degrees_of_freedom=float(3 * patches - 6),
                dominated_by=origins[int(np.argmax(variances))],
            )
        )
    return parameters


def _fixed_figures(profile_choice: _Made, figures: Sequence[Figure]) -> dict[str, float]:
    """Return the balance, DNG's matrix, the root-polynomial, errors and figures."""
    matrix, roots = profile_choice.profiles["matrix"], profile_choice.profiles["root-polynomial"]
    white = matrix.white_signal
    fixed_figures = {
        f"neutral.{channel}": float(w) for channel, w in zip(CHANNELS, white / white.max(), strict=True)
    }
    to_camera = (white / white.max())[:, None] * np.linalg.inv(matrix.coefficients)
    fixed_figures |= {
        f"dng_color_matrix.{channel}{axis}": float(to_camera[c, a])
        for c, channel in enumerate("rgb")
        for a, axis in enumerate("XYZ")
    }
    fixed_figures |= {
        f"root_polynomial.{axis}.{term}": float(roots.coefficients[a, t])
        for a, axis in enumerate("XYZ")
        for t, term in enumerate(_TERMS)
    }
    for form, form_de00 in profile_choice.left_out.items():
        fixed_figures |= {
            f"left_out.{form}.mean_de00": form_de00.mean,
            f"left_out.{form}.q95_de00": form_de00.quantile(0.95),
            f"left_out.{form}.worst_de00": form_de00.worst,
            f"left_out.{form}.bound_de00": form_de00.bound(_SHARE)[0],
            "left_out.bound_share": form_de00.bound(_SHARE)[1],
        }
    return fixed_figures | {f"figure.{figure.name}": figure.value for figure in figures}


def _patch_table(known_chart: KnownChart, patch_signals: Balanced, profile_choice: _Made, lab: Floats) -> str:
    """Return CSV with, for each patch, its balanced channels, its L*a*b* on the chart and from the profile, and
    CIEDE2000 with and without it."""
    text = io.StringIO()
    text.write("# channels: the perfect white has 1; L*, a*, b* under D50, 1931 observer\n")
    text.write("patch,r,g,b,u_r,u_g,u_b,L,a,b_star,L_found,a_found,b_found,de00,de00_left_out\n")
    white = profile_choice.chosen_profile.white_signal
    table = np.column_stack(
        [
            patch_signals.signal / white,
            patch_signals.u / white,
            known_chart.lab,
            lab,
            de00(lab, known_chart.lab),
            profile_choice.left_out_errors.de,
        ]
    )
    for name, row in zip(known_chart.chart.patch_names, table, strict=True):
        text.write(f"{name}," + ",".join(f"{value:.6g}" for value in row) + "\n")
    return text.getvalue()
