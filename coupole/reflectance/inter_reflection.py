"""Light from one part of the object to another, estimated from its mesh and samples, and subtracted from them.

A sample of reflectance counts all light of its triangle as direct light of the LED. In a fold, other triangles
reflect a part of this light. The object is cut into patches. Their radiosity under each LED follows from the light
that reaches them, the diffuse reflectance of their samples, and their form factors (Goral et al. 1984). Rays from
each triangle then gather the arriving light. Samples in folds are too high. So the reflectance is lowered by the
estimated light, and the radiosity is computed again, until it settles. All intermediate reflection is taken as
diffuse.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from coupole.reflectance.discarded_frames import rewrite
from coupole.reflectance.extraction.frame_veils import GLARE
from coupole.reflectance.extraction.lamp_sight import lit_on
from coupole.reflectance.light_paths import NOTHING_AHEAD, Ahead, PathsOfLight, Scene, cosines_on, scene_of
from coupole.reflectance.result_folder import complete
from coupole.reflectance.run_result import AS_MEASURED, INTER_REFLECTION, SAMPLES, RunResult, ViewSamples
from coupole.reflectance.triangle_fit import TriangleSamples

Floats = NDArray[np.float64]
Said = Callable[[str, int, int], None]

_PASSES = 3
_MOST_BOUNCES = 8
_LEAST_COSINE = 0.2
"""Least cosine of incidence in the samples from which a triangle's diffuse reflectance is estimated."""
_MOST_REFLECTED = 0.95
MOST_SHARE = 0.5
"""Largest share of a sample that may be inter-reflection; samples with a larger share are left out."""


def radiosity(
    form_factors: csr_array, direct: NDArray[np.float32], apparent_reflectance: Floats, passes: int = _PASSES
) -> NDArray[np.float32]:
    """[channels, patches, leds] exitance of patches for a power of 1. `apparent_reflectance` [patches, channels]
    is the reflectance if all light counts as direct; patches that no LED reaches keep it."""
    exitances = []
    for channel_reflectance in apparent_reflectance.T:
        reflectance = channel_reflectance.copy()
        for _ in range(passes):
            exitance = reflectance[:, None].astype(np.float32) * direct
            for _ in range(_MOST_BOUNCES):
                indirect = form_factors @ exitance
                exitance = reflectance[:, None].astype(np.float32) * (direct + indirect)
            direct_power = direct.sum(axis=1)
            beside = np.where(direct > 0, indirect, 0.0).sum(axis=1)  # of the LEDs that samples are of
            share = np.where(direct_power > 0, direct_power / np.maximum(direct_power + beside, 1e-30), 1.0)
            reflectance = channel_reflectance * share
        exitances.append(exitance)
    return np.stack(exitances)


def subtract(
    result: RunResult,
    *,
    paper: bool,
    support_reflectance: float = 0.0,
    say: Said = lambda step, done, of: None,
    ahead: Ahead = NOTHING_AHEAD,
) -> None:
    """Subtract inter-reflection from the samples of views that still contain it. Each view's file is always
    complete, either the old one or the new one. Values that `ahead` remembers are the same as if they were
    computed here. Raises OSError."""
    missing = [view for view in result.views if view.inter_reflection is None]
    if not missing:
        return
    corners = result.corners_mm.astype(np.float64)
    pose = result.base_from_support
    support = (pose[:3, 3], pose[:3, 2]) if support_reflectance > 0 else None
    count = len(corners) + sum(len(view.triangles) for view in result.views)
    key = (hashlib.sha256(corners.tobytes()).hexdigest(), support_reflectance > 0)
    scene: Scene = ahead.result(count, ("scene", *key), lambda: scene_of(corners, support_z=support))
    paths = PathsOfLight(scene, key, count, paper, ahead)
    patch_reflectance, diffuse = _as_measured(result, paths, len(corners), support_reflectance)
    say("inter-reflection", 1, 2 + len(missing))
    form_factors = paths.form_factors()
    say("inter-reflection", 2, 2 + len(missing))
    for number, view in enumerate(missing):
        _subtract_view(view, paths, form_factors, patch_reflectance, diffuse[view.path.stem])
        say("inter-reflection", 3 + number, 2 + len(missing))


def _as_measured(
    result: RunResult, paths: PathsOfLight, count: int, support_reflectance: float
) -> tuple[Floats, dict[str, Floats]]:
    """Return the reflectance of patches and triangles, by `_apparent_reflectance` and `_diffuse`, before the
    subtraction. It is kept in a file, from which a stopped job continues."""
    path = result.folder / AS_MEASURED
    if not path.exists():
        diffuse = {view.path.stem: _diffuse_ahead(paths, result, view) for view in result.views}
        patch_reflectance = _apparent_reflectance(result, diffuse, paths.scene, count, support_reflectance)

        def write(part: Path) -> None:
            with h5py.File(part, "w") as file:
                file["shown"] = patch_reflectance
                for name, values in diffuse.items():
                    file[f"diffuse/{name}"] = values

        complete(path, write)
    with h5py.File(path, "r") as file:
        return file["shown"][()], {name: values[()] for name, values in file["diffuse"].items()}


def _diffuse_ahead(paths: PathsOfLight, result: RunResult, view: ViewSamples) -> Floats:
    """Return `_diffuse` of a view; it is remembered for the view's file of samples, which is only replaced, never
    changed."""
    about = view.path.stat()
    key = ("diffuse", *paths.key, about.st_dev, about.st_ino, about.st_mtime_ns, about.st_size)
    diffuse: Floats = paths.ahead.result(paths.count, key, lambda: _diffuse(result, view))
    return diffuse


