"""`report.html` of the reflectance of runs: maps of each view, samples that were left out, errors of the
materials.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.pages.maps import eye_map, normal_map, value_map
from coupole.pages.page_parts import Code, Figure, Inline, Link, Page, Section, Table, anchor
from coupole.pages.page_rendering import write_page
from coupole.reflectance.extraction.lamp_sight import lit_on
from coupole.reflectance.fits import FITS, GGX, GGX_NORMAL, MATERIALS
from coupole.reflectance.result_pages.material_maps import MapValues, in_three, material_maps, picture_of
from coupole.reflectance.run_fits import predict_samples
from coupole.reflectance.run_pictures import read_check_frames
from coupole.reflectance.run_result import REPORT, VARIANCES, RunResult, ViewSamples, read_about
from coupole.reflectance.triangle_fit import FEWEST
from coupole.storage import so_far
from coupole.storage.run import name_without_time

SIMULATED = "frames of a simulated cell"
POOR_RESIDUAL = 0.05
"""Residual of square roots, as a share of the diffuse part, above which the material model is in doubt."""
PUBLISHED = (
    ("the paper, scanner of 30 um", (-10.66, 14.00), (-15.23, 22.42), "57 to 74 % without vertices"),
    ("the paper, scanner of 20 um", (-8.11, 9.51), None, ""),
)


def write(folder: Path) -> Path:
    """Write the report of a result into its folder. Raises InputError, StorageError."""
    path = folder / REPORT
    write_page(path, _page(folder))
    return path


def remarks(about: dict[str, Any]) -> Iterator[str]:
    """Yield remarks for the user who made the result, one sentence each."""
    if growing := so_far.words(about):
        yield growing
    if about["simulated"]:
        yield SIMULATED
    views = f"{len(about['views'])} view{'s' if len(about['views']) > 1 else ''}"
    yield f"{about['triangles']} triangles in {views}, {about['samples']} samples in all channels"
    if refinement := about.get("refined"):
        before, after = (refinement["disagreement"][when]["median_mm"] for when in ("before", "after"))
        yield f"views were refined: they disagreed by {before:.3f} mm (median), and by {after:.3f} mm afterwards"
    if poses := about.get("poses"):
        yield (
            f"cameras have the poses of COLMAP, {poses['median_moved_mm']:.3g} mm and "
            f"{poses['median_turned_deg']:.2g} degrees (median) from the records' poses; their uncertainty is "
            "assumed to be the records' uncertainty"
        )
    if about["not_fitted"]:
        yield f"{about['not_fitted']} triangles have fewer than {FEWEST} samples and no material"
    for name, mae in about["mae"].items():
        if mae is not None:
            psnr_db = about["held_out_psnr_db"][name]
            off = f"off by {100 * mae:.3f} % of range, {psnr_db:.1f} dB"
            yield f"{FITS[name].title}: under the LEDs kept for the check {off}"
    for name, mae in about.get("texels", {}).get("mae", {}).items():
        if mae is not None:
            title = FITS[name].title if name in FITS else name
            psnr_db = about["texels"]["held_out_psnr_db"][name]
            yield f"in the pixels that have texels, {title}: off by {100 * mae:.3f} % of range, {psnr_db:.1f} dB"
    if interval := about["median_interval_percent"]:
        yield (
            f"95 % interval of the median sample: {_bounds([interval['low'], interval['high']])}, if the mesh's "
            f"vertices are off by {about['scan_noise_um']:g} um"
        )
    if (
        min((residual for residual in about["residual"].values() if residual is not None), default=0.0)
        > POOR_RESIDUAL
    ):
        yield (
            "the materials explain the samples poorly: is the object translucent or fluorescent, did it move, do "
            "mesh and records belong to it?"
        )


def _page(folder: Path) -> Page:
    about, result = read_about(folder), RunResult(folder)
    name = folder.resolve().name
    fits = {name: _fields(result.materials_path(name)) for name in MATERIALS}
    checks = {view.path.stem: list(_reconstruction(result, view, about)) for view in result.views}
    views = [
        Section(
            f"view-{anchor(view.path.stem)}",
            f"View {view.path.stem}",
            sections=[_maps(view.path, fits), _check_section(view.path.stem, checks[view.path.stem])],
        )
        for view in sorted(result.views, key=lambda view: view.path)
    ]
    return Page(
        title=f"{_objects(about) or name}: reflectance of {_materials_count(about):,} triangles",
        pictures=_first(next((figures for figures in checks.values() if figures), []), about, views),
        summary=f"Normal and material of {_materials_count(about):,} triangles were fitted to "
        f"{about['samples']:,} "
        "samples of "
        f"{len(about['views'])} view{'s' if len(about['views']) > 1 else ''}.",
        quality=_quality(about),
        next_step=_next_step(name, about),
        remark=_sentence(SIMULATED) if about["simulated"] else "",
        sections=[
            Section(
                "known",
                "What must be known",
                items=[_sentence(remark) for remark in remarks(about) if remark != SIMULATED],
            ),
            *views,
            _table_of_fits(about),
            _uncertain(about),
            _material_uncertainty(about),
            _shares(about),
        ],
    )


def _objects(about: dict[str, Any]) -> str:
    """Return the names of the runs, each name once."""
    return ", ".join(dict.fromkeys(name_without_time(run) for run in about["runs"]))


def _materials_count(about: dict[str, Any]) -> int:
    """Number of triangles that have a material."""
    return int(about["triangles"] - about["not_fitted"])


def _sentence(remark: str) -> str:
    return f"{remark[0].upper()}{remark[1:]}{'' if remark.endswith('?') else '.'}"


def _best_fit(about: dict[str, Any]) -> str | None:
    """Name of the fit with the smallest error under the LEDs kept for the check; None without a check."""
    errors = {name: mae for name, mae in about["mae"].items() if mae is not None}
    return min(errors, key=lambda name: errors[name]) if errors else None


def _first(checks: Sequence[Figure], about: dict[str, Any], views: Sequence[Section]) -> Sequence[Figure]:
    """Return the check of the best fit; without a check, the first maps of the first view."""
    best = _best_fit(about)
    if checks and best is not None:
        place = 1 + 2 * list(FITS).index(best)
        return [checks[0], *checks[place : place + 2]]
    return views[0].sections[0].figures[:2] if views else []


def _quality(about: dict[str, Any]) -> str:
    best = _best_fit(about)
    if best is None:
        return "The error is not known: no LEDs were kept for the check."
    error, psnr_db = 100 * about["mae"][best], about["held_out_psnr_db"][best]
    return f"Under LEDs kept for the check, {FITS[best].title} is off by {error:.2f} % of range, {psnr_db:.1f} dB."


def _next_step(name: str, about: dict[str, Any]) -> Inline:
    residuals = [residual for residual in about["residual"].values() if residual is not None]
    if min(residuals, default=0.0) > POOR_RESIDUAL:
        return ["Read ", Link("#known", "what must be known"), " before the materials are used."]
    return ["See it under any light: ", Code(f"coupole show {name} --out {name}.html"), "."]


def _glare(about: dict[str, Any]) -> str:
    if all("glare" in records for records in about["records"]):
        return "Veiling glare was subtracted; the bounds include the uncertainty of this correction."
    return "Veiling glare is not subtracted, and the bounds do not include it."


def _shares(about: dict[str, Any]) -> Section:
    codes = list(about["views"][0]["share_by_code"])
    rows = [
        (summary["view"], *(f"{100 * share:.1f} %" for share in summary["share_by_code"].values()))
        for summary in about["views"]
    ]
    notes = [
        f"{about['seconds']:.1f} s, at most {about['peak_memory_bytes'] / 1e9:.1f} GB.",
        f"{_inter_reflection(about)} {_glare(about)}",
    ]
    if left_out := sum(view["contradicted"] or 0 for view in about["views"]):
        notes.append(
            f"{left_out} samples ({100 * left_out / max(about['samples'], 1):.3f} %) were left out: they are "
            "darker than their neighbours allow, as at the edge of a cable's shadow."
        )
    table = Table("Share of triangles and LEDs", ("view", *codes), rows)
    return Section("samples", "Samples that were used and left out", tables=[table], notes=notes)


def _inter_reflection(about: dict[str, Any]) -> str:
    if not about["subtracted"]:
        return "Inter-reflection was not subtracted from the samples."
    shares_of_views = (view["inter_reflection"] for view in about["views"])
    shares = [f"{100 * half:.1f} % ({100 * far:.1f} %)" for half, far in shares_of_views]
    return (
        "Inter-reflection was subtracted from the samples; median (and 95th percentile) of each view: "
        f"{', '.join(shares)}; the assumed reflectance of the disk under the object is "
        f"{about['support_reflectance']:g}."
    )


def _uncertain(about: dict[str, Any]) -> Section:
    """Return a table by source of uncertainty, with the paper's figures."""
    section, heading = "uncertainty", "Uncertainty of samples"
    if not (percentages := about["uncertainty_percent"]) or percentages["monte_carlo"]["median"] is None:
        return Section(section, heading)
    trial = percentages["monte_carlo"]
    whole = _width(trial)
    rows = [("all sources", trial), *((f"without {name}", row) for name, row in percentages["without"].items())]
    lines = []
    for name, row in rows:
        narrower = "" if row is trial else f"{100 * (1 - _width(row) / whole):.0f} %"
        lines.append((name, _bounds(row["median"]), _bounds(row["percentile_95"]), narrower))
    for name, median, percentile_95, narrower in PUBLISHED:
        lines.append((name, _bounds(median), "" if percentile_95 is None else _bounds(percentile_95), narrower))
    caption = f"Bounds at {100 * trial['coverage']:.0f} %"
    note = (
        f"By Monte Carlo through the measurement equation ({trial['samples']} samples, {trial['draws']} draws "
        "of each), "
        "and with one source removed at a time; last, the figures published for La Coupole (Lucat et al. "
        "2025, 6.1 and 7)."
    )
    head = ("sources", "median sample", "95th percentile", "narrower by")
    return Section(section, heading, tables=[Table(caption, head, lines)], notes=[note])


