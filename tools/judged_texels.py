"""Texels of painted objects beside the truth: intervals by strata, pictures of left-out LEDs, and fine lines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from coupole.calibration.record import records_named
from coupole.reflectance.extraction.sample_codes import PENUMBRA, REACHED
from coupole.reflectance.fits import TEXELS
from coupole.reflectance.ggx import tangents
from coupole.reflectance.new_light.pictured_surface import surface_of_view
from coupole.reflectance.run_job import RunRequest, forget, read_runs, reflectance_of
from coupole.reflectance.run_relighting import best_with_texels
from coupole.reflectance.run_result import FRAMES, INTER_REFLECTION, VARIANCES, RunResult, ViewSamples
from coupole.reflectance.texels.pixel_file import ViewTexels, read_view_texels, texel_uncertainty
from coupole.reflectance.texels.texel_check import held_out_pictures, picture_maker
from coupole.reflectance.texels.texel_job import add_texels
from coupole.reflectance.texels.texel_size import TexelSize
from painted_objects import BAYER, OBJECTS, SIZE_PX, Floats, Painted, Truth, means_of, painted_cell, truth_of

STRATA = ("flat", "edge of shadow", "fold", "grazing")
"""A texel belongs to the last of these that it meets."""
_EDGE_SHARE, _FOLD_SHARE, _GRAZING_COSINE = 0.05, 0.05, 0.5
"""Share of the LEDs in whose penumbra a triangle is; mean share of its light that comes from other surfaces; and
cosine of the angle between view and mesh."""
_QUANTILE, _AROUND_PX = 1.96, 3.0
LEAST_HELD, MOST_HELD, FEWEST, LEAST_DB, LEAST_LINES = 0.90, 0.99, 500, 3.0, 0.8
"""Bounds of the share of intervals that hold; least number of texels of a stratum that is judged; and what single
pixels must gain: PSNR over triangles, and the share of the frames' contrast of lines."""


@dataclass(frozen=True)
class Acquired:
    """A run of an object, its records, and its result without texels."""

    name: str
    """Its name in `OBJECTS`, or that of another object."""
    run: Path
    records: Path
    result: Path

    @property
    def request(self) -> RunRequest:
        return RunRequest((self.run,), None, records_named([self.records]))

    @property
    def painted_object(self) -> Painted:
        return OBJECTS[self.name]


def acquire_painted(folder: Path, name: str, *, every: int, seed: int) -> Acquired:
    """Acquire an object, and make its result without texels."""
    folder.mkdir()
    cell = painted_cell(folder, OBJECTS[name], every=every, seed=seed)
    outcome = cell.acquire()
    if outcome.code:
        raise RuntimeError(outcome.err)
    object_run = Acquired(name, cell.run_folder, folder / "records", folder / "result")
    reflectance_of(object_run.request, object_run.result)
    return object_run


def judge_painted(object_run: Acquired, out: Path, size: TexelSize) -> dict[str, Any]:
    """Add texels to the result in `out`, a copy of the object's, and compare them with the truth."""
    about = add_texels(object_run.request, out, size)
    result = RunResult(out)
    poses = {view.name: view.base_from_camera for view in read_runs(object_run.request, "truth")[0].views}
    forget()
    (triangle_fit,) = set(about["mae"]) - {TEXELS}
    psnr_db = about["held_out_psnr_db"]
    parts: dict[str, list[tuple[Floats, ...]]] = {stratum: [] for stratum in STRATA}
    seen_lines: dict[str, Floats] = {name: np.zeros(2) for name in (TEXELS, "ggx_normal")}
    for view in result.views:
        truth = truth_of(result, view, poses[view.view], object_run.painted_object.detail)
        _add_errors(parts, result, view, truth, np.array(object_run.painted_object.material["diffuse"]))
        if object_run.painted_object.detail:
            _add_lines(seen_lines, result, view, truth)
    return {
        "object": object_run.name,
        "size": size.text,
        "texels": sum(about["pixels"].values()),
        "strata": {stratum: _shares_held(part) for stratum, part in parts.items() if part},
        "psnr_db": psnr_db[TEXELS],
        "over_triangles_db": psnr_db[TEXELS] - psnr_db[triangle_fit],
        "triangles": triangle_fit,
        "is_better": about["mae"][TEXELS] < about["mae"][triangle_fit],
        "chosen": best_with_texels(result),
        "lines": {name: float(sums[0] / sums[1]) if sums[1] else None for name, sums in seen_lines.items()},
    }


def strata_of(result: RunResult, view: ViewSamples, texels: ViewTexels) -> NDArray[np.int64]:
    """[n] numbers of the texels' strata, from the mesh, the view and the LEDs."""
    surface = surface_of_view(result, view)
    triangle = surface.triangle_of_pixel.reshape(-1)[texels.pixels]
    with h5py.File(view.path, "r") as file:
        codes = file["codes"][()]
        shares = file[INTER_REFLECTION][()].astype(float).mean(axis=2) if INTER_REFLECTION in file else 0.0 * codes
    is_known = (codes == REACHED) & np.isfinite(shares)
    mean_share = np.where(is_known, shares, 0.0).sum(axis=1) / np.maximum(is_known.sum(axis=1), 1)
    ways = view.camera_mm - surface.places_mm.reshape(-1, 3)[texels.pixels]
    cosines = np.sum(ways * surface.normals[triangle], axis=1) / np.linalg.norm(ways, axis=1)
    stratum = np.where((codes == PENUMBRA).mean(axis=1)[triangle] > _EDGE_SHARE, 1, 0)
    stratum = np.where(mean_share[triangle] > _FOLD_SHARE, 2, stratum)
    return np.where(cosines < _GRAZING_COSINE, 3, stratum)


