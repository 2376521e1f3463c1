"""Light from one part of the object to another, estimated from its mesh and samples, and subtracted from them.

A sample of reflectance counts all light of its triangle as the LED's own. In a fold a part of it came by way of
other triangles. The object is cut into patches; their radiosity under each LED follows from the light that
reaches them, the diffuse reflectance that their samples show, and how much of each other they see (Goral et al.
1984). Rays from each triangle then gather what arrives. Samples of folds are too high, so the reflectance that is
used is lowered by what was found, and the radiosity found again, until it settles. All reflection on the way is
taken as diffuse.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from coupole.motion.occlusion import RAY_START_MM, blocked_segments, ray_mesh
from coupole.reflectance.discarded_frames import rewrite
from coupole.reflectance.extraction.frame_veils import GLARE
from coupole.reflectance.extraction.lamp_sight import lit_on
from coupole.reflectance.result_folder import complete
from coupole.reflectance.run_result import AS_MEASURED, INTER_REFLECTION, SAMPLES, RunResult, ViewSamples
from coupole.reflectance.triangle_fit import TriangleSamples

Floats = NDArray[np.float64]
Said = Callable[[str, int, int], None]

MOST_PATCHES = 4000
_RAYS_OF_A_TRIANGLE = 128
_POINTS = 4
"""Triangles that stand for a patch."""
_PASSES = 3
_MOST_BOUNCES = 8
_LEAST_COSINE = 0.2
"""Least cosine of light in the samples by which a triangle's diffuse reflectance is found."""
_MOST_REFLECTED = 0.95
MOST_SHARE = 0.5
"""Upper bound of inter-reflection as a share of a sample; other samples are left out."""
_SUPPORT_CELLS = 24
_RAYS = 1_000_000


@dataclass(frozen=True)
class Scene:
    """The object's triangles, and those of the support it stands on if that reflects."""

    rays: Any
    centres_mm: Floats
    """[m, 3]"""
    normals: Floats
    """[m, 3] unit, outward."""
    areas_mm2: Floats
    """[m]"""
    patch: NDArray[np.int64]
    """[m] number of a triangle's patch."""
    corners_mm: Floats

    @property
    def patches(self) -> int:
        return int(self.patch.max()) + 1


def scene_of(corners_mm: Floats, *, support_z: tuple[Floats, Floats] | None = None) -> Scene:
    """Return the scene of triangles [m, 3, 3]. `support_z` is a point of the support and its unit normal, if it
    reflects: a square of three times the object's width comes to the scene."""
    count = len(corners_mm)
    if support_z is not None:
        corners_mm = np.concatenate([corners_mm, _support(corners_mm, *support_z)])
    across = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    twice = np.maximum(np.linalg.norm(across, axis=1), 1e-300)
    centres, normals = corners_mm.mean(axis=1), across / twice[:, None]
    of_support = np.arange(len(centres)) >= count
    patch = _patches(centres, normals, of_support)
    return Scene(ray_mesh(corners_mm), centres, normals, 0.5 * twice, patch, corners_mm)


def _support(corners_mm: Floats, point_mm: Floats, normal: Floats) -> Floats:
    """[2 cells^2, 3, 3] triangles of the support."""
    flat = corners_mm.reshape(-1, 3) - (corners_mm.reshape(-1, 3) - point_mm) @ normal[:, None] * normal
    middle, half = flat.mean(axis=0), 1.5 * np.ptp(flat, axis=0).max()
    first = np.linalg.svd(np.eye(3) - np.outer(normal, normal))[0][:, 0]
    second = np.cross(normal, first)
    steps = np.linspace(-half, half, _SUPPORT_CELLS + 1)
    grid = middle + steps[:, None, None] * first + steps[None, :, None] * second
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.stack([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]).reshape(-1, 3, 3)