def _material_uncertainty(about: dict[str, Any]) -> Section:
    rows = []
    for name, uncertainties in about["material_uncertainty"].items():
        if uncertainties["normal_deg"] is not None:
            percentages = (uncertainties[f"{field}_percent"] for field in ("kd", "ks", "alpha"))
            inside = about["held_out_inside"][name]
            rows.append(
                (
                    FITS[name].title,
                    f"{uncertainties['normal_deg']:.2f}",
                    *("" if percent is None else _percent_in_words(percent) for percent in percentages),
                    "" if inside is None else f"{100 * inside:.1f} %",
                )
            )
    return Section(
        "materials",
        "Uncertainty of normals and materials",
        tables=[
            Table("Median standard uncertainties", ("fit", "normal, degrees", "kd", "ks", "alpha", "inside"), rows)
        ],
        notes=[
            "Inside: share of the samples kept for the check that lie in the 95 % interval of the prediction. "
            "Fewer than 95 %: the material has an error that neighbouring LEDs do not share."
        ],
    )


def _percent_in_words(percent: float) -> str:
    """Return a relative uncertainty in words; above 100 % it only says that the quantity is not determined."""
    return f"{percent:.1f} %" if percent <= 100.0 else "not told"


def _width(row: dict[str, Any]) -> float:
    low, high = row["median"]
    return float(high - low)


