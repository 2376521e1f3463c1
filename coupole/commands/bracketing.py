"""`coupole bracket`: photographs with several exposure times, merged into one picture with linear values."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    from coupole.exchange.bracket.camera_response import Response
    from coupole.exchange.bracket.exposure_merging import Merged
    from coupole.exchange.bracket.photographs import Photographs
    from coupole.exchange.bracket.sphere_brdf import Finish

_TOLD_FROM = 1e-3
"""Least share of contradicting pixels for which a message names the photograph."""


def bracket(
    photographs: Annotated[
        list[Path], typer.Argument(help="JPEG, PNG, TIFF or raw files of one scene.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", help="The merged picture, OpenEXR.", show_default=False)],
    exposure_s: Annotated[
        list[float] | None,
        typer.Option(help="Exposure time of each photograph, in their order; by default the time in EXIF."),
    ] = None,
    linear: Annotated[
        bool, typer.Option("--linear", help="Pixel values are proportional to exposure, as in raw files.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Merge photographs of different exposure times, taken from a tripod with one aperture and ISO number.

    The command finds the camera's response from them, and draws it. For raw files the response is known to be
    linear, and the command only tests this.
    """
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        if out.suffix.lower() != ".exr":
            raise InputError(f"--out {out}: expected a name that ends in .exr")
        with console.status("reading"):
            from coupole.exchange.bracket import camera_response, exposure_merging, merged_files
            from coupole.exchange.bracket.photographs import read_photographs

            photos = read_photographs(photographs, exposure_s)
        with console.status("finding the response"):
            curve = camera_response.found_response(photos)
        response = camera_response.linear_response(curve.noise) if linear or photos.raw else curve
        with console.status("merging"):
            picture = exposure_merging.merge_exposures(photos, response)
            first, last = photos.exposure_s[[0, -1]]
            description = f"merged from {len(photos.paths)} photographs, {first:g} to {last:g} s"
            remark = "" if linear or photos.raw else camera_response.left_open(photos.exposure_s)
            description = "; ".join(filter(None, (description, remark)))
            merged_files.write_exr(out, picture, description)
            drawing_path = out.with_name(f"{out.stem}-response.png")
            merged_files.draw_response(drawing_path, curve, f"Response found from {len(photos.paths)} photographs")
        document = _document(photos, curve, picture, out, drawing_path, is_linear=linear or photos.raw)
        document["remarks"] = [remark] if remark else []
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps(document))
        return
    for line in _lines(document):
        console.print(line, markup=False)


def sphere_brdf(
    sample: Annotated[
        Path, typer.Argument(help="YAML of sphere, lights, white and photographs.", show_default=False)
    ],
    out: Annotated[Path, typer.Option("--out", help="The table, MERL's format (.binary).", show_default=False)],
    as_json: JsonOption = False,
) -> None:
    """Compute the BRDF of a finish from merged photographs of a coated sphere, each under one distant light."""
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        if out.suffix.lower() != ".binary":
            raise InputError(f"--out {out}: expected a name that ends in .binary")
        with console.status("fitting"):
            from coupole.exchange.bracket import sphere_brdf as fitting
            from coupole.exchange.bracket.merged_files import read_known
            from coupole.exchange.of_results.merl import encode_reflectance
            from coupole.plan import yamlfile
            from coupole.storage.durable import write_synced

            setup = yamlfile.read_document(sample).validate(fitting.SphereSample)
            pictures = [read_known(sample.parent / lit.path) for lit in setup.photographs]
            samples = fitting.samples_of(setup, pictures)
            finish = fitting.finish_of(samples)
            off = fitting.misses(samples, finish)
        with console.status("writing"):
            write_synced(out, encode_reflectance(fitting.finish_function(finish)))
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    document = {"table": str(out), "samples": len(samples.f), "median_miss": off[0], "miss_of_95_percent": off[1]}
    paths = [str(lit.path) for lit in setup.photographs]
    left_out = [{"path": paths[miss.photograph]} | asdict(miss) for miss in finish.left_out]
    if as_json:
        print(json.dumps(document | {"left_out": left_out}))
        return
    text = f"{out}: {len(samples.f)} samples; error at most {off[0]:.1%} for half of them, {off[1]:.1%} for 95 %"
    console.print(text, markup=False)
    for line in _prediction_lines(finish, paths) if len(paths) > 1 else []:
        console.print(line, markup=False)


def _prediction_lines(finish: Finish, paths: list[str]) -> list[str]:
    """Return one line for each photograph that the others predict."""
    return [
        "prediction of each photograph by the others: incidence, error at the peak, median error, nearest sample",
        *(
            f"  {paths[miss.photograph]}: {miss.incidence_deg:.0f} degrees, {miss.peak_miss:+.1%}, "
            f"{miss.median_miss:.1%}; {miss.nearest_to_peak_deg:.1f} degrees from the peak"
            for miss in finish.left_out
        ),
    ]


def _document(
    photographs: Photographs,
    curve: Response,
    merged_picture: Merged,
    out: Path,
    response_picture: Path,
    *,
    is_linear: bool,
) -> dict[str, Any]:
    import numpy as np

    is_finite = np.isfinite(merged_picture.uncertainty)
    steps = slice(0, None, 15)
    sigma = curve.uncertainty[steps]
    return {
        "picture": str(out),
        "response_picture": str(response_picture),
        "unit": "relative; 1 shows half of the largest value in one second",
        "photographs": [
            {"path": str(path), "exposure_s": float(time), "contradicting": float(off.mean())}
            for path, time, off in zip(
                photographs.paths, photographs.exposure_s, merged_picture.contradicting, strict=True
            )
        ],
        "used_response": "linear" if is_linear else "found",
        "departure_from_straight": curve.straightness(),
        "noise_of_values": curve.noise.tolist(),
        "response": {
            "value": np.linspace(0.0, 1.0, len(curve.log_exposure))[steps].tolist(),
            "ln_exposure": curve.log_exposure[steps].tolist(),
            "u_ln_exposure": np.where(np.isfinite(sigma), sigma, -1.0).tolist(),
        },
        "saturated": float(merged_picture.saturation_mask.any(axis=2).mean()),
        "dark": float(merged_picture.dark.any(axis=2).mean()),
        "median_uncertainty": float(np.median(merged_picture.uncertainty[is_finite])) if is_finite.any() else None,
    }


def _lines(document: dict[str, Any]) -> list[str]:
    lines = [f"{document['picture']}: {len(document['photographs'])} photographs merged"]
    if document["median_uncertainty"] is not None:
        lines[0] += (
            f"; for half of the pixels the standard uncertainty is at most {document['median_uncertainty']:.2%}"
        )
    lines.append(f"{document['response_picture']}: the response found from the photographs")
    off = document["departure_from_straight"]
    if document["used_response"] == "linear":
        lines.append(
            f"the pictures were taken as linear; between 10 and 90 % of the values, the response found "
            f"is straight within {off:.1%}"
        )
        if off > 0.1:
            lines.append(
                "this departure is large: processed pictures are not linear; leave out --linear, or give raw files"
            )
    for state, meaning in (("saturated", "at least as bright as written"), ("dark", "hardly more than noise")):
        if document[state] > 0.0:
            lines.append(f"{document[state]:.2%} of the pixels are {state} in all photographs: {meaning}")
    lines += document["remarks"]
    lines += [
        f"{photo['path']}: {photo['contradicting']:.1%} of its pixels contradict the others and are left out; has "
        "something moved, or the light changed?"
        for photo in document["photographs"]
        if photo["contradicting"] > _TOLD_FROM
    ]
    return lines