def _patches(centres_mm: Floats, normals: Floats, of_support: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Numbers of cells of a grid and of the sixth of all directions that a normal points to, as fine as there may
    be patches."""
    low, size = centres_mm.min(axis=0), float(np.ptp(centres_mm, axis=0).max())
    axis = np.argmax(np.abs(normals), axis=1)
    facing = 2 * axis + (np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0)
    cells = 128.0
    while True:
        cell = np.floor((centres_mm - low) / max(size, 1e-9) * cells).astype(np.int64)
        key = ((cell[:, 0] * 1024 + cell[:, 1]) * 1024 + cell[:, 2]) * 12 + 6 * of_support + facing
        number = np.unique(key, return_inverse=True)[1]
        if number.max() < MOST_PATCHES or cells < 2:
            return number
        cells *= 0.8


def seen_from(scene: Scene, triangles: NDArray[np.int64], seed: int) -> csr_array:
    """[n, patches] share of the half space over each of some triangles, weighted by the cosine, that a patch's
    front fills: by rays from places spread over the triangle."""
    random = np.random.default_rng(seed)
    across = math.isqrt(_RAYS_OF_A_TRIANGLE // 2)
    strata = np.stack(np.divmod(np.arange(2 * across * across), 2 * across), axis=-1)
    step = max(1, _RAYS // len(strata))
    starts = range(0, len(triangles), step)
    seeds = [int(number) for number in random.integers(0, 2**31, len(starts))]

    def part(first: int, seed: int) -> csr_array:
        part_triangles = triangles[first : first + step]
        return _gather_rays(scene, part_triangles, strata, np.random.default_rng(seed))

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        parts = list(pool.map(part, starts, seeds))
    return vstack(parts, format="csr")


def _gather_rays(
    scene: Scene, triangles: NDArray[np.int64], strata: NDArray[np.int64], random: np.random.Generator
) -> csr_array:
    """`seen_from` of some of the triangles, a ray in each cell of a square that is mapped to the half space."""
    count, rays = len(triangles), len(strata)
    u = (strata + random.random((count, rays, 2))) / (strata.max(axis=0) + 1)
    radius, phi = np.sqrt(u[..., 0]), 2 * np.pi * u[..., 1]
    normals = scene.normals[triangles]
    first = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    x, y, z = radius * np.cos(phi), radius * np.sin(phi), np.sqrt(1 - u[..., 0])
    ways = x[..., None] * first[:, None] + y[..., None] * second[:, None] + z[..., None] * normals[:, None]
    shares = random.dirichlet((1.0, 1.0, 1.0), (count, rays))
    places = np.einsum("nrc,nck->nrk", shares, scene.corners_mm[triangles]) + RAY_START_MM * normals[:, None]
    hits = scene.rays.run(
        np.ascontiguousarray(places.reshape(-1, 3), np.float32),
        np.ascontiguousarray(ways.reshape(-1, 3), np.float32),
        query="INTERSECT",
        output=1,
    )
    hit = np.asarray(hits["primID"], dtype=np.int64).reshape(count, rays)
    front = (hit >= 0) & (np.einsum("nrk,nrk->nr", ways, scene.normals[hit]) < 0)
    row, ray = np.nonzero(front)
    data = np.full(len(row), 1.0 / rays, np.float32)
    return csr_array((data, (row, scene.patch[hit[row, ray]])), shape=(count, scene.patches))


def points_of(scene: Scene) -> NDArray[np.int64]:
    """[points, patches] triangles that stand for each patch, any of it."""
    flat = scene.areas_mm2 < 1e-9 * scene.areas_mm2.max()  # has no normal
    order = np.lexsort((np.random.default_rng(3).random(len(scene.patch)), flat, scene.patch))
    first = np.searchsorted(scene.patch[order], np.arange(scene.patches))
    number = np.maximum(np.bincount(scene.patch[~flat], minlength=scene.patches), 1)
    return np.stack([order[first + point * number // _POINTS] for point in range(_POINTS)])


def direct_irradiance(scene: Scene, led_mm: Floats, led_normals: Floats, *, paper: bool) -> NDArray[np.float32]:
    """[patches, leds] E / Phi, m^-2, that reaches patches straight from LEDs: the mean of some of their
    triangles."""
    irradiance = np.zeros((scene.patches, len(led_mm)), np.float32)
    for at in points_of(scene):
        centres, normals = scene.centres_mm[at], scene.normals[at]
        cosine = _cosines(centres, normals, led_mm)
        light = lit_on(centres, led_mm, led_normals, paper) * np.maximum(cosine, 0.0)
        patch, led = np.nonzero(light > 0)
        starts = (centres + RAY_START_MM * normals)[patch]
        for part in range(0, len(patch), _RAYS):
            some = slice(part, part + _RAYS)
            light[patch[some], led[some]] *= ~blocked_segments(scene.rays, starts[some], led_mm[led[some]])
        irradiance += (light / _POINTS).astype(np.float32)
    return irradiance


def _cosines(centres_mm: Floats, normals: Floats, led_mm: Floats) -> Floats:
    """[n, leds] of incidence."""
    ways = led_mm[None] - centres_mm[:, None]
    cosines: Floats = np.einsum("nlk,nk->nl", ways, normals) / np.linalg.norm(ways, axis=2)
    return cosines


def radiosity(
    form_factors: csr_array, direct: NDArray[np.float32], apparent_reflectance: Floats, passes: int = _PASSES
) -> NDArray[np.float32]:
    """[channels, patches, leds] exitance of patches for a power of 1. `apparent_reflectance` [patches, channels]
    is the reflectance that counts all light as direct; patches that no LED reaches keep it."""
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
) -> None:
    """Take inter-reflection off the samples of views that still have it; each view's file is whole, before or
    after. Raises OSError."""
    missing = [view for view in result.views if view.inter_reflection is None]
    if not missing:
        return
    corners = result.corners_mm.astype(np.float64)
    pose = result.base_from_support
    support = (pose[:3, 3], pose[:3, 2]) if support_reflectance > 0 else None
    scene = scene_of(corners, support_z=support)
    patch_reflectance, diffuse = _as_measured(result, scene, len(corners), support_reflectance)
    say("inter-reflection", 1, 2 + len(missing))
    points = points_of(scene)
    form_factors = sum(seen_from(scene, at, seed) for seed, at in enumerate(points)) * (1.0 / len(points))
    say("inter-reflection", 2, 2 + len(missing))
    for number, view in enumerate(missing):
        _subtract_view(view, scene, form_factors, patch_reflectance, diffuse[view.path.stem], paper)
        say("inter-reflection", 3 + number, 2 + len(missing))


def _as_measured(
    result: RunResult, scene: Scene, count: int, support_reflectance: float
) -> tuple[Floats, dict[str, Floats]]:
    """Reflectance of patches and triangles, by `_apparent_reflectance` and `_diffuse`, before anything was taken
    off: kept in a file, by which a job that was stopped goes on."""
    path = result.folder / AS_MEASURED
    if not path.exists():
        diffuse = {view.path.stem: _diffuse(result, view) for view in result.views}
        patch_reflectance = _apparent_reflectance(result, diffuse, scene, count, support_reflectance)

        def write(part: Path) -> None:
            with h5py.File(part, "w") as file:
                file["shown"] = patch_reflectance
                for name, values in diffuse.items():
                    file[f"diffuse/{name}"] = values

        complete(path, write)
    with h5py.File(path, "r") as file:
        return file["shown"][()], {name: values[()] for name, values in file["diffuse"].items()}


def _apparent_reflectance(
    result: RunResult, diffuse: dict[str, Floats], scene: Scene, count: int, support_reflectance: float
) -> Floats:
    """[patches, channels] reflectance by the samples, the mean of a patch's triangles; of those that no view shows
    that of all; the support has its own."""
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
    """[n, channels] median of the samples of each triangle under some LEDs that do not graze, or under all where
    those reach it not."""
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
    """Fill those rows of `reflectances` [n, channels] that have NaN with medians of the samples."""
    cosine = _cosines(samples.centres_mm, samples.normals, samples.led_mm)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.where(cosine[..., None] > _LEAST_COSINE, samples.values / cosine[..., None], np.nan)
    missing = np.isnan(reflectances).any(axis=1) & np.all(np.isfinite(values).any(axis=1), axis=1)
    reflectances[missing] = np.nanmedian(values[missing], axis=1)


def _subtract_view(
    view: ViewSamples,
    scene: Scene,
    form_factors: csr_array,
    apparent_reflectance: Floats,
    diffuse: Floats,
    paper: bool,
) -> None:
    direct = direct_irradiance(scene, view.led_mm, view.led_normals, paper=paper)
    exitance = radiosity(form_factors, direct, apparent_reflectance)
    gathers = seen_from(scene, view.triangles, _POINTS)
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
                off = _off(view, scene, gathers[rows], exitance, diffuse[rows], rows, paper)
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
    """[n, leds, channels] what to take off f of triangles: their diffuse reflectance times indirect over
    direct."""
    triangles = view.triangles[rows]
    centres, normals = scene.centres_mm[triangles], scene.normals[triangles]
    arriving = lit_on(centres, view.led_mm, view.led_normals, paper) * _cosines(centres, normals, view.led_mm)
    indirect = np.stack([gathers @ channel_exitance for channel_exitance in exitance], axis=-1)
    is_lit = arriving > 0
    total = np.where(is_lit, arriving, 0.0).sum(axis=1)[:, None]
    of_direct = total / np.maximum(total + np.where(is_lit[..., None], indirect, 0.0).sum(axis=1), 1e-30)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = (np.nan_to_num(diffuse) * of_direct)[:, None] * indirect / arriving[..., None]
    return np.where(is_lit[..., None], off, 0.0).astype(np.float32)
