"""Forecast of texels of a size, before the work begins: their number and width, the memory and disk that they
need, and the time on this machine.

Rays through some pixels of each view give the number of pixels that see the object, and their width on it. The
time follows from small trials with the run's own frames and LEDs: reading, fitting, and the steps with neighbours.
"""

from __future__ import annotations

import math
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from coupole.errors import DiskFull, InputError
from coupole.kernels.lanes import LANES
from coupole.reflectance.extraction.extraction import MOST_BLUR_PX, Geometry, view_pass
from coupole.reflectance.extraction.frames_for_check import MOST_FRAMES
from coupole.reflectance.extraction.measured_run import MeasuredRun, MeasuredView
from coupole.reflectance.extraction.radiance import Radiometry
from coupole.reflectance.extraction.sample_codes import REACHED
from coupole.reflectance.extraction.sample_kernel import NO_VALUE
from coupole.reflectance.extraction.seen_surface import seen_surface
from coupole.reflectance.material_uncertainty import groups_of_leds
from coupole.reflectance.run_job import RunRequest, forget, prepare_run, read_runs, settings_of, view_file_name
from coupole.reflectance.texels.neighbours import settle
from coupole.reflectance.texels.pixel_file import FOLDER, refuse_other_size
from coupole.reflectance.texels.pixel_fit import Lights, Prior, fit_pixels
from coupole.reflectance.texels.pixel_values import LitPixels, fill_rows
from coupole.reflectance.texels.texel_size import TexelSize
from coupole.reflectance.texels.texel_values import texel_bytes

_TRACED = 200_000
"""Approximate number of pixels of a view through which rays are traced."""
_FITTED, _SIDE_PX = 2048, 192
"""Number of texels for the trial of fits, and width in pixels of the trial of the steps with neighbours."""
_ALL_OVER_SETTLE, _CHECK_OVER_FIT = 3.0, 17.0
"""Ratios of measured times: all steps with neighbours to the step in the trial; and a pixel under an LED of the
check, with uncertainties for every second LED, to a sample of a fit."""
_PLACE_BYTES, _PIXEL_BYTES, _SHOWN_BYTES, _BEFORE_BYTES = 650, 60, 900, 400_000_000
"""Measured memory, in bytes, of a texel's place in a view; of a pixel of the picture; of a pixel that sees the
object while pictures are compared; and of the program before the work."""
_HEAD_BYTES, _NUMBER_BYTES = 40_000, 0.1
"""Disk space, in bytes, of a file without texels, and of the number of a pixel's texel."""


