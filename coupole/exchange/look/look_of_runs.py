"""Contents of a page of a result of runs: the mesh, and the material of each triangle with its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.exchange.atlas.flat_surface import flatten
from coupole.exchange.look.coarse_mesh import MOST_TRIANGLES, coarse_mesh
from coupole.exchange.look.look_blocks import Block, Look, block_of, halves, log_coded, octahedral
from coupole.exchange.look.look_frames import frames_of_view
from coupole.exchange.look.look_samples import samples_of_result
from coupole.exchange.look.look_texels import MOST_PX, NOWHERE, LookTexels, look_texels
from coupole.exchange.look.residual_planes import PLANES, residual_blocks, residual_fit
from coupole.exchange.material_values import red_green_blue, standard_uncertainties
from coupole.exchange.of_results.measured_surface import ExportChoice, read_surface
from coupole.geometry import apply, inverse
from coupole.reflectance.fits import MATERIALS, OF_TEXELS, TEXELS
from coupole.reflectance.run_relighting import best_fit
from coupole.reflectance.run_result import RunResult, read_about
from coupole.reflectance.texels.pixel_file import has_texels
from coupole.storage import so_far

Floats = NDArray[np.float64]
Said = Callable[[str, int, int], None]

PLACES = 65535
"""Number of steps of a coordinate along the longest side of the object."""


@dataclass(frozen=True)
class PageChoice:
    """Choices of what a page shows of a result of runs."""

    fit: str | None = None
    """The fit. By default: texels if there are any; otherwise the best fit, or the one to which a residual is
    added."""
    planes: int | None = None
    """Number of planes of the residual, 0 for none. By default `PLANES`, if triangles are shown and have a
    residual."""
    with_samples: bool = False
    map_px: int = MOST_PX
    """Greatest width of maps."""
    coarse_over: int = MOST_TRIANGLES
    """Number of triangles above which a coarse mesh is shown first."""
    beside: OtherState | None = None


@dataclass(frozen=True)
class OtherState:
    """A result of the same object at another time."""

    folder: Path
    first_from_other: Floats
    """[4, 4] transform from the other result's support frame to the first one's, mm."""
    remark: str
    """Sentence about the alignment of the two."""


def look_of_result(folder: Path, say: Said = lambda *_: None, choice: PageChoice | None = None) -> Look:
    """Return the page's contents for a complete result.

    Raises InputError for an incomplete result, for one without material, and for a residual together with texels.
    """
    choice = choice or PageChoice()
    source_about = read_about(folder)
    result = RunResult(folder)
    texels = _texels_of(result, choice, say)
    planes = 0 if texels else PLANES if choice.planes is None else choice.planes
    left_of = residual_fit(result) if planes and choice.fit is None else None
    fit = choice.fit or (TEXELS if texels else left_of or best_fit(result, MATERIALS))
    other_state = _other_state(choice, fit, say) if choice.beside else None
    support_from_base = inverse(result.base_from_support)
    corners_mm = apply(support_from_base, result.corners_mm.reshape(-1, 3).astype(np.float64))
    both_mm = np.concatenate([corners_mm, other_state.corners_mm]) if other_state else corners_mm
    places, triangles, origin_mm, step_mm = weld_corners(corners_mm, both_mm)
    count = len(triangles)
    shapes: dict[str, NDArray[Any]] = {"places": places, "triangles": triangles}
    of_triangles = texels.of_triangles if texels else _materials(result, fit, support_from_base)
    count_measured = int(np.count_nonzero(of_triangles["gloss"][:, 0]))
    maps = {"map_places": texels.map_places} if texels else {}
    blocks = tuple(block_of(name, values) for name, values in (shapes | of_triangles | maps).items())
    views = [frames for view in result.views if (frames := frames_of_view(result, view, support_from_base))]
    about: dict[str, Any] = {
        "kind": "mesh",
        "fit": fit,
        "simulated": bool(source_about.get("simulated")),
        "software": source_about.get("software", {}),
        "views": [view for view, _ in views],
        "scan_noise_um": source_about.get("scan_noise_um"),
        "mesh_sha256": source_about.get("mesh"),
        "led_exponent": 2 if source_about.get("emission") == "paper" else 1,
        "triangles": count,
        "measured": count_measured,
        "irradiance": math.pi,
        "unit": "1/sr",
        "told": _facts(result, f"{count:,}, {count_measured:,} with a material", source_about.get("simulated")),
        "box": _box_steps(both_mm, origin_mm, step_mm),
        "origin_mm": origin_mm.tolist(),
        "step_mm": step_mm,
    }
    later = _residuals(result, fit, planes, about, say) if left_of else []
    if texels:
        about["texels"], later = texels.about, texels.blocks
        about["told"]["Texels"] = texels.remark
    later += [block for _, pictures in views for block in pictures]
    if other_state:
        later += other_state.blocks(both_mm, about)
    errors = (_ERRORS_OF_TEXELS if texels else _ERRORS) | {
        "places": f"{0.5e3 * step_mm:.2g} um in each coordinate"
    }
    if choice.with_samples:
        errors["samples"] = "2.3 % of the value, and of its distance to each end of its interval"
        samples = samples_of_result(result, support_from_base, source_about["scan_noise_um"], say)
        about["samples"], later = samples[0], later + samples[1]
    if growing := so_far.words(source_about):
        about["remarks"], about["told"]["So far"] = [growing], growing
    coarse = _coarse_blocks(places, triangles, of_triangles, choice.coarse_over, has_maps=bool(maps))
    return Look(about, blocks, tuple(later), coarse, errors)


def _facts(result: RunResult, triangles_text: str, is_simulated: object) -> dict[str, str]:
    """Return facts that the page states in text."""
    return {
        "Object": "simulated" if is_simulated else "measured",
        "Triangles": triangles_text,
        "Views": ", ".join(view.view for view in result.views),
        "Light": "straight from lamps, with shadows; no light from surface to surface. White "
        "is the radiance that is "
        "shown as white; a white diffuser that faces a light of strength 1 has 1.",
    }


def _box_steps(corners_mm: Floats, origin_mm: Floats, step_mm: float) -> list[list[int]]:
    """Return the bounding box of all corners, in steps from the origin."""
    ends_mm = np.stack([corners_mm.min(axis=0), corners_mm.max(axis=0)])
    box: list[list[int]] = np.rint((ends_mm - origin_mm) / step_mm).astype(int).tolist()
    return box


def _texels_of(
    result: RunResult, choice: PageChoice, say: Said, turn: Floats | None = None, prefix: str = ""
) -> LookTexels | None:
    """Return the texels, unless triangles are to be shown. A rotation [3, 3] is applied to their normals."""
    if choice.fit not in (None, *OF_TEXELS) or (choice.fit is None and (choice.planes or not has_texels(result))):
        return None
    if choice.planes:
        raise InputError("--residual-planes: a residual belongs to triangles; texels have none")
    options = ExportChoice(map_px=choice.map_px, say=say)
    surface = read_surface(result.folder, choice.fit or TEXELS, options, takes_texels=True)
    flat = flatten(surface)
    if turn is not None:
        flat = replace(flat, normals=(flat.normals @ turn.T).astype(np.float32))
    texels = look_texels(flat, len(result.corners_mm), prefix)
    return replace(texels, remark="; ".join(filter(None, (texels.remark, surface.sharing))))


_ERRORS_OF_TEXELS = {
    "normals": "0.03 degrees",
    "kd, ks": "8 bit of the root, relative to the brightest, in JPEG",
    "roughness": "0.4 % of the root of alpha",
    "uncertainties": "2.3 % of their value; means over triangles",
    "measured frames": "8 bit, at most 640 pixels wide, encoded as sRGB up to the 99.9 % quantile",
}
_ERRORS = {
    "normals": "0.004 degrees",
    "kd, ks, roughness": "0.05 % or 3e-8",
    "uncertainties": "2.3 % of their value",
    "measured frames": "8 bit, at most 640 pixels wide, encoded as sRGB up to the 99.9 % quantile",
}


def _residuals(result: RunResult, fit: str, planes: int, about: dict[str, Any], say: Said) -> list[Block]:
    """Return blocks of the residuals of a fit; facts about them are added to `about`."""
    about["residual"], blocks = residual_blocks(result, planes, say)
    about["told"]["Residual"] = (
        f"the residual of {fit} in each view's samples, as {planes} planes, which contain "
        f"{100 * about['residual']['kept']:.4g} % of its energy. The residual belongs to one view, and fades out "
        "beside this view."
    )
    return blocks


def _materials(result: RunResult, fit: str, support_from_base: Floats) -> dict[str, NDArray[Any]]:
    """Return numbers of all triangles by name; 0 for those without a material. Raises InputError for an unknown
    fit."""
    if fit not in MATERIALS:
        raise InputError(f"--fit: expected {', '.join((*MATERIALS, *OF_TEXELS))}; got {fit}")
    path = result.materials_path(fit)
    if not path.exists():
        raise InputError(f"{result.folder}: has no fit {fit}; `coupole reflectance fit {result.folder}` makes it")
    materials, count = result.materials(fit), len(result.corners_mm)
    finite = np.isfinite(materials.alpha) & np.isfinite(materials.kd).all(axis=1)
    at, rows = result.triangles[finite], finite.nonzero()[0]
    normals = materials.normals[rows] @ support_from_base[:3, :3].T
    values: dict[str, NDArray[Any]] = {
        "normals": octahedral(normals),
        "kd": halves(red_green_blue(materials.kd[rows])),
        "ks": halves(red_green_blue(materials.ks[rows])),
        "gloss": halves(_pair(materials.alpha, materials.residual)[rows]),
        "uncertainty": _uncertainty(path)[rows],
    }
    return {name: _spread_values(numbers, at, count) for name, numbers in values.items()}


def _coarse_blocks(
    places: NDArray[np.uint16],
    triangles: NDArray[np.uint32],
    of_triangles: dict[str, NDArray[Any]],
    over: int,
    *,
    has_maps: bool,
) -> tuple[Block, ...]:
    """Return blocks of a coarse mesh, which has no maps; none if the mesh has at most `over` triangles."""
    if len(triangles) <= over:
        return ()
    coarse = coarse_mesh(places, triangles, over)
    arrays: dict[str, NDArray[Any]] = {"places": coarse.places, "triangles": coarse.triangles}
    arrays |= {name: values[coarse.stands_for] for name, values in of_triangles.items()}
    if has_maps:
        arrays["map_places"] = np.full((len(coarse.triangles), 3), NOWHERE, np.uint32)
    return tuple(block_of(f"first-{name}", values) for name, values in arrays.items())


@dataclass(frozen=True)
class _Other:
    """The other state, in the frame of the first one."""

    name: str
    remark: str
    fit: str
    corners_mm: Floats
    """[3 n, 3]"""
    of_triangles: dict[str, NDArray[Any]]
    texels: LookTexels | None

    def blocks(self, both_mm: Floats, about_page: dict[str, Any]) -> list[Block]:
        """Return the blocks of the state, and add its facts to `about_page`. `both_mm` are the corners of both
        states."""
        places, triangles, _, _ = weld_corners(self.corners_mm, both_mm)
        arrays: dict[str, NDArray[Any]] = {"places": places, "triangles": triangles, **self.of_triangles}
        if self.texels:
            arrays["map_places"] = self.texels.map_places
        about: dict[str, Any] = {"name": self.name, "told": self.remark, "fit": self.fit, "blocks": list(arrays)}
        about_page["beside"] = about | {"texels": self.texels.about if self.texels else None}
        blocks = [block_of(f"{_BESIDE}{name}", values) for name, values in arrays.items()]
        return blocks + (self.texels.blocks if self.texels else [])


_BESIDE = "beside-"


def _other_state(choice: PageChoice, fit_of_first: str, say: Said) -> _Other:
    """Read the other state, with the fit of the first one if it has that fit. Raises the InputError of
    `look_of_result`."""
    assert choice.beside is not None
    folder, first_from_other = choice.beside.folder, choice.beside.first_from_other
    read_about(folder)
    result = RunResult(folder)
    other_choice = replace(choice, planes=None, fit=choice.fit if fit_of_first in OF_TEXELS else fit_of_first)
    texels = _texels_of(result, other_choice, say, first_from_other[:3, :3], _BESIDE)
    has_same = fit_of_first in MATERIALS and result.materials_path(fit_of_first).exists()
    best = fit_of_first if has_same else best_fit(result, MATERIALS)
    fit = choice.fit or (TEXELS if texels else best)
    first_from_base = first_from_other @ inverse(result.base_from_support)
    corners_mm = apply(first_from_base, result.corners_mm.reshape(-1, 3).astype(np.float64))
    of_triangles = texels.of_triangles if texels else _materials(result, fit, first_from_base)
    return _Other(folder.resolve().name, choice.beside.remark, fit, corners_mm, of_triangles, texels)


def weld_corners(
    corners_mm: Floats, within_mm: Floats | None = None
) -> tuple[NDArray[np.uint16], NDArray[np.uint32], Floats, float]:
    """Weld corners [3 n, 3] of triangles.

    Returns places [m, 3] in steps from an origin, each once, in the order of their first use; triangles [n, 3] as
    numbers of places; and [3] origin and step, mm. Origin and step are those of all places `within_mm` [m, 3]; by
    default, of the corners.
    """
    within_mm = corners_mm if within_mm is None else within_mm
    origin_mm = within_mm.min(axis=0)
    step_mm = max(float(np.ptp(within_mm, axis=0).max()), 1e-6) / PLACES
    steps = np.rint((corners_mm - origin_mm) / step_mm).astype(np.uint64)
    keys = steps[:, 0] << np.uint64(32) | steps[:, 1] << np.uint64(16) | steps[:, 2]
    _, first, number = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.uint32)
    rank[order] = np.arange(len(order), dtype=np.uint32)
    places = steps[first[order]].astype(np.uint16)
    return places, rank[number.reshape(-1)].reshape(-1, 3), origin_mm, step_mm


def _uncertainty(path: Path) -> NDArray[np.uint8]:
    """[n, 4] codes of the standard uncertainties of kd, ks, normal and alpha."""
    return log_coded(np.stack(list(standard_uncertainties(path).values()), axis=1))


def _pair(first: Floats, second: Floats) -> Floats:
    return np.stack([first, second], axis=1)


def _spread_values(values: NDArray[Any], at: NDArray[np.int64], count: int) -> NDArray[Any]:
    """[count, ...] the values of triangles at their numbers; 0 for all others."""
    all_of_them = np.zeros((count, *values.shape[1:]), values.dtype)
    all_of_them[at] = values
    return all_of_them