def _bounds(pair: Sequence[float]) -> str:
    return f"{pair[0]:+.2f} to {pair[1]:+.2f} %"


def _table_of_fits(about: dict[str, Any]) -> Section:
    """A table of the fits."""
    rows = [
        (
            FITS[name].title,
            f"{100 * mae:.3f}",
            f"{about['held_out_psnr_db'][name]:.1f}",
            f"{100 * about['mae_of_triangles'][name]:.3f}",
        )
        for name, mae in about["mae"].items()
        if mae is not None
    ]
    if (noise := about["mae_of_noise"]) is not None:
        rows.append(("the camera's noise alone", f"{100 * noise:.3f}", "", ""))
    head = ("fit", "mean error of pictures, % of range", "PSNR, dB", "mean error of triangles, % of range")
    return Section(
        "fits",
        "Under the LEDs kept for the check",
        tables=[Table("Errors of the fits", head, rows)],
        notes=[
            "Pictures are compared by blocks of 2 x 2 pixels, one pixel of each channel (Lucat et al. 2025, 6.3)."
        ],
    )


def _check_section(view: str, figures: Sequence[Figure]) -> Section:
    words = (
        "Direct light of one LED in a frame that was kept for the check, its prediction by each fit, and the "
        "error of each."
    )
    heading = "Measured and made"
    return Section(f"check-{anchor(view)}", heading, words=[words] if figures else [], figures=figures)


