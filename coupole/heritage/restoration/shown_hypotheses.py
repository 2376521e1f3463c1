"""Pictures of hypotheses for the eye, with one white for all and words below each; pictures side by side, and
differences."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import coupole
from coupole.appearance.render import colour, pictures
from coupole.appearance.render.denoising import DENOISED, denoised_xyz
from coupole.appearance.render.materials import used_values
from coupole.errors import InputError, StorageError, reason
from coupole.heritage.restoration import hypotheses_compared, labelled_pictures
from coupole.heritage.restoration.labelled_pictures import (
    Picture,
    caption_lines,
    for_png,
    metadata_texts,
    with_strip,
)
from coupole.heritage.restoration.restoration_file import Hypothesis
from coupole.heritage.restoration.restoring import Made, Restoration, Say, common_white
from coupole.intake.plain_data import read_json

RESULT = "result.json"
_GAP_PX = 6


@dataclass(frozen=True)
class Shown:
    """Files and figures that are written for one view."""

    camera: str
    pictures: dict[str, Path]
    """Pictures by the names of hypotheses."""
    side_by_side: Path | None
    differences: dict[tuple[str, str], Path]
    of_parts: dict[tuple[str, str], dict[str, dict[str, Any]]]
    """Figures of the parts, in the form of `hypotheses_compared.Difference.of_parts`."""


def show_all(restoration: Restoration, made_pictures: Sequence[Made], out: Path, say: Say) -> dict[str, Any]:
    """Write PNG pictures, pictures side by side, differences and `result.json`; return the content of
    `result.json`.

    Raises InputError if all is black or the denoiser is missing, StorageError.
    """
    white_cd_m2 = common_white(restoration, made_pictures)
    views = []
    try:
        for number, camera in enumerate(restoration.cameras):
            say("showing", number, len(restoration.cameras))
            renderings = [rendering for rendering in made_pictures if rendering.camera.name == camera.name]
            views.append(_of_view(restoration, renderings, white_cd_m2, out))
        say("showing", len(views), len(views))
        result = _result(restoration, made_pictures, views, white_cd_m2, out)
        (out / RESULT).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{out}: {reason(error)}. Choose another folder, or free space.") from error
    return result


def refuse_other_lights(out: Path, lights: str | None) -> None:
    """Raise InputError if `out` has the pictures of a restoration under other lights, because they would be
    lost."""
    path = out / RESULT
    earlier = read_json(path, allow_nan=True) if path.is_file() else None
    if isinstance(earlier, dict) and "hypotheses" in earlier and earlier.get("lights") != lights:
        under = f"the lights {earlier['lights']}" if earlier.get("lights") else "the file's own `lights`"
        raise InputError(
            f"--out {out}: has pictures under {under}; name another folder for pictures under other lights"
        )


# -- helpers --------------------------------------------------------------------------------------------------


def _of_view(restoration: Restoration, made_pictures: Sequence[Made], white_cd_m2: float, out: Path) -> Shown:
    camera = made_pictures[0].camera
    colours = [rendering.xyz() for rendering in made_pictures]
    if restoration.restoration_file.display.denoised:
        displays = [
            _displayed_picture(restoration, denoised_xyz(xyz.astype(float)), white_cd_m2) for xyz in colours
        ]
    else:
        displays = [_displayed_picture(restoration, xyz, white_cd_m2) for xyz in colours]
    room = max(len(caption_lines(camera.width_px, rendering.hypothesis)) for rendering in made_pictures)
    strips = [
        labelled_pictures.captioned_picture(picture, of.hypothesis, room)
        for picture, of in zip(displays, made_pictures, strict=True)
    ]
    files = {}
    for picture, rendering in zip(strips, made_pictures, strict=True):
        files[rendering.hypothesis.name] = rendering.exr.with_suffix(".png")
        about = _about(restoration, rendering, white_cd_m2)
        pictures.write_png(
            rendering.exr.with_suffix(".png"), picture, about, for_png(metadata_texts([rendering.hypothesis]))
        )
    beside = _side_by_side(strips, made_pictures, out) if len(made_pictures) > 1 else None
    parts = restoration.seen_parts.part_of_pixel(camera)
    differences, of_parts = {}, {}
    for (first, rendering), (second, other_rendering) in combinations(enumerate(made_pictures), 2):
        pair = rendering.hypothesis.name, other_rendering.hypothesis.name
        difference = hypotheses_compared.compare_pictures(
            colours[first], colours[second], parts, restoration.parts.names, restoration.eye, white_cd_m2
        )
        differences[pair] = out / f"difference-{pair[0]}-{pair[1]}-{camera.name}.png"
        of_parts[pair] = difference.of_parts
        _write_difference(difference.de00, (rendering, other_rendering), differences[pair])
    return Shown(camera.name, files, beside, differences, of_parts)


def _displayed_picture(restoration: Restoration, xyz: NDArray[Any], white_cd_m2: float) -> Picture:
    adaptation = restoration.restoration_file.display.adaptation
    return colour.displayed_srgb(colour.adapted_xyz(xyz / white_cd_m2, restoration.eye.white, adaptation))[0]


def _about(restoration: Restoration, made_picture: Made, white_cd_m2: float) -> str:
    denoising = f"; {DENOISED}" if restoration.restoration_file.display.denoised else ""
    return (
        f"{restoration.restoration_file.name}, hypothesis {made_picture.hypothesis.name}: {pictures.SYNTHETIC}; "
        f"{made_picture.about['renderer']}; white {white_cd_m2:.4g} cd/m2{denoising}"
    )


def _side_by_side(strips: Sequence[Picture], made_pictures: Sequence[Made], out: Path) -> Path:
    height, width = strips[0].shape[:2]
    sheet = np.zeros((height, len(strips) * (width + _GAP_PX) - _GAP_PX, 3), np.uint8)
    for number, strip in enumerate(strips):
        first = number * (width + _GAP_PX)
        sheet[:, first : first + width] = strip
    path = out / f"side-by-side-{made_pictures[0].camera.name}.png"
    hypotheses = [rendering.hypothesis for rendering in made_pictures]
    names = "; ".join(f"hypothesis {hypothesis.name}" for hypothesis in hypotheses)
    pictures.write_png(path, sheet, f"{names}: {pictures.SYNTHETIC}", for_png(metadata_texts(hypotheses)))
    return path


def _write_difference(de00: NDArray[np.float64], pair: tuple[Made, Made], path: Path) -> None:
    names = " and ".join(f"hypothesis {rendering.hypothesis.name}" for rendering in pair)
    words = f"Between {names}: colour difference, CIEDE2000; 0 light, {hypotheses_compared.FULL_DE00:g} violet"
    width = de00.shape[1]
    lines = labelled_pictures.break_lines(words, width)
    picture = with_strip(hypotheses_compared.difference_picture(de00), lines, len(lines))
    pictures.write_png(path, picture, words, for_png(metadata_texts([rendering.hypothesis for rendering in pair])))


def _facts(hypothesis: Hypothesis, folder: Path) -> dict[str, Any]:
    """Return a hypothesis with the values from which its materials are computed, including defaults that have an
    effect."""
    materials = {part: used_values(material, folder) for part, material in hypothesis.materials.items()}
    return {**hypothesis.model_dump(mode="json", exclude={"materials"}), "materials": materials}


def _result(
    restoration: Restoration,
    made_pictures: Sequence[Made],
    shown_views: Sequence[Shown],
    white_cd_m2: float,
    out: Path,
) -> dict[str, Any]:
    def name(path: Path | None) -> str | None:
        return None if path is None else path.relative_to(out).as_posix()

    by_view = {(rendering.hypothesis.name, rendering.camera.name): rendering for rendering in made_pictures}
    views = []
    for view in shown_views:
        view_pictures = {}
        for hypothesis, path in view.pictures.items():
            rendering = by_view[hypothesis, view.camera]
            figures = {key: rendering.about[key] for key in ("renderer", "samples", "noise", "mean_cd_m2")}
            view_pictures[hypothesis] = {"png": name(path), "exr": name(rendering.exr), **figures}
        differences = [
            {"hypotheses": list(pair), "png": name(path), "parts": view.of_parts[pair]}
            for pair, path in view.differences.items()
        ]
        views.append(
            {
                "view": view.camera,
                "pictures": view_pictures,
                "side_by_side": name(view.side_by_side),
                "differences": differences,
            }
        )
    return {
        "schema_version": 1,
        "software": f"coupole {coupole.__version__}",
        "restoration": restoration.restoration_file.name,
        "synthetic": True,
        "mesh": {"name": restoration.mesh.path.name, "sha256_of_shape": restoration.mesh.digest()},
        "parts": restoration.parts.counts(),
        "remarks": list(restoration.parts.remarks),
        "hypotheses": [_facts(hypothesis, restoration.folder) for hypothesis in restoration.hypotheses],
        "lights": restoration.lights_name,
        "observer": f"CIE {restoration.restoration_file.observer}",
        "bands": len(range(380, 781, restoration.restoration_file.bands.step_nm)),
        "white_cd_m2": round(white_cd_m2, 6),
        "made_anew": sum(rendering.is_new for rendering in made_pictures),
        "taken_as_they_were": sum(not rendering.is_new for rendering in made_pictures),
        "views": views,
    }
