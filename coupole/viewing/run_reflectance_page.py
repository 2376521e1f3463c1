"""`report.html` of the reflectance of runs: maps of each view, what was left out, what the materials miss."""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.report import HEAD
from coupole.errors import StorageError
from coupole.reflectance.extraction.lamp_sight import lit_on
from coupole.reflectance.fits import FITS, GGX, GGX_NORMAL, MATERIALS
from coupole.reflectance.run_fits import predict_samples
from coupole.reflectance.run_pictures import read_check_frames
from coupole.reflectance.run_result import REPORT, RunResult, read_about
from coupole.reflectance.triangle_fit import FEWEST
from coupole.storage.durable import write_synced
from coupole.viewing.reflectance_page import STYLE, display, figure, grey

POOR_RESIDUAL = 0.05
"""Residual of square roots, as a share of the diffuse part's, beyond which the material model itself is in
doubt."""
WHITE_KS = 0.1
LEAST_KS = 0.004
"""A tenth of a dielectric's: below it the roughness says nothing."""
_VARIANCES = [0, 2, 5, 9, 14]
"""Places in the lower half of a covariance."""
PUBLISHED = (
    ("the paper, scanner of 30 um", (-10.66, 14.00), (-15.23, 22.42), "57 to 74 % without vertices"),
    ("the paper, scanner of 20 um", (-8.11, 9.51), None, ""),
)


def write(folder: Path) -> Path:
    """Write the report of a result into its folder. Raises InputError, StorageError."""
    path = folder / REPORT
    try:
        write_synced(path, "".join(_page(folder)))
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from error
    return path


