"""Light from one part of the object to another: it is estimated from the mesh and the samples, and subtracted from
the samples.

A sample of reflectance counts all light of its triangle as direct light of the LED. In a fold, other triangles
reflect a part of this light. The object is cut into patches. Their radiosity under each LED follows from the light
that reaches them, the diffuse reflectance of their samples, and their form factors (Goral et al. 1984). Rays from
each triangle then gather the arriving light. Samples in folds are too high. So the reflectance is lowered by the
estimated light, and the radiosity is computed again, until it settles. All intermediate reflection is taken as
diffuse.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from coupole.reflectance.discarded_frames import rewrite
from coupole.reflectance.extraction.frame_veils import GLARE
from coupole.reflectance.extraction.lamp_sight import lit_on
from coupole.reflectance.light_paths import NOTHING_AHEAD, Ahead, PathsOfLight, Scene, cosines_on, paths_of
from coupole.reflectance.parts_in_threads import in_threads
from coupole.reflectance.result_folder import complete
from coupole.reflectance.run_result import AS_MEASURED, INTER_REFLECTION, SAMPLES, RunResult, ViewSamples
from coupole.reflectance.triangle_fit import TriangleSamples
from coupole.storage.hdf5_file import hdf5_file

Floats = NDArray[np.float64]
Said = Callable[[str, int, int], None]

_PASSES = 3
_MOST_BOUNCES = 8
_LEAST_COSINE = 0.2
"""Least cosine of incidence in the samples from which a triangle's diffuse reflectance is estimated."""
_MOST_REFLECTED = 0.95
MOST_SHARE = 0.5
"""Largest share of a sample that may be inter-reflection; samples with a larger share are left out."""
_ROWS, _MEDIAN_ROWS, _PART = 4096, 8192, 256
"""The first two are numbers of triangles that are read together: for the subtraction, and for medians. The third
is the number of triangles that a thread works on at a time."""


def radiosity(
    form_factors: csr_array, direct: NDArray[np.float32], apparent_reflectance: Floats, passes: int = _PASSES
) -> NDArray[np.float32]:
    """[channels, patches, leds] exitance of patches under LEDs with a power of 1. `apparent_reflectance` [patches,
    channels] is the reflectance if all light counts as direct; patches that no LED reaches keep it."""

    def of_channel(channel_reflectance: Floats) -> NDArray[np.float32]:
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
        return exitance

    with ThreadPoolExecutor() as pool:
        return np.stack(list(pool.map(of_channel, apparent_reflectance.T)))


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
    paths = paths_of(
        result.corners_mm,
        result.base_from_support,
        support_reflects=support_reflectance > 0,
        paper=paper,
        triangles_of_views=sum(len(view.triangles) for view in result.views),
        ahead=ahead,
    )
    patch_reflectance, diffuse = _as_measured(result, paths, len(result.corners_mm), support_reflectance)
    say("inter-reflection", 1, 2 + len(missing))
    form_factors = paths.form_factors()
    say("inter-reflection", 2, 2 + len(missing))
    of_leds = _ExitanceOfLeds(paths, form_factors, patch_reflectance)
    for number, view in enumerate(missing):
        _subtract_view(view, paths, of_leds.exitance(view), patch_reflectance, diffuse[view.path.stem], say)
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
            with hdf5_file(part, "w") as file:
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
    for first in range(0, len(medians), _MEDIAN_ROWS):
        rows = slice(first, min(first + _MEDIAN_ROWS, len(medians)))
        for columns in (some_leds, ~some_leds):
            if np.isnan(medians[rows]).any():
                _fill_medians(medians[rows], result.view_samples(view, rows, columns))
    return medians


def _fill_medians(reflectances: Floats, samples: TriangleSamples) -> None:
    """Fill the rows of `reflectances` [n, channels] that have NaN with medians of the samples."""

    def fill(first: int) -> None:
        part = slice(first, first + _PART)
        cosine = cosines_on(samples.centres_mm[part], samples.normals[part], samples.led_mm)
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.where(cosine[..., None] > _LEAST_COSINE, samples.values[part] / cosine[..., None], np.nan)
        missing = np.isnan(reflectances[part]).any(axis=1) & np.all(np.isfinite(values).any(axis=1), axis=1)
        reflectances[part][missing] = np.nanmedian(values[missing], axis=1)

    in_threads(fill, len(reflectances), part=_PART)


class _ExitanceOfLeds:
    """Exitance of patches under the LEDs of a view. Views under the same LEDs, one after the other, share it,
    because it does not depend on the camera."""

    def __init__(self, paths: PathsOfLight, form_factors: csr_array, apparent_reflectance: Floats) -> None:
        self._paths, self._form_factors = paths, form_factors
        self._apparent_reflectance = apparent_reflectance
        self._leds: tuple[bytes, bytes] | None = None
        self._exitance = np.empty((0, 0, 0), np.float32)

    def exitance(self, view: ViewSamples) -> NDArray[np.float32]:
        """[channels, patches, leds] exitance of the patches under the LEDs of a view, by `radiosity`."""
        leds = (view.led_mm.tobytes(), view.led_normals.tobytes())
        if leds != self._leds:
            direct = self._paths.direct(view.led_mm, view.led_normals)
            self._exitance = radiosity(self._form_factors, direct, self._apparent_reflectance)
            self._leds = leds
        return self._exitance