@dataclass(frozen=True)
class ViewForecast:
    """One view's texels."""

    view: str
    leds: int
    picture_px: int
    """Number of pixels of its pictures."""
    pixels: int
    """Number of pixels that see the object."""
    pixel_mm: float
    """Median width of such a pixel on the surface."""
    side_px: int
    """Number of pixels across a texel."""

    @property
    def texels(self) -> int:
        return -(-self.pixels // self.side_px**2)

    @property
    def texel_mm(self) -> float:
        return self.side_px * self.pixel_mm


@dataclass(frozen=True)
class TexelForecast:
    """All texels that a job will make."""

    size: TexelSize
    views: tuple[ViewForecast, ...]
    edge_mm: float
    """Median edge of the triangles that are seen."""
    memory_bytes: int
    disk_bytes: int
    time_s: float

    @property
    def texels(self) -> int:
        return sum(view.texels for view in self.views)

    def document(self) -> dict[str, Any]:
        """Return the document for `--json`."""
        views = [{**asdict(view), "texels": view.texels, "texel_mm": view.texel_mm} for view in self.views]
        figures = ("edge_mm", "memory_bytes", "disk_bytes", "time_s")
        return {"texels": self.texels, **{name: getattr(self, name) for name in figures}, "views": views}


def foresee_texels(request: RunRequest, out: Path, size: TexelSize) -> TexelForecast | None:
    """Forecast the texels that a result folder lacks; None if it lacks none. The folder need not exist yet.

    Raises InputError for texels that are narrower than the pixels of the finest view, and for a folder with texels
    of another size. For runs that cannot be evaluated, raises as `reflectance_of`.
    """
    refuse_other_size(out, size)
    token = uuid4().hex
    try:
        measured_runs = read_runs(request, token)
        left_out = settings_of(request, token, measured_runs)["left_out"]
        views, edges_mm, trial = [], [], None
        for run in measured_runs:
            measured_run, geometry, radiometry = prepare_run(token, run.run.folder.resolve(), request.sources)
            for view in measured_run.views:
                name = view_file_name(measured_runs, run, view)
                forecast, triangles = _foresee_view(measured_run, geometry, view, name, size)
                views.append(forecast)
                edges_mm.append(_edges_mm(measured_run.corners_mm[triangles]))
                if not (out / FOLDER / f"{name}.h5").exists() and trial is None:
                    trial = (measured_run, geometry, radiometry, view), forecast
        _refuse_narrower(size, views)
        lacking = [view for view in views if not (out / FOLDER / f"{view.view}.h5").exists()]
        if trial is None:
            return None
        rates = _Rates.of(*trial[0], trial[1].pixels)
        time_s = sum(rates.time_s(view, left_out, request.memory_bytes) for view in lacking)
        leds = min(len(left_out), MOST_FRAMES)
        time_s += sum(rates.check_s(view, leds) for view in views)
        memory = _BEFORE_BYTES + max(_memory_bytes(view, rates.channels, request.memory_bytes) for view in views)
        disk = sum(_disk_bytes(view, rates.channels) for view in lacking)
        edge_mm = float(np.median(np.concatenate(edges_mm)))
        return TexelForecast(size, tuple(lacking), edge_mm, memory, disk, time_s)
    finally:
        forget()


def refuse_full_disk(forecast: TexelForecast, out: Path) -> None:
    """Raise DiskFull for texels that the disk of a result folder, which need not exist yet, cannot hold."""
    folder = next(path for path in (out.resolve(), *out.resolve().parents) if path.exists())
    free_bytes = shutil.disk_usage(folder).free
    if forecast.disk_bytes > free_bytes:
        raise DiskFull(
            f"{out}: texels need about {forecast.disk_bytes / 1e9:.2f} GB, and "
            f"{free_bytes / 1e9:.2f} GB are free. "
            "Free space, name another --out, or make larger texels (--texels MM)"
        )


def _refuse_narrower(size: TexelSize, views: list[ViewForecast]) -> None:
    finest = min(views, key=lambda view: view.pixel_mm)
    if size.mm is not None and size.mm < 0.99 * finest.pixel_mm:
        digits = 1 - math.floor(math.log10(finest.pixel_mm))
        least_mm = math.ceil(finest.pixel_mm * 10**digits) / 10**digits
        raise InputError(
            f"--texels {size.text}: is finer than the frames; a pixel of the finest view, {finest.view}, sees "
            f"{finest.pixel_mm:.2g} mm of the surface. Expected {least_mm:g} or more, or auto for single pixels"
        )


def _foresee_view(
    measured_run: MeasuredRun, geometry: Geometry, view: MeasuredView, name: str, size: TexelSize
) -> tuple[ViewForecast, NDArray[np.int64]]:
    """Return a view's texels, and the triangles that it sees, from rays at every few pixels."""
    width, height = measured_run.frames.size_px
    step, lens = max(1, math.isqrt(width * height // _TRACED)), measured_run.lens
    coarse = replace(
        lens, fx=lens.fx / step, fy=lens.fy / step, cx=(lens.cx - (step - 1) / 2) / step,
        cy=(lens.cy - (step - 1) / 2) / step,
    )  # fmt: skip
    surface = seen_surface(
        geometry.mesh, geometry.facets.normals, coarse, view.base_from_camera, (width // step, height // step),
        blur=(*measured_run.optics, MOST_BLUR_PX / step), threads=len(os.sched_getaffinity(0)),
    )  # fmt: skip
    if not len(surface.triangles):
        raise InputError(f"{measured_run.run.folder}: no pixel of the view {view.name} shows the mesh")
    facets, eye = geometry.of(surface.triangles), view.base_from_camera
    ways = facets.centres_mm - eye[:3, 3]
    depth_mm, distance_mm = ways @ eye[:3, 2], np.linalg.norm(ways, axis=1)
    cosine = np.abs(np.einsum("nk,nk->n", ways, facets.normals)) / distance_mm
    areas_mm2 = depth_mm**3 / distance_mm / np.maximum(cosine, 1e-3) / (lens.fx * lens.fy)
    pixel_mm = math.sqrt(float(np.median(areas_mm2[surface.places[surface.places >= 0]])))
    pixels = surface.pixels * step**2
    forecast = ViewForecast(name, len(view.by_led), width * height, pixels, pixel_mm, size.side_px(pixel_mm))
    return forecast, surface.triangles


def _edges_mm(corners_mm: NDArray[np.floating]) -> NDArray[np.float64]:
    edges: NDArray[np.float64] = np.linalg.norm(corners_mm - np.roll(corners_mm, 1, axis=1), axis=2).ravel()
    return edges


def _memory_bytes(view: ViewForecast, channels: int, budget_bytes: int) -> int:
    """Return the peak memory of a view: while its pixels are read and fitted, or while its pictures are
    compared."""
    places, values = view.picture_px / view.side_px**2, 2 * view.leds * view.pixels
    if view.side_px > 1:
        values = texel_bytes(channels, view.leds, view.side_px) * view.texels
    frames = 2 * view.picture_px * (LANES + 2)
    fitting = min(values, budget_bytes) + _PLACE_BYTES * places + _PIXEL_BYTES * view.picture_px + frames
    return int(max(fitting, _SHOWN_BYTES * view.pixels + _PIXEL_BYTES * view.picture_px))


def _disk_bytes(view: ViewForecast, channels: int) -> int:
    of_texel = 4 * (1 + 3 + 2 * channels + 1 + 15)
    numbers = _NUMBER_BYTES * view.picture_px if view.side_px > 1 else 0
    return int(of_texel * view.texels + numbers + _HEAD_BYTES)


@dataclass(frozen=True)
class _Rates:
    """Rates of this machine."""

    channels: int
    pixel_s: float
    """Time to read a pixel that sees the object, under one LED, and to convert it to a value."""
    sample_s: float
    """Time of a value in a fit."""
    place_s: float
    """Time for a place of a view's texels, seen or not, in all steps with neighbours."""

    def time_s(self, view: ViewForecast, left_out: list[int], budget_bytes: int) -> float:
        """Return the time of a view's texels."""
        of_texel, texels = 2 * view.leds, view.pixels
        if view.side_px > 1:
            of_texel, texels = texel_bytes(self.channels, view.leds, view.side_px), view.texels
        parts = max(1, math.ceil(of_texel * texels / budget_bytes))
        # each part reads all frames; of the pixels it fills its own
        reading = self.pixel_s * view.pixels * view.leds * (1.0 + 0.5 * (parts - 1))
        fitting = self.sample_s * texels * max(view.leds - len(left_out), 1)
        return reading + fitting + self.place_s * view.picture_px / view.side_px**2

    def check_s(self, view: ViewForecast, leds: int) -> float:
        """Return the time of a view's pictures for the check."""
        return _CHECK_OVER_FIT * self.sample_s * view.pixels * leds

    @staticmethod
    def of(
        measured_run: MeasuredRun, geometry: Geometry, radiometry: Radiometry, view: MeasuredView, pixels: int
    ) -> _Rates:
        threads = len(os.sched_getaffinity(0))
        led_mm = measured_run.leds.of(np.array(list(view.by_led), np.int64))[0]
        batch_s, leds = _batch_s(measured_run, geometry, radiometry, view, threads)
        middle_mm = measured_run.corners_mm.mean(axis=(0, 1))
        sample_s = _fit_s(led_mm, view.base_from_camera[:3, 3], middle_mm, threads)
        return _Rates(radiometry.channels, batch_s / (leds * max(pixels, 1)), sample_s, _place_s())


def _batch_s(
    measured_run: MeasuredRun, geometry: Geometry, radiometry: Radiometry, view: MeasuredView, threads: int
) -> tuple[float, int]:
    """Measure the time to read the frames of some LEDs and convert them to values of a view's pixels; return it
    with the number of these LEDs. The second call is timed, because the first one compiles."""
    work, surface = view_pass(measured_run, geometry, radiometry, view, threads)
    rows, channels = slice(0, len(surface.triangles)), radiometry.channels
    places_mm = work.facets.centres_mm[surface.places.reshape(-1)[work.reader.lists.places]].astype(np.float32)
    values = np.full((len(places_mm), LANES), NO_VALUE, np.uint16)
    codes = np.full((rows.stop, LANES), REACHED, np.uint8)
    batches, taken_s, leds = work.batches(), 0.0, 1
    with closing(batches), ThreadPoolExecutor(threads) as pool:
        for part, _ in zip(work.parts, range(2), strict=False):
            begun_s, leds = time.perf_counter(), part.stop - part.start
            batch, light = next(batches), (codes, np.ones((rows.stop, leds, channels), np.float32))
            lit_pixels = LitPixels(rows, places_mm, light, values[:, :leds])
            fill_rows(pool, work.reader, work.reader.response, batch, lit_pixels, np.float32(1.0))
            taken_s = time.perf_counter() - begun_s
    return taken_s, leds


def _fit_s(
    led_mm: NDArray[np.float64], camera_mm: NDArray[np.float64], middle_mm: NDArray[np.float64], threads: int
) -> float:
    """Measure the time of a value in fits of texels that face the camera, with noise of one hundredth."""
    group = groups_of_leds(led_mm, middle_mm)
    order = np.argsort(group, kind="stable")
    lights = Lights(order, led_mm[order], group[order], camera_mm)
    normal = (camera_mm - middle_mm) / np.linalg.norm(camera_mm - middle_mm)
    ways = led_mm - middle_mm
    cosines = np.maximum(ways @ normal / np.linalg.norm(ways, axis=1), 0.0)
    noise = 1.0 + 0.01 * np.random.default_rng(0).standard_normal((_FITTED, len(led_mm)))
    values = (0.1 * cosines * noise).astype(np.float16)
    places_mm = np.broadcast_to(middle_mm, (_FITTED, 3)).astype(np.float32)
    kd, ks, alpha = (np.full(_FITTED, value) for value in (0.08, 0.02, 0.3))
    prior = Prior(np.ascontiguousarray(np.broadcast_to(normal, (_FITTED, 3))), kd, ks, alpha)
    fit_pixels(values[:1], places_mm[:1], lights, Prior(prior.normals[:1], kd[:1], ks[:1], alpha[:1]), 1)
    begun_s = time.perf_counter()
    fit_pixels(values, places_mm, lights, prior, threads)
    return (time.perf_counter() - begun_s) / (_FITTED * len(led_mm))


def _place_s() -> float:
    """Measure the time of a place of a view's texels in the step with neighbours."""
    shape = (_SIDE_PX, _SIDE_PX)
    for _ in range(2):  # the first time compiles
        deviation, covariance = np.zeros((*shape, 5), np.float32), np.full((*shape, 15), 1e-3, np.float32)
        covariance[..., [0, 2, 5, 9, 14]] = 1.0
        begun_s = time.perf_counter()
        settle(deviation, covariance, np.ones(shape, np.bool_), np.zeros_like(covariance))
        taken_s = time.perf_counter() - begun_s
    return _ALL_OVER_SETTLE * taken_s / (_SIDE_PX * _SIDE_PX)
