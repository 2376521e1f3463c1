"""`report.html` of a result of pictures under known lights: pictures first, then remarks about them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.pages.maps import eye_map, normal_map, value_map
from coupole.pages.page_parts import Code, Figure, Inline, Link, Page, Section, Table
from coupole.pages.page_rendering import write_page
from coupole.reflectance.picture_job import PEAK_QUANTILE
from coupole.reflectance.picture_result import CONES, INTERVALS, MATERIALS, REPORT, PictureResult
from coupole.reflectance.relighting import read_interpolation, relit
from coupole.reflectance.relit_intervals import FEWEST_LIGHTS
from coupole.reflectance.result_pages import lobes_told

MOST_CHECKS = 6
POOR_RESIDUAL = 0.05
"""Residual of the square roots of values, as a share of the diffuse part, above which the material model itself is
in doubt."""


def write(folder: Path) -> Path:
    """Write the report of a result into its folder. Raises InputError, StorageError."""
    path = folder / REPORT
    write_page(path, _page(PictureResult(folder)))
    return path


def remarks(about: dict[str, Any]) -> Iterator[str]:
    """Yield remarks for the user who made the result, one sentence each."""
    if run := about.get("uncalibrated_run"):
        yield (
            f"of the run {run} without calibrations: values are relative, and the lights have the directions "
            f"that rig and LED table give from one point; normals and materials are of single pixels"
        )
    yield (
        f"{about['pixels']} pixels under {about['lights'] - len(about['left_out'])} lights; residual of the "
        f"materials {100 * about['residual']:.1f} % (median, of square roots)"
    )
    if about["not_fitted"]:
        yield f"{about['not_fitted']} pixels saw too few lights and have no normal"
    if about["residual"] > POOR_RESIDUAL:
        yield (
            "the materials explain the pictures poorly: is the object translucent or fluorescent, are the "
            "pictures linear, are the lights in the same order as the pictures?"
        )
    if about["suspect_pictures"]:
        names = ", ".join(f"{name} ({gain:.2f})" for name, gain in about["suspect_pictures"].items())
        yield f"pictures brighter or darker than all others predict: {names}"
    if about["held_out_psnr_db"] is not None:
        yield f"left-out lights are predicted with {about['held_out_psnr_db']:.2f} dB (PSNR, linear, in the mask)"


def _page(result: PictureResult) -> Page:
    about = result.about
    name = result.folder.resolve().name
    with h5py.File(result.folder / MATERIALS) as file:
        fields = {name: np.asarray(file[name]) for name in ("normal", "kd", "ks", "alpha", "residual")}
    lights = about["lights"] - len(about["left_out"])
    return Page(
        title=f"{name}: normals and materials from {lights} pictures",
        pictures=[
            eye_map("diffuse reflectance", _on_the_picture(result, fields["kd"]), unit="of full scale"),
            normal_map("normals", _on_the_picture(result, fields["normal"])),
        ],
        summary=f"A normal and a material were fitted to each of {about['pixels']:,} pixels under {lights} "
        "lights.",
        quality=_quality(about),
        next_step=_next_step(name, about),
        remark="Frames of a simulated cell." if about.get("simulated") else "",
        sections=[
            Section("known", "What must be known", items=[_sentence(remark) for remark in remarks(about)]),
            _materials(result, fields),
            Section(
                "checks",
                "Left-out lights: measured, made, difference",
                figures=list(_checks(result)),
                figure_size="triples",
            ),
            _uncertainty(result),
            _figures(about),
        ],
    )


def _sentence(remark: str) -> str:
    return f"{remark[0].upper()}{remark[1:]}{'' if remark.endswith('?') else '.'}"


def _quality(about: dict[str, Any]) -> str:
    if about["held_out_psnr_db"] is not None:
        return (
            f"Pictures of lights that were left out are predicted with {about['held_out_psnr_db']:.1f} dB "
            "(PSNR, inside the mask)."
        )
    return f"The median residual of the materials is {100 * about['residual']:.1f} % (of square roots)."


def _next_step(name: str, about: dict[str, Any]) -> Inline:
    if about["suspect_pictures"] or about["residual"] > POOR_RESIDUAL:
        return ["Read ", Link("#known", "what must be known"), " before the materials are used."]
    return ["See it under any light: ", Code(f"coupole show {name} --out {name}.html"), "."]


def _on_the_picture(result: PictureResult, values: NDArray[Any]) -> NDArray[np.float32]:
    """[h, w, ...] picture of values [pixels, ...], NaN outside the mask."""
    return result.picture(values.astype(np.float32), outside=np.nan)


def _materials(result: PictureResult, fields: dict[str, NDArray[Any]]) -> Section:
    figures: list[Figure] = []
    notes = ["Where no light stands near the mirror direction, specular part and roughness are not determined."]
    ks, alpha = fields["ks"], fields["alpha"]
    is_seen = lobes_told.highlights(fields["kd"], ks, alpha) >= lobes_told.LEAST_HIGHLIGHT
    if (share := float(is_seen.mean())) >= lobes_told.LEAST_SHARE:
        seen_ks, seen_alpha = np.where(is_seen[:, None], ks, np.nan), np.where(is_seen, alpha, np.nan)
        figures += [
            eye_map("specular ks", _on_the_picture(result, seen_ks), unit="of full scale"),
            value_map("roughness alpha", _on_the_picture(result, seen_alpha), "", 1.0),
        ]
        notes.append(
            f"A lobe is drawn where it adds at least {lobes_told.LEAST_HIGHLIGHT:.0%} to the diffuse part in the "
            f"mirror direction: in {share:.0%} of the pixels."
        )
    else:
        reason = f"they add less than {lobes_told.LEAST_HIGHLIGHT:.0%} to the diffuse part"
        notes = [lobes_told.no_lobe_in_words(share, reason)]
    residual = 100 * _on_the_picture(result, fields["residual"])
    figures.append(value_map("residual of the materials", residual, "% of the diffuse part", 10.0))
    return Section("materials", "Materials", figures=figures, notes=notes)


def _figures(about: dict[str, Any]) -> Section:
    errors = [(f"{row['light']}", f"{row['psnr_db']:.2f}", f"{row['mae']:.5f}") for row in about["held_out"]]
    kernels = [(kernel, f"{rms:.5f}") for kernel, rms in about["left_out_rms"].items()]
    return Section(
        "figures",
        "Figures",
        facts={"kernel": about["kernel"], "time": f"{about['seconds']:.1f} s"},
        tables=[
            Table("Left-out lights", ("light", "PSNR, dB", "mean absolute error"), errors),
            Table("Errors of the kernels at lights left out", ("kernel", "rms, of full scale"), kernels),
        ],
    )


def _uncertainty(result: PictureResult) -> Section:
    """Return a section about the known and the unknown uncertainty of normals and relit pictures."""
    cones_deg = np.load(result.folder / CONES)[result.mask]
    figures: list[Figure] = []
    words: list[Inline] = []
    if np.isfinite(cones_deg).any():
        words.append(
            f"Cones that contain 95 % of the normals: half angle {np.nanmedian(cones_deg):.1f} degrees (median)."
        )
        cones = _on_the_picture(result, cones_deg)
        figures.append(value_map("half angle of the normals' 95 % cones", cones, "degrees", 30.0))
    if (result.folder / INTERVALS).exists():
        words.append(
            "Relit pictures have intervals: coupole reflectance relight with --interval or --uncertainty."
        )
    else:
        words.append(f"No interval is stated for relit pictures: these need at least {FEWEST_LIGHTS} lights.")
    words.append("No uncertainty is stated for the materials.")
    return Section("uncertainty", "Uncertainty", words=words, figures=figures)


def _checks(result: PictureResult) -> Iterator[Figure]:
    left_out = np.asarray(result.about["left_out"])
    if not len(left_out):
        return
    interpolation = read_interpolation(result.folder)
    for light in left_out[:: 1 + len(left_out) // MOST_CHECKS]:
        photo = result.picture(result.values(np.array([light]))[0])
        model = relit(result, interpolation, result.directions[light])
        white = float(np.quantile(photo[result.mask], PEAK_QUANTILE))
        off = 100 * np.where(result.mask, np.abs(model - photo).mean(axis=2) / white, np.nan)
        outside = ~result.mask
        photo[outside], model[outside] = np.nan, np.nan
        yield eye_map(f"light {light}, measured", photo, white, "of full scale")
        yield eye_map(f"light {light}, made", model, white, "of full scale")
        yield value_map(f"light {light}, difference", off, "% of white", 5.0)