def _subtract_view(
    view: ViewSamples,
    paths: PathsOfLight,
    exitance: NDArray[np.float32],
    apparent_reflectance: Floats,
    diffuse: Floats,
    say: Said,
) -> None:
    gathers = paths.gathers(view.triangles)
    of_patches = apparent_reflectance[paths.scene.patch[view.triangles]] / np.pi
    diffuse = np.where(np.isfinite(diffuse), diffuse, of_patches)
    indirect = _Indirect(view, paths.scene, gathers, exitance, diffuse, paths.paper)

    def write(part: Path) -> None:
        shutil.copyfile(view.path, part)
        shares, sample_count = [], 0
        with hdf5_file(part, "r+") as file:
            description = "share of f that was inter-reflection, and was subtracted"
            share_dataset = file.create_dataset(
                INTER_REFLECTION, file["f"].shape, np.float16, chunks=file["f"].chunks, fillvalue=np.nan
            )
            share_dataset.attrs["told"] = description
            for first in range(0, len(view.triangles), _ROWS):
                rows = slice(first, min(first + _ROWS, len(view.triangles)))
                values = {name: file[name][rows] for name in ("f", "u_own", GLARE) if name in file}
                share, new_values = _lowered(indirect, rows, values)
                some = share[:: 1 + len(share) // 512]
                shares.append(some[np.isfinite(some)])
                for name, of_rows in new_values.items():
                    file[name][rows] = of_rows
                share_dataset[rows] = share.astype(np.float16)
                file.raise_error()
                sample_count += int(np.count_nonzero(np.isfinite(share)))
                say(f"inter-reflection of {view.view}", rows.stop, len(view.triangles))
            every = np.concatenate(shares)
            file.attrs[SAMPLES] = sample_count
            file.attrs[INTER_REFLECTION] = np.quantile(every, [0.5, 0.95]) if len(every) else [0.0, 0.0]

    rewrite(view.path, write)


@dataclass(frozen=True)
class _Indirect:
    """Light that reaches the triangles of a view from other parts of the object."""

    view: ViewSamples
    scene: Scene
    gathers: csr_array
    """[n, patches], by `PathsOfLight.gathers`."""
    exitance: NDArray[np.float32]
    """[channels, patches, leds], by `radiosity`."""
    diffuse: Floats
    """[n, channels] diffuse reflectance of the triangles."""
    paper: bool

    def off(self, rows: slice) -> NDArray[np.float32]:
        """[rows, leds, channels] amount to subtract from f of triangles: their diffuse reflectance times the ratio
        of indirect to direct light."""
        view, triangles, gathers = self.view, self.view.triangles[rows], self.gathers[rows]
        centres, normals = self.scene.centres_mm[triangles], self.scene.normals[triangles]
        lit = lit_on(centres, view.led_mm, view.led_normals, self.paper)
        arriving = lit * cosines_on(centres, normals, view.led_mm)
        indirect = np.stack([gathers @ channel_exitance for channel_exitance in self.exitance], axis=-1)
        is_lit = arriving > 0
        total = np.where(is_lit, arriving, 0.0).sum(axis=1)[:, None]
        of_direct = total / np.maximum(total + np.where(is_lit[..., None], indirect, 0.0).sum(axis=1), 1e-30)
        with np.errstate(divide="ignore", invalid="ignore"):
            off = (np.nan_to_num(self.diffuse[rows]) * of_direct)[:, None] * indirect / arriving[..., None]
        return np.where(is_lit[..., None], off, 0.0).astype(np.float32)


def _lowered(
    indirect: _Indirect, rows: slice, values: dict[str, NDArray[np.float16]]
) -> tuple[NDArray[np.float32], dict[str, NDArray[np.float32]]]:
    """Return the share [rows, leds, channels] of f that is subtracted from rows of a view, NaN where no sample
    remains; and the new `values`. Values of uncertainty are relative, so they grow. Small parts of the rows are
    worked on in threads: this takes less memory, and no value depends on other rows."""
    share = np.empty(values["f"].shape, np.float32)
    new_values = {name: np.empty_like(share) for name in values}

    def lower(first: int) -> None:
        part = slice(first, min(first + _PART, len(share)))
        part_share = indirect.off(slice(rows.start + part.start, rows.start + part.stop)) / values["f"][part]
        part_share[~(part_share < MOST_SHARE)] = np.nan
        share[part], kept = part_share, 1 - part_share
        for name, new in new_values.items():
            new[part] = values[name][part] * kept if name == "f" else values[name][part] / kept

    in_threads(lower, len(share), part=_PART)
    return share, new_values
