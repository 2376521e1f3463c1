"""Draws normals and materials, with their uncertainty, while a run goes on.

A view whose samples have just been taken gets a first look: a quick fit to some of its triangles and LEDs. While
its frames arrive, it gets earlier looks, from some of the frames that are there. First looks are not part of the
result. They use one view alone, and its samples still contain light that was reflected by other surfaces. When the
result of the views so far is complete, its maps replace the first looks.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from coupole.pages.page_parts import Map
from coupole.reflectance.beside.early_samples import extract_early
from coupole.reflectance.block_work import Said
from coupole.reflectance.fits import GGX_NORMAL
from coupole.reflectance.result_folder import read_settings
from coupole.reflectance.result_pages.material_maps import MapValues, MaterialMaps, material_maps
from coupole.reflectance.run_result import VARIANCES, RunResult, ViewSamples, read_view_samples
from coupole.reflectance.triangle_fit import TriangleMaterials
from coupole.storage.growing_pictures import GrowingPictures, PictureShown, ViewPictures, new_picture_name
from coupole.storage.line_file import utc_now
from coupole.storage.processing import FOLDER

_MOST_TRIANGLES, _MOST_LEDS, _MOST_WIDTH_PX = 5000, 64, 480
_SCAN_NOISE_UM = 30.0


@dataclass(frozen=True)
class Drawing:
    """Draws into the folder of one result."""

    result: Path
    growing: GrowingPictures
    views: int
    """Views of the plan."""

    def early_look(self, run: Path, view: str, say: Said) -> None:
        """Draw a view while its frames arrive, from samples that are taken for this and then removed. An error
        that `say` raises ends it. Raises as `reflectance_of`."""
        try:
            arrived_frames = extract_early(run, view, self._early_samples, _MOST_LEDS, say)
            if arrived_frames:
                self.first_look(view, self._early_samples, arrived_frames)
        finally:
            self.forget_early_look()

    @property
    def _early_samples(self) -> Path:
        return self.result / FOLDER / "early"

    def forget_early_look(self) -> None:
        """Remove the samples of an early look, also those that a killed process has left."""
        shutil.rmtree(self._early_samples, ignore_errors=True)

    def first_look(self, view: str, folder: Path | None = None, arrived_frames: int = 0) -> None:
        """Draw a view by a quick fit to some of its samples, which are in the result's folder or in another one.
        Raises OSError."""
        folder = folder or self.result
        samples_of_view = read_view_samples(folder / "samples" / f"{view}.h5")
        rows = slice(0, None, -(-len(samples_of_view.triangles) // _MOST_TRIANGLES))
        led_mask = np.zeros(len(samples_of_view.leds), np.bool_)
        led_mask[:: -(-len(led_mask) // _MOST_LEDS)] = True
        result = RunResult(folder)
        samples = result.view_samples(samples_of_view, rows, led_mask)
        all_of_them = np.ones(np.count_nonzero(led_mask), np.bool_)
        materials = GGX_NORMAL.fit(samples, all_of_them, _SCAN_NOISE_UM, None)
        middle_mm = samples.centres_mm.mean(axis=0)
        uncertainty = GGX_NORMAL.uncertainty(samples, all_of_them, materials, _SCAN_NOISE_UM, middle_mm, None)
        uncertain = np.sqrt(np.diagonal(uncertainty.covariance, axis1=1, axis2=2))
        with h5py.File(samples_of_view.path, "r") as file:
            pixel_rows, centres_mm = file["seen"][()], file["centres_mm"][()]
        pixel_rows = _crop(pixel_rows)
        nearest = np.append(cKDTree(samples.centres_mm).query(centres_mm)[1], -1)  # the last: a pixel sees nothing
        rows_seen = nearest[np.where(pixel_rows >= 0, pixel_rows, -1)]
        values = _map_values(rows_seen, materials, uncertain, result.base_from_support)
        view_pictures = ViewPictures(
            view=view,
            kind="first-look",
            fitted_views=1,
            views=self.views,
            frames=len(all_of_them),
            arrived_frames=arrived_frames,
            triangles=int(np.count_nonzero(np.isfinite(materials.alpha))),
            t=utc_now(),
            pictures=(),
        )
        self._put_maps(view_pictures, material_maps(values, has_own_scales=True))

    def so_far(self, folder: Path, is_wanted: Callable[[], bool]) -> None:
        """Draw the views of a result of the views so far, the newest first, while `is_wanted` says so. Raises
        OSError."""
        result, left_out = RunResult(folder), read_settings(folder)["left_out"]
        materials = result.materials(GGX_NORMAL.name)
        with h5py.File(result.materials_path(GGX_NORMAL.name), "r") as file:
            uncertain = np.sqrt(file["covariance"][()][:, VARIANCES])
        newest_first = sorted(result.views, key=self._taken_ns, reverse=True)
        frames = sum(int(np.count_nonzero(~np.isin(view.leds, left_out))) for view in result.views)
        for view in newest_first:
            if not is_wanted():
                return
            rows = np.searchsorted(result.triangles, view.triangles)
            of_view = materials.at(rows)
            with h5py.File(view.path, "r") as file:
                pixel_rows = _crop(file["seen"][()])
            values = _map_values(pixel_rows, of_view, uncertain[rows], result.base_from_support)
            view_pictures = ViewPictures(
                view=view.path.stem,
                kind="so-far",
                fitted_views=len(result.views),
                views=self.views,
                frames=frames,
                triangles=int(np.count_nonzero(np.isfinite(of_view.alpha))),
                t=utc_now(),
                pictures=(),
            )
            self._put_maps(view_pictures, material_maps(values, has_own_scales=True))

    def _taken_ns(self, view: ViewSamples) -> int:
        """Return when the samples of a view were taken."""
        return (self.result / "samples" / view.path.name).stat().st_mtime_ns

    def _put_maps(self, view_pictures: ViewPictures, maps: MaterialMaps) -> None:
        titled_maps = [
            ("normals", "Normals", maps.normals),
            ("u-normals", "Uncertainty of normals", maps.u_normals),
            ("kd", "Base colour (kd)", maps.kd),
            ("u-kd", "Uncertainty of base colour", maps.u_kd),
            *zip(
                ("ks", "u-ks", "alpha", "u-alpha"),
                ("Specular (ks)", "Uncertainty of specular", "Roughness (alpha)", "Uncertainty of roughness"),
                maps.lobe,
                strict=False,
            ),
        ]  # fmt: skip
        files = {kind: new_picture_name(kind) for kind, _, _ in titled_maps}
        pictures = tuple(
            _picture_shown(files[kind], title, of_map, maps.medians.get(of_map.title))
            for kind, title, of_map in titled_maps
        )
        self.growing.put_view(
            view_pictures.model_copy(update={"pictures": pictures, "remark": maps.lobe_words}),
            {files[kind]: of_map.png for kind, _, of_map in titled_maps},
        )


def _map_values(
    pixel_rows: NDArray[np.int32],
    materials: TriangleMaterials,
    uncertain: NDArray[np.float64],
    base_from_support: NDArray[np.float64],
) -> MapValues:
    """Return what is drawn, with normals in the frame of the support, whose z is up."""
    normals = materials.normals @ base_from_support[:3, :3]
    return MapValues(pixel_rows, normals, materials.kd, materials.ks, materials.alpha, uncertain)


def _crop(pixel_rows: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the part [h, w] of a view that sees the object, with a margin, at most `_MOST_WIDTH_PX` wide."""
    rows, columns = (np.flatnonzero((pixel_rows >= 0).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return pixel_rows[:1, :1]
    margin_px = 1 + max(int(np.ptp(rows)), int(np.ptp(columns))) // 40
    part = pixel_rows[
        max(0, rows[0] - margin_px) : rows[-1] + margin_px + 1,
        max(0, columns[0] - margin_px) : columns[-1] + margin_px + 1,
    ]
    step = -(-part.shape[1] // _MOST_WIDTH_PX)
    return part[::step, ::step]


def _picture_shown(file: str, title: str, of_map: Map, median: float | None) -> PictureShown:
    with Image.open(BytesIO(of_map.png)) as image:
        width_px, height_px = image.size
    return PictureShown(
        file=file,
        title=title,
        width_px=width_px,
        height_px=height_px,
        unit=of_map.unit,
        low=of_map.low,
        high=of_map.high,
        palette=of_map.palette,
        names=tuple(of_map.names),
        gamma=of_map.gamma,
        is_cut=of_map.is_cut,
        median=median,
    )
