"""Texels on a coarse mesh of a painted object, beside those on its own mesh, in pictures of left-out LEDs.

The vertices of the coarse mesh are on the surface; between them it has chords. Frames, records and poses are
the same. Both results' pictures are compared with the same values: the frames without the light from other
surfaces, as the fine mesh gives it. Pixels are compared where both have a value, and where the true surface is
within the depth of field.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from coupole.reflectance.fits import TEXELS
from coupole.reflectance.new_light.pictured_surface import surface_of_view
from coupole.reflectance.run_check import PEAK_QUANTILE
from coupole.reflectance.run_job import forget, read_runs, reflectance_of
from coupole.reflectance.run_result import RunResult, ViewSamples
from coupole.reflectance.texels.pixel_file import read_view_texels
from coupole.reflectance.texels.texel_check import held_out_pictures, picture_maker
from coupole.reflectance.texels.texel_job import add_texels
from coupole.reflectance.texels.texel_size import TexelSize
from judged_texels import Acquired
from painted_objects import LENS, PITCH_UM, Floats, mesh_of
from sim.optics.objective import defocus_px

MOST_WORSE_DB, _SHARP_PX = 1.0, 1.0
"""Pictures on a coarse mesh may be so many dB worse. A place is in the depth of field if its defocus disk has at
most this diameter."""


@dataclass
class _Compared:
    """Values of the pixels that are compared, view by view and LED by LED."""

    measured_parts: list[Floats]
    fine: list[Floats]
    coarse: list[Floats]
    of_fine: int = 0
    """Number of pixels with a value on the fine mesh, in the depth of field."""

    def psnr_db(self, pictures: list[Floats]) -> float:
        measured_values = np.concatenate(self.measured_parts)
        square = np.mean(np.square(np.concatenate(pictures) - measured_values))
        return float(10.0 * np.log10(np.quantile(measured_values, PEAK_QUANTILE) ** 2 / square))


def judge_coarse(object_run: Acquired, fine_out: Path, edge_mm: float, size: TexelSize) -> dict[str, Any]:
    """Make the object's result and its texels on a mesh of triangles of `edge_mm`, and compare them with the
    texels of the result in `fine_out`."""
    out = fine_out.with_name(f"{fine_out.name}-coarse")
    mesh_path = out.with_suffix(".ply")
    mesh = mesh_of(object_run.painted_object.height_mm, edge_mm)
    mesh.export(mesh_path)
    request = replace(object_run.request, mesh=mesh_path)
    reflectance_of(request, out)
    add_texels(request, out, size)
    poses = {view.name: view.base_from_camera for view in read_runs(request, "coarse")[0].views}
    forget()
    fine, coarse = RunResult(fine_out), RunResult(out)
    of_views = {view.view: view for view in coarse.views}
    comparison, normals_off_deg = _Compared([], [], []), []
    for view in fine.views:
        normals_off_deg.append(_normals_off_deg((fine, view), (coarse, of_views[view.view])))
        _compare(comparison, (fine, view), (coarse, of_views[view.view]), poses[view.view])
    shutil.rmtree(out)
    fine_db, coarse_db = (comparison.psnr_db(pictures) for pictures in (comparison.fine, comparison.coarse))
    return {
        "object": object_run.name,
        "size": size.text,
        "edge_mm": edge_mm,
        "triangles": len(mesh.faces),
        "fine_psnr_db": fine_db,
        "coarse_psnr_db": coarse_db,
        "worse_db": fine_db - coarse_db,
        "compared_share": sum(map(len, comparison.measured_parts)) / comparison.of_fine,
        "normals_apart_deg": float(np.median(np.concatenate(normals_off_deg))),
    }


def _compare(
    comparison: _Compared,
    of_fine: tuple[RunResult, ViewSamples],
    of_coarse: tuple[RunResult, ViewSamples],
    base_from_camera: Floats,
) -> None:
    """Add the pictures of a view's left-out LEDs."""
    is_sharp = _sharp(*of_fine, base_from_camera)[::2, ::2]
    fine_maker, coarse_maker = (picture_maker(*of_one, TEXELS) for of_one in (of_fine, of_coarse))
    for (measured_picture, fine), (_, coarse) in zip(
        held_out_pictures(*of_fine, {TEXELS: fine_maker}),
        held_out_pictures(*of_coarse, {TEXELS: coarse_maker}),
        strict=True,
    ):
        height, width = measured_picture.shape[:2]
        in_fine = np.isfinite(measured_picture) & (fine[TEXELS] > 0.0) & is_sharp[:height, :width, None]
        in_both = in_fine & (coarse[TEXELS] > 0.0)
        comparison.of_fine += int(np.count_nonzero(in_fine))
        for values, picture in (
            (comparison.measured_parts, measured_picture),
            (comparison.fine, fine[TEXELS]),
            (comparison.coarse, coarse[TEXELS]),
        ):
            values.append(picture[in_both].astype(np.float64))


def _sharp(result: RunResult, view: ViewSamples, base_from_camera: Floats) -> np.ndarray:
    """[h, w] True where the surface is within the depth of field."""
    places_mm = surface_of_view(result, view).places_mm.astype(np.float64)
    depth_mm = (places_mm - base_from_camera[:3, 3]) @ base_from_camera[:3, 2]
    is_seen = np.isfinite(depth_mm)
    depth_mm = np.where(is_seen, depth_mm, LENS.focus_distance_mm)
    return np.asarray(is_seen & (defocus_px(LENS, depth_mm, PITCH_UM) <= _SHARP_PX))


def _normals_off_deg(of_fine: tuple[RunResult, ViewSamples], of_coarse: tuple[RunResult, ViewSamples]) -> Floats:
    """[pixels] angles between the normals of both results' texels."""
    shape = surface_of_view(*of_fine).triangle_of_pixel.shape
    texels = [read_view_texels(*of_one) for of_one in (of_fine, of_coarse)]
    numbers = [of_one.in_picture(shape) for of_one in texels]
    in_both = (numbers[0] >= 0) & (numbers[1] >= 0)
    fine, coarse = (of_one.normals[number[in_both]] for of_one, number in zip(texels, numbers, strict=True))
    return np.asarray(np.degrees(np.arccos(np.clip(np.sum(fine * coarse, axis=1), -1.0, 1.0))), np.float64)


def faults_of_coarse(row: dict[str, Any]) -> list[str]:
    """Return what an object loses more than it may on a coarse mesh."""
    if row["worse_db"] <= MOST_WORSE_DB:
        return []
    return [
        f"{row['object']}, {row['size']}: {row['worse_db']:.1f} dB worse on triangles of {row['edge_mm']:g} mm"
    ]


def print_coarse(rows: list[dict[str, Any]]) -> None:
    print("| object, size | triangles | left-out LEDs, fine and coarse mesh | pixels compared | normals apart |")
    print("|---|---|---|---|---|")
    for row in rows:
        cells = (
            f"{row['object']}, {row['size']}", f"{row['triangles']} of {row['edge_mm']:g} mm",
            f"{row['fine_psnr_db']:.1f} dB, {row['coarse_psnr_db']:.1f} dB", f"{row['compared_share']:.0%}",
            f"{row['normals_apart_deg']:.2f} degrees",
        )  # fmt: skip
        print(f"| {' | '.join(cells)} |")