def remarks(about: dict[str, Any]) -> Iterator[str]:
    """Yield what the maker of the result must know, one sentence each."""
    if about["simulated"]:
        yield "frames of a simulated cell"
    views = f"{len(about['views'])} view{'s' if len(about['views']) > 1 else ''}"
    yield f"{about['triangles']} triangles in {views}, {about['samples']} samples in all channels"
    if refinement := about.get("refined"):
        before, after = (refinement["disagreement"][when]["median_mm"] for when in ("before", "after"))
        yield f"views were refined: they disagreed by {before:.3f} mm (median), and by {after:.3f} mm afterwards"
    if poses := about.get("poses"):
        yield (
            f"cameras stand where COLMAP has them, {poses['median_moved_mm']:.3g} mm and "
            f"{poses['median_turned_deg']:.2g} degrees (median) from where the records do; their uncertainty is "
            "taken to be the records'"
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


def _page(folder: Path) -> Iterator[str]:
    about = read_about(folder)
    title = html.escape(folder.resolve().name)
    yield f"{HEAD}<title>{title}</title><style>{STYLE}</style><h1>{title}</h1>"
    for remark in remarks(about):
        yield f"<p>{html.escape(remark)}"
    yield from _table_of_fits(about)
    yield from _uncertain(about)
    yield from _material_uncertainty(about)
    fits = {name: _fields(RunResult(folder).materials_path(name)) for name in MATERIALS}
    for view in sorted((folder / "samples").glob("*.h5")):
        yield f"<h2>View {html.escape(view.stem)}</h2>"
        yield from _view(view, fits)
        yield from _reconstruction(RunResult(folder), view, about)
    yield "<h2>Share of triangles and LEDs</h2><table><tr><th>view"
    codes = about["views"][0]["share_by_code"]
    yield "".join(f"<th>{html.escape(name)}" for name in codes)
    for summary in about["views"]:
        yield f"<tr><th>{html.escape(summary['view'])}"
        yield "".join(f"<td>{100 * share:.1f} %" for share in summary["share_by_code"].values())
    yield f"</table><p>{about['seconds']:.1f} s, at most {about['peak_memory_bytes'] / 1e9:.1f} GB."
    yield f"<p>{_inter_reflection(about)} Veiling glare is not subtracted, and neither is in the bounds."
    if left_out := sum(view["contradicted"] or 0 for view in about["views"]):
        yield (
            f"<p>{left_out} samples ({100 * left_out / max(about['samples'], 1):.3f} %) were left out: they are "
            "darker than those beside them allow, as at the edge of a cable's shadow."
        )


def _inter_reflection(about: dict[str, Any]) -> str:
    if not about["subtracted"]:
        return "Inter-reflection is left in the samples."
    shares_of_views = (view["inter_reflection"] for view in about["views"])
    shares = [f"{100 * half:.1f} % ({100 * far:.1f} %)" for half, far in shares_of_views]
    return (
        "Inter-reflection was taken off the samples, in the median (and the 95th percentile) of each view: "
        f"{', '.join(shares)}; the disk under the object is taken to reflect {about['support_reflectance']:g}."
    )


def _uncertain(about: dict[str, Any]) -> Iterator[str]:
    """A table of sources, beside the paper's."""
    if not (percentages := about["uncertainty_percent"]) or percentages["monte_carlo"]["median"] is None:
        return
    trial = percentages["monte_carlo"]
    yield (
        f"<h2>Uncertainty of samples</h2><p>Bounds at {100 * trial['coverage']:.0f} %, by Monte Carlo through the "
        f"measurement equation ({trial['samples']} samples, {trial['draws']} draws of each), and with one source "
        "removed at a time; last, what was published of La Coupole (seed 003, 6.1 and 7)."
    )
    yield "<table><tr><th><th>median sample<th>95th percentile<th>narrower by"
    whole = _width(trial)
    rows = [("all sources", trial), *((f"without {name}", row) for name, row in percentages["without"].items())]
    for name, row in rows:
        narrower = "" if row is trial else f"{100 * (1 - _width(row) / whole):.0f} %"
        middle, far = _bounds(row["median"]), _bounds(row["percentile_95"])
        yield f"<tr><th>{html.escape(name)}<td>{middle}<td>{far}<td>{narrower}"
    for name, median, percentile_95, narrower in PUBLISHED:
        far = "" if percentile_95 is None else _bounds(percentile_95)
        yield f"<tr><th>{name}<td>{_bounds(median)}<td>{far}<td>{narrower}"
    yield "</table>"


def _material_uncertainty(about: dict[str, Any]) -> Iterator[str]:
    yield (
        "<h2>Uncertainty of normals and materials</h2><p>Median standard uncertainties, and how many of the "
        "samples kept for the check lie in the 95 % interval of what is made."
        "<table><tr><th><th>normal, degrees<th>kd<th>ks<th>alpha<th>inside"
    )
    for name, uncertainties in about["material_uncertainty"].items():
        if uncertainties["normal_deg"] is not None:
            yield f"<tr><th>{FITS[name].title}<td>{uncertainties['normal_deg']:.2f}"
            percentages = (uncertainties[f"{field}_percent"] for field in ("kd", "ks", "alpha"))
            yield "".join("<td>" if percent is None else f"<td>{percent:.1f} %" for percent in percentages)
            inside = about["held_out_inside"][name]
            yield "<td>" if inside is None else f"<td>{100 * inside:.1f} %"
    yield "</table><p>Fewer than 95 % inside: the material misses something that neighbouring LEDs do not share."


def _width(row: dict[str, Any]) -> float:
    low, high = row["median"]
    return float(high - low)


def _bounds(pair: Sequence[float]) -> str:
    return f"{pair[0]:+.2f} to {pair[1]:+.2f} %"


def _table_of_fits(about: dict[str, Any]) -> Iterator[str]:
    """A table of the fits."""
    yield (
        "<h2>Under the LEDs kept for the check</h2><table><tr><th><th>mean error of pictures, % of range"
        "<th>PSNR, dB<th>mean error of triangles, % of range"
    )
    for name, mae in about["mae"].items():
        if mae is not None:
            psnr_db, of_triangles = about["held_out_psnr_db"][name], about["mae_of_triangles"][name]
            yield f"<tr><th>{FITS[name].title}<td>{100 * mae:.3f}<td>{psnr_db:.1f}<td>{100 * of_triangles:.3f}"
    if (noise := about["mae_of_noise"]) is not None:
        yield f"<tr><th>the camera's noise alone<td>{100 * noise:.3f}"
    yield "</table><p>Pictures are compared by blocks of 2 x 2 pixels, one pixel of each channel (seed 003, 6.3)."


def _reconstruction(result: RunResult, path: Path, about: dict[str, Any]) -> Iterator[str]:
    """A frame that was kept for the check, and what each fit makes of it; that which shows most."""
    view = next(view for view in result.views if view.path == path)
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
    yield f"<p>Direct light of LED {lamp} in the frame, made by each fit, and how far each is off, white 10 %<br>"
    yield figure("measured", display(_rgb(np.nan_to_num(photo)), white))
    for name in FITS:
        model = frames.picture(predict_samples(result, name, view, rows, under)[:, 0] * share)
        off = np.where(is_known, np.abs(model - photo), 0.0).mean(axis=2)
        yield figure(FITS[name].title, display(_rgb(np.nan_to_num(np.where(is_known, model, 0.0))), white))
        yield figure("off", grey(np.nan_to_num(off) / (0.1 * white)))


def _fields(path: Path) -> dict[str, NDArray[Any]]:
    with h5py.File(path, "r") as file:
        return {name: values[()] for name, values in file.items()}


def _view(path: Path, fits: dict[str, dict[str, NDArray[Any]]]) -> Iterator[str]:
    with h5py.File(path, "r") as file:
        rows, triangles = file["seen"][()], file["triangles"][()]
    materials = fits[GGX_NORMAL.name]
    row = np.searchsorted(materials["triangles"], triangles)
    mesh, fit_normals = fits[GGX.name]["normals"][row], materials["normals"][row]
    kd, ks = (_rgb(materials[name][row]) for name in ("kd", "ks"))
    uncertain = np.sqrt(materials["covariance"][row][:, _VARIANCES])
    yield figure("normals of the mesh", _picture(rows, 0.5 + 0.5 * mesh))
    yield figure("fitted", _picture(rows, 0.5 + 0.5 * fit_normals))
    angles_deg = np.degrees(np.arccos(np.clip(np.sum(mesh * fit_normals, axis=1), -1, 1)))
    yield figure("angle between them, white 10 degrees", grey(_picture(rows, angles_deg[:, None] / 10.0)[..., 0]))
    sd_deg = np.degrees(np.hypot(uncertain[:, :1], uncertain[:, 1:2]))
    yield figure(
        "standard uncertainty of fitted normals, white 10 degrees", grey(_picture(rows, sd_deg / 10)[..., 0])
    )
    yield figure("diffuse", display(_picture(rows, kd)))
    caption = "standard uncertainty of diffuse, white 10 %"
    yield figure(caption, grey(_picture(rows, uncertain[:, 2:3] / 0.1)[..., 0]))
    yield figure("specular ks, white 0.1", display(_picture(rows, ks), WHITE_KS))
    rough = np.where(ks.max(axis=1) > LEAST_KS, materials["alpha"][row], 0.0)
    caption = f"roughness alpha, white 1, where ks is above {LEAST_KS:g}"
    yield figure(caption, grey(_picture(rows, rough[:, None])[..., 0]))
    doubt = np.where(ks.max(axis=1) > LEAST_KS, uncertain[:, 4], 0.0)[:, None]
    yield figure("its relative standard uncertainty, white 50 %", grey(_picture(rows, doubt / 0.5)[..., 0]))
    yield figure(
        "what is left, white 10 %", grey(_picture(rows, materials["residual"][row][:, None] / 0.1)[..., 0])
    )


def _rgb(values: NDArray[Any]) -> NDArray[Any]:
    """Repeat a single channel three times."""
    return values if values.shape[-1] == 3 else np.repeat(values, 3, axis=-1)


def _picture(triangle_rows: NDArray[np.int32], values: NDArray[Any]) -> NDArray[np.float32]:
    """[h, w, n] of values [triangles, n]; 0 where nothing is seen."""
    picture = np.zeros((*triangle_rows.shape, values.shape[1]), np.float32)
    picture[triangle_rows >= 0] = values[triangle_rows[triangle_rows >= 0]]
    return picture