def _reconstruction(result: RunResult, view: ViewSamples, about: dict[str, Any]) -> Iterator[Figure]:
    """Yield a frame that was kept for the check, and the prediction of each fit for it. The frame with the most
    values is taken."""
    frames = read_check_frames(result, view)
    if not len(frames.leds):
        return
    number = int(np.argmax(np.isfinite(frames.share[..., 0]).sum(axis=(1, 2))))
    lamp, photo = frames.leds[number], frames.share[number].astype(np.float32)
    rows = slice(0, len(view.triangles))
    led = view.leds == lamp
    under = result.view_samples(view, rows, led)
    lit = lit_on(under.centres_mm, under.led_mm, view.led_normals[led], about["emission"] == "paper")
    share = (lit[..., None] * view.full_scales[led])[:, 0]
    photo *= frames.picture(result.direct_shares(view, rows, led)[:, 0])
    is_known = np.isfinite(photo).all(axis=2, keepdims=True)
    white = float(np.nanquantile(photo, 0.995)) if is_known.any() else 1.0
    unit = "of full scale"
    yield eye_map(f"LED {lamp}, measured", in_three(photo), white, unit)
    for name in FITS:
        model = np.where(
            is_known, frames.picture(predict_samples(result, name, view, rows, under)[:, 0] * share), np.nan
        )
        off = np.abs(model - photo).mean(axis=2)
        yield eye_map(f"made by {FITS[name].title}", in_three(model), white, unit)
        yield value_map(f"{FITS[name].title}: off", 100 * off / white, "% of white", 10.0)


def _fields(path: Path) -> dict[str, NDArray[Any]]:
    with h5py.File(path, "r") as file:
        return {name: values[()] for name, values in file.items()}


def _maps(path: Path, fits: dict[str, dict[str, NDArray[Any]]]) -> Section:
    """Return maps of a view: shape, diffuse part, lobe, residual."""
    with h5py.File(path, "r") as file:
        rows, triangles = file["seen"][()], file["triangles"][()]
    materials = fits[GGX_NORMAL.name]
    row = np.searchsorted(materials["triangles"], triangles)
    mesh, fit_normals = fits[GGX.name]["normals"][row], materials["normals"][row]
    uncertain = np.sqrt(materials["covariance"][row][:, VARIANCES])
    angles_deg = np.degrees(np.arccos(np.clip(np.sum(mesh * fit_normals, axis=1), -1, 1)))
    left_percent = 100 * materials["residual"][row]
    maps = material_maps(
        MapValues(
            rows, fit_normals, materials["kd"][row], materials["ks"][row], materials["alpha"][row], uncertain
        )
    )
    return Section(
        f"maps-{anchor(path.stem)}",
        "Maps",
        figures=[
            maps.kd,
            maps.normals,
            maps.u_kd,
            normal_map("normals of the mesh", picture_of(rows, mesh)),
            value_map("angle between them", picture_of(rows, angles_deg), "degrees", 10.0),
            maps.u_normals,
            *maps.lobe,
            value_map("what is left", picture_of(rows, left_percent), "% of the diffuse part", 10.0),
        ],
        notes=[maps.lobe_words],
    )