def _add_errors(
    parts: dict[str, list[tuple[Floats, ...]]], result: RunResult, view: ViewSamples, truth: Truth, diffuse: Floats
) -> None:
    """Add the errors of the logarithms of kd [n, channels] and tilts [n, 2] over their uncertainties; kd in the
    channels that texels measure themselves."""
    texels = read_view_texels(result, view)
    paint, true_normals = means_of(texels, truth)
    row, column = np.divmod(texels.pixels, SIZE_PX[0])
    own_channel = BAYER[row % 2, column % 2][:, None]
    channel = own_channel if texels.side_px == 1 else np.broadcast_to(np.arange(3), (len(own_channel), 3))
    off = np.log(np.take_along_axis(texels.kd, channel, 1) * np.pi / diffuse[channel]) - np.log(paint)[:, None]
    variances = texels.covariance[:, VARIANCES]
    u_kd = np.sqrt(variances[:, 2] + np.sum(np.square(texel_uncertainty(result, view))))
    steps = np.array([tangents(*normal) for normal in texels.normals.astype(float)])
    tilts = np.einsum("nki,ni->nk", steps, true_normals - texels.normals)
    stratum = strata_of(result, view, texels)
    for number, name in enumerate(STRATA):
        here = stratum == number
        if here.any():
            parts[name].append(
                (off[here], off[here] / u_kd[here, None], tilts[here], tilts[here] / np.sqrt(variances[here, :2]))
            )


def _shares_held(part: list[tuple[Floats, ...]]) -> dict[str, float]:
    off, off_of_u, tilts, tilts_of_u = (np.concatenate([view[k] for view in part]) for k in range(4))
    return {
        "texels": len(off),
        "kd_off_percent": float(100.0 * np.median(np.abs(off))),
        "kd_held": float(np.mean(np.abs(off_of_u) < _QUANTILE)),
        "normals_off_deg": float(np.degrees(np.median(np.linalg.norm(tilts, axis=1)))),
        "tilts_held": float(np.mean(np.abs(tilts_of_u) < _QUANTILE)),
    }


def _add_lines(seen_lines: Mapping[str, Floats], result: RunResult, view: ViewSamples, truth: Truth) -> None:
    """Add the contrast of the pattern of lines, which is the product of a picture's fine part with the true lines:
    of the fits' pictures under left-out LEDs, and of the frames, where both have a value."""
    with h5py.File(result.folder / FRAMES / view.path.name, "r") as file:
        offsets = file["offsets"][()]
    makers = {name: picture_maker(result, view, name) for name in seen_lines}
    for frame, pictures in held_out_pictures(result, view, makers):
        is_known = np.isfinite(frame) & np.logical_and.reduce([picture > 0.0 for picture in pictures.values()])
        for channel, (row, column) in enumerate(offsets):
            here = is_known[..., channel]
            lines = truth.lines[row::2, column::2][: here.shape[0], : here.shape[1]]
            of_frame = np.sum(_fine_part(frame[..., channel], here) * lines)
            for name, picture in pictures.items():
                seen_lines[name][:] += np.sum(_fine_part(picture[..., channel], here) * lines), of_frame


def _fine_part(picture: NDArray[np.floating], is_used: NDArray[np.bool_]) -> Floats:
    """[h, w] relative deviations of a picture's values from those around; 0 where it is not used."""
    values = np.where(is_used, picture, 0.0).astype(float)
    around = gaussian_filter(values, _AROUND_PX) / np.maximum(
        gaussian_filter(is_used.astype(float), _AROUND_PX), 1e-6
    )
    return np.where(is_used, values / np.maximum(around, 1e-9) - 1.0, 0.0)


def faults_of_painted(row: dict[str, Any]) -> list[str]:
    """Return what an object has less than it must. Pictures by texels larger than pixels must only hold what they
    state."""
    title = f"{row['object']}, {row['size']}"
    faults = [
        f"{title}, {stratum}: {name} {part[name]:.1%}"
        for stratum, part in row["strata"].items()
        for name in ("kd_held", "tilts_held")
        if part["texels"] >= FEWEST and part[name] < LEAST_HELD
    ]
    if (row["chosen"] == TEXELS) != row["is_better"]:
        faults.append(f"{title}: relight takes {row['chosen']}")
    if OBJECTS[row["object"]].detail and row["size"] == TexelSize().text:
        if row["over_triangles_db"] < LEAST_DB:
            faults.append(f"{title}: {row['over_triangles_db']:.1f} dB better than triangles")
        if row["lines"][TEXELS] < LEAST_LINES:
            faults.append(f"{title}: lines have {row['lines'][TEXELS]:.2f} of their contrast")
    return faults


def print_painted(rows: list[dict[str, Any]]) -> None:
    """Print a table of objects, sizes and strata; more than 99 % of the intervals are marked."""
    print("| object, size | stratum | texels | kd off, held | normals off, held | dB over | relight | lines |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows:
        lines = " and ".join("-" if value is None else f"{value:.2f}" for value in row["lines"].values())
        over = f"{row['over_triangles_db']:.1f} ({row['triangles']})"
        for stratum, part in row["strata"].items():
            shares = [
                f"{part[name]:.1%}" + " wide" * (part[name] > MOST_HELD) for name in ("kd_held", "tilts_held")
            ]
            cells = (
                f"{row['object']}, {row['size']}", stratum, str(part["texels"]),
                f"{part['kd_off_percent']:.1f} %, {shares[0]}",
                f"{part['normals_off_deg']:.2f} degrees, {shares[1]}",
                over, row["chosen"], lines,
            )  # fmt: skip
            print(f"| {' | '.join(cells)} |")