def _apparent_reflectance(
    result: RunResult, diffuse: dict[str, Floats], scene: Scene, count: int, support_reflectance: float
) -> Floats:
    """[patches, channels] reflectance of each patch from the samples: the mean over its triangles. A patch that no
    view shows has the median of all triangles. The support has its own reflectance."""
    channels = result.channels
    sums, weights = np.zeros((scene.patches, channels)), np.zeros(scene.patches)
    every = []
    for view in result.views:
        values = diffuse[view.path.stem]
        is_finite = np.isfinite(values).all(axis=1)
        patches, areas = scene.patch[view.triangles[is_finite]], scene.areas_mm2[view.triangles[is_finite]]
        np.add.at(sums, patches, areas[:, None] * values[is_finite])
        np.add.at(weights, patches, areas)
        every.append(values[is_finite])
    usual = np.median(np.concatenate(every), axis=0)
    with np.errstate(invalid="ignore"):
        reflectance = np.where(weights[:, None] > 0, sums / weights[:, None], usual)
    reflectance = np.clip(np.pi * reflectance, 0.0, _MOST_REFLECTED)
    reflectance[np.unique(scene.patch[count:])] = support_reflectance
    return reflectance


def _diffuse(result: RunResult, view: ViewSamples, most: int = 64) -> Floats:
    """[n, channels] median of the samples of each triangle under some LEDs that are not at grazing incidence. If
    none of these LEDs reaches the triangle, the median is over all LEDs."""
    some_leds = np.zeros(len(view.leds), np.bool_)
    some_leds[:: max(1, len(view.leds) // most)] = True
    medians = np.full((len(view.triangles), result.channels), np.nan)
    for first in range(0, len(medians), 8192):
        rows = slice(first, min(first + 8192, len(medians)))
        for columns in (some_leds, ~some_leds):
            if np.isnan(medians[rows]).any():
                _fill_medians(medians[rows], result.view_samples(view, rows, columns))
    return medians


def _fill_medians(reflectances: Floats, samples: TriangleSamples) -> None:
    """Fill the rows of `reflectances` [n, channels] that have NaN with medians of the samples."""
    cosine = cosines_on(samples.centres_mm, samples.normals, samples.led_mm)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.where(cosine[..., None] > _LEAST_COSINE, samples.values / cosine[..., None], np.nan)
    missing = np.isnan(reflectances).any(axis=1) & np.all(np.isfinite(values).any(axis=1), axis=1)
    reflectances[missing] = np.nanmedian(values[missing], axis=1)


def _subtract_view(
    view: ViewSamples,
    paths: PathsOfLight,
    form_factors: csr_array,
    apparent_reflectance: Floats,
    diffuse: Floats,
) -> None:
    scene = paths.scene
    exitance = radiosity(form_factors, paths.direct(view), apparent_reflectance)
    gathers = paths.gathers(view)
    diffuse = np.where(np.isfinite(diffuse), diffuse, apparent_reflectance[scene.patch[view.triangles]] / np.pi)

    def write(part: Path) -> None:
        shutil.copyfile(view.path, part)
        shares, sample_count = [], 0
        with h5py.File(part, "r+") as file:
            description = "share of f that was inter-reflection, and was subtracted"
            share_dataset = file.create_dataset(
                INTER_REFLECTION, file["f"].shape, np.float16, chunks=file["f"].chunks, fillvalue=np.nan
            )
            share_dataset.attrs["told"] = description
            for first in range(0, len(view.triangles), 4096):
                rows = slice(first, min(first + 4096, len(view.triangles)))
                f = file["f"][rows]
                off = _off(view, scene, gathers[rows], exitance, diffuse[rows], rows, paths.paper)
                share = off / f
                share[~(share < MOST_SHARE)] = np.nan
                some = share[:: 1 + len(f) // 512]
                shares.append(some[np.isfinite(some)])
                file["f"][rows], file["u_own"][rows] = f * (1 - share), file["u_own"][rows] / (1 - share)
                if GLARE in file:
                    file[GLARE][rows] = file[GLARE][rows] / (1 - share)
                share_dataset[rows] = share.astype(np.float16)
                sample_count += int(np.count_nonzero(np.isfinite(share)))
            every = np.concatenate(shares)
            file.attrs[SAMPLES] = sample_count
            file.attrs[INTER_REFLECTION] = np.quantile(every, [0.5, 0.95]) if len(every) else [0.0, 0.0]

    rewrite(view.path, write)


def _off(
    view: ViewSamples,
    scene: Scene,
    gathers: csr_array,
    exitance: NDArray[np.float32],
    diffuse: Floats,
    rows: slice,
    paper: bool,
) -> NDArray[np.float32]:
    """[n, leds, channels] amount to subtract from f of triangles: their diffuse reflectance times the ratio of
    indirect to direct light."""
    triangles = view.triangles[rows]
    centres, normals = scene.centres_mm[triangles], scene.normals[triangles]
    arriving = lit_on(centres, view.led_mm, view.led_normals, paper) * cosines_on(centres, normals, view.led_mm)
    indirect = np.stack([gathers @ channel_exitance for channel_exitance in exitance], axis=-1)
    is_lit = arriving > 0
    total = np.where(is_lit, arriving, 0.0).sum(axis=1)[:, None]
    of_direct = total / np.maximum(total + np.where(is_lit[..., None], indirect, 0.0).sum(axis=1), 1e-30)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = (np.nan_to_num(diffuse) * of_direct)[:, None] * indirect / arriving[..., None]
    return np.where(is_lit[..., None], off, 0.0).astype(np.float32)
