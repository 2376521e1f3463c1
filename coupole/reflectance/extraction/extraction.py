"""Samples of reflectance of every triangle under every LED, written to disk view by view, in one pass over the
frames."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.errors import InputError
from coupole.geometry import apply
from coupole.motion import occlusion
from coupole.motion.packet_rays import PacketMesh
from coupole.motion.remembered import Remembered
from coupole.reflectance.extraction.frame_veils import GLARE, U_GLARE
from coupole.reflectance.extraction.lamp_sight import CodesAhead, Facets, lamp_codes, neighbours_of
from coupole.reflectance.extraction.measured_run import MeasuredRun, MeasuredView
from coupole.reflectance.extraction.radiance import Radiometry, SignalReader
from coupole.reflectance.extraction.sample_codes import BY_CELL, CODES, REACHED
from coupole.reflectance.extraction.seen_surface import SeenSurface, seen_surface
from coupole.reflectance.extraction.view_samples import BLOCK, Samples, ViewPass
from coupole.reflectance.result_folder import complete
from coupole.storage.array_digest import ArrayDigest
from coupole.storage.hdf5_file import hdf5_file

Floats = NDArray[np.float64]

_PATCHES_BESIDE = 9
"""Number of neighbouring patches that are examined, the patch itself included."""
MOST_BLUR_PX = 2.0
"""Largest diameter of the circle of confusion of a pixel that is used, px."""
Say = Callable[[str, int, int], None]
_newest_surface: Remembered[SeenSurface] = Remembered(1)
_newest_codes = CodesAhead()
_LEDS_AHEAD = 16
"""Number of LEDs whose codes are found before the function asks again whether the work is still wanted."""


@dataclass(frozen=True)
class Geometry:
    """The object's triangles, shared by all views."""

    mesh: PacketMesh
    facets: Facets

    def of(self, triangles: NDArray[np.int64]) -> Facets:
        """Return the facets of the triangles that a view sees, given by their numbers in rising order."""
        place = np.full(len(self.facets.centres_mm), -1)
        place[triangles] = np.arange(len(triangles))
        sides = self.facets.neighbours[triangles]
        sides = np.where(sides >= 0, place[sides], -1)
        return Facets(self.facets.centres_mm[triangles], self.facets.normals[triangles], sides)


def geometry_of(measured_run: MeasuredRun) -> Geometry:
    corners = measured_run.corners_mm
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return Geometry(
        PacketMesh(corners), Facets(corners.mean(axis=1), normals, neighbours_of(measured_run.triangles))
    )


def extract_view(
    measured_run: MeasuredRun,
    geometry: Geometry,
    radiometry: Radiometry,
    view: MeasuredView,
    path: Path,
    say: Say,
    *,
    threads: int | None = None,
) -> tuple[dict[str, Any], str]:
    """Write a view's samples to an HDF5 file, complete or not at all. Return the report's entry about them, and
    the digest of the written arrays (`coupole.storage.array_digest`)."""
    threads = threads or len(os.sched_getaffinity(0))
    work, surface = view_pass(measured_run, geometry, radiometry, view, threads)
    codes_of = shadows_of(work, geometry)
    sample_count, of_code, digest = 0, np.zeros(len(CODES), np.int64), ArrayDigest()

    def write(part: Path) -> None:
        nonlocal sample_count
        with hdf5_file(part, "w") as file:
            _write_head(file, work, surface, digest)
            file.attrs["view"] = path.stem
            data = _begin_samples(file, work)
            frame_count = 0
            for some in work.samples(codes_of, threads):
                for name, values in (
                    ("codes", some.codes),
                    ("f", some.f),
                    ("u_own", some.u_own),
                    (GLARE, some.glare),
                ):
                    if name in data:
                        _write_chunk(data[name], some, values)
                        digest.add(name, values, (some.rows.start, some.leds.start, 0)[: values.ndim])
                file.raise_error()
                sample_count += int(np.count_nonzero(np.isfinite(some.f)))
                of_code[:] += np.bincount(some.codes.ravel(), minlength=len(CODES))
                if some.rows.stop == len(surface.triangles):
                    frame_count += sum(len(view.by_led[int(led)]) for led in work.leds[some.leds])
                    say(f"samples of {view.name}", frame_count, len(view.frames))
            if work.reader.u_glare:
                u_glare = np.stack([work.reader.u_glare[int(led)] for led in work.leds])
                described = "relative standard uncertainty of the glare in an LED's frames"
                _dataset(file, U_GLARE, u_glare, described, digest)
            digest.add_attributes(file)

    complete(path, write, unless=path.with_suffix(".json"))
    summary = {
        "view": path.stem,
        "pixels": surface.pixels,
        "triangles": len(surface.triangles),
        "leds": len(work.leds),
        "samples": sample_count,
        "share_by_code": {name: float(of_code[code] / of_code.sum()) for name, code in CODES.items()},
    }
    return summary, digest.sha256


def view_pass(
    measured_run: MeasuredRun, geometry: Geometry, radiometry: Radiometry, view: MeasuredView, threads: int
) -> tuple[ViewPass, SeenSurface]:
    """Return the pass of a view, ready for its frames, and the surface that the view sees. Raises InputError if
    the view sees nothing of the mesh."""
    surface = surface_of(measured_run, geometry, view, threads)
    if not len(surface.triangles):
        raise InputError(
            f"{measured_run.run.folder}: no pixel of the view {view.name} shows the mesh: do mesh and hand-eye "
            "belong to this run, and is the object in focus?"
        )
    reader = SignalReader(radiometry, surface)
    return ViewPass(measured_run, view, geometry.of(surface.triangles), reader), surface


def surface_of(measured_run: MeasuredRun, geometry: Geometry, view: MeasuredView, threads: int) -> SeenSurface:
    """Return the surface that a view sees. It depends on the pose alone, so it can be computed before the view's
    frames are complete; the newest surface is remembered."""
    focal_mm, focus_mm, f_number = measured_run.optics
    size_px = measured_run.frames.size_px

    def compute() -> SeenSurface:
        return seen_surface(
            geometry.mesh,
            geometry.facets.normals,
            measured_run.lens,
            view.base_from_camera,
            size_px,
            blur=(focal_mm, focus_mm, f_number, MOST_BLUR_PX),
            threads=threads,
        )

    return _newest_surface.result((_sight_of(measured_run, view),), compute)


def _sight_of(measured_run: MeasuredRun, view: MeasuredView) -> str:
    """Return a key of the surface that a view sees, made of all data that determine it."""
    sight = hashlib.sha256(measured_run.corners_mm.tobytes())
    sight.update(repr((measured_run.lens, measured_run.frames.size_px, measured_run.optics)).encode())
    sight.update(view.base_from_camera.tobytes())
    return sight.hexdigest()


def find_codes_ahead(
    measured_run: MeasuredRun,
    geometry: Geometry,
    view: MeasuredView,
    leds: NDArray[np.int64],
    is_wanted: Callable[[], bool],
) -> None:
    """Find where the object hides LEDs from the surface that a view sees, for `extract_view`. No frame of these
    LEDs is needed. It ends when `is_wanted` says so; the codes that were found are kept.
    """
    threads = len(os.sched_getaffinity(0))
    facets = geometry.of(surface_of(measured_run, geometry, view, threads).triangles)
    _newest_codes.begin(_sight_of(measured_run, view))
    with ThreadPoolExecutor(threads) as pool:
        for first in range(0, len(leds) if len(facets.centres_mm) else 0, _LEDS_AHEAD):
            positions = measured_run.leds.only(leds[first : first + _LEDS_AHEAD])
            if not is_wanted():
                break
            if not _newest_codes.keep(positions, lamp_codes(geometry.mesh, facets, positions, pool)):
                break


def forget_codes() -> None:
    """Free the memory of the codes that `find_codes_ahead` has found, when the samples of their view are
    complete."""
    _newest_codes.begin("")


def shadows_of(work: ViewPass, geometry: Geometry) -> Callable[[slice, Executor], NDArray[np.uint8]]:
    """Return a function that gives the codes [leds, triangles] of some of the view's LEDs: they say what object
    and cell hide. Codes that `find_codes_ahead` has found are used."""
    hidden_by_cell = _hidden_by_cell(work)
    sight = _sight_of(work.measured_run, work.view)

    def codes_of(part: slice, pool: Executor) -> NDArray[np.uint8]:
        leds = work.leds[part]
        positions = work.measured_run.leds.only(leds)
        codes = _newest_codes.codes(sight, positions)
        if codes is None:
            codes = lamp_codes(geometry.mesh, work.facets, positions, pool)
        if hidden_by_cell is not None:
            codes[(codes == REACHED) & hidden_by_cell(leds)] = BY_CELL
        return codes

    return codes_of


def _hidden_by_cell(work: ViewPass) -> Callable[[NDArray[np.int64]], NDArray[np.bool_]] | None:
    """Return a function that gives a mask [leds, triangles] for some LEDs. The mask is True where, by the run, arm
    or tool hide the LED from the triangle's nearest patch or one beside it, since edges of shadows lie between
    patches. None if the run says nothing about shadows."""
    measured_run = work.measured_run
    with h5py.File(measured_run.run.view_path(work.view.name), "r") as file:
        if "entry/shadow/codes" not in file:
            return None
        shadow = {name: file[f"entry/shadow/{name}"][()] for name in ("codes", "leds", "points_mm")}
    points_mm = apply(measured_run.base_from_support, shadow["points_mm"])
    patches = cKDTree(points_mm)
    patch = patches.query(work.facets.centres_mm)[1]
    column = {int(led): n for n, led in enumerate(shadow["leds"])}
    by_cell = (shadow["codes"] == occlusion.BY_ARM) | (shadow["codes"] == occlusion.BY_TOOL)
    beside = patches.query(points_mm, k=min(_PATCHES_BESIDE, len(points_mm)))[1].reshape(len(points_mm), -1)
    by_cell = by_cell[beside].any(axis=1)

    def hidden_from_leds(leds: NDArray[np.int64]) -> NDArray[np.bool_]:
        is_hidden: NDArray[np.bool_] = by_cell.T[[column[int(led)] for led in leds]][:, patch]
        return is_hidden

    return hidden_from_leds


def _write_head(file: h5py.File, work: ViewPass, surface: SeenSurface, digest: ArrayDigest) -> None:
    measured_run, view, leds = work.measured_run, work.view, work.leds
    file.attrs["channels"] = "".join(measured_run.channels)
    file.attrs["simulated"] = measured_run.run.is_simulated
    file.attrs["frame"] = "base of the robot"
    file.attrs["led_u_mm"] = measured_run.led_u_mm  # of each coordinate of an LED's place
    u_lateral_mm = view.pointing.u_lateral_mm(measured_run.lens, view.base_from_camera, work.facets.centres_mm)
    file.attrs["lateral_u_mm"] = u_lateral_mm  # of where pixels look, across the line of sight
    digest.add("seen", surface.places)
    file.create_dataset("seen", data=surface.places, compression="gzip", compression_opts=1, track_times=False)
    file["seen"].attrs["told"] = (
        "[h, w] place in `triangles` of the triangle that a pixel sees, -1 where the pixel is not used"
    )
    _dataset(file, "triangles", surface.triangles, "numbers of the mesh's triangles, from 0", digest)
    _dataset(file, "pixels", work.reader.pixels, "pixels of each channel on each triangle", digest)
    description = "relative standard uncertainty from the pixels' own responses, shared by a triangle's samples"
    _dataset(file, "u_response", work.reader.u_response, description, digest)
    _dataset(file, "centres_mm", work.facets.centres_mm, "centres of the triangles, mm, base frame", digest)
    _dataset(file, "normals", work.facets.normals, "normals of the triangles, unit length, base frame", digest)
    _dataset(file, "camera_mm", view.base_from_camera[:3, 3], "projection centre, mm, base frame", digest)
    _dataset(file, "leds", leds, "numbers of the LEDs", digest)
    centres_mm, normals = measured_run.leds.of(leds)
    _dataset(file, "led_positions_mm", centres_mm, "mm, base frame", digest)
    _dataset(file, "led_normals", normals, "unit, base frame", digest)
    powers = measured_run.powers.of(leds)
    _dataset(
        file,
        "led_u_own",
        powers.u_own,
        "relative standard uncertainty of an LED's power, not shared with other LEDs",
        digest,
    )
    u_shared = np.hypot(powers.u_shared, measured_run.u_signal)
    _dataset(
        file,
        "led_u_shared",
        u_shared,
        "relative, shared by all samples: powers, response, fall-off, drift",
        digest,
    )
    scales = np.stack([_dn_share(measured_run, view, int(led)) for led in leds])
    _dataset(
        file,
        "full_scales",
        scales,
        "share of the camera's range that f cos_i E/Phi = 1 m^-2 sr^-1 gives in the longest exposure",
        digest,
    )


def _dn_share(measured_run: MeasuredRun, view: MeasuredView, led: int) -> Floats:
    """[channels] share of the camera's range for f cos_i E/Phi = 1."""
    frame = max(view.by_led[led], key=lambda frame: frame.exposure_us)
    range_dn = measured_run.frames.white_dn - measured_run.frames.black_dn
    share: Floats = measured_run.power_of(frame) * frame.exposure_us * 1e-6 / range_dn
    return share


def _dataset(file: h5py.File, name: str, values: NDArray[Any], description: str, digest: ArrayDigest) -> None:
    file.create_dataset(name, data=values, track_times=False).attrs["told"] = description
    digest.add(name, values)


def _begin_samples(file: h5py.File, work: ViewPass) -> dict[str, h5py.Dataset]:
    """Create `f`, `u_own` [triangles, leds, channels] and `codes` [triangles, leds], in chunks as the samples
    arrive."""
    (count, channels), leds = work.reader.pixels.shape, len(work.leds)
    codes = ", ".join(f"{code} {name}" for name, code in CODES.items())
    kinds: dict[str, tuple[Any, tuple[int, ...], str]] = {
        "f": (np.float16, (count, leds, channels), "reflectance, 1/sr; NaN where there is no sample"),
        "u_own": (np.float16, (count, leds, channels), "relative standard uncertainty from noise"),
        "codes": (np.uint8, (count, leds), f"of a triangle and an LED: {codes}"),
    }
    if "glare" in work.measured_run.records:
        kinds[GLARE] = (
            np.float16,
            (count, leds, channels),
            "veil of glare that was subtracted, divided by the remaining value",
        )
    data = {}
    for name, (kind, shape, description) in kinds.items():
        chunks = (min(BLOCK, count), min(work.together, leds), channels)[: len(shape)]
        data[name] = file.create_dataset(name, shape, kind, chunks=chunks, track_times=False)
        data[name].attrs["told"] = description
    return data


def _write_chunk(data: h5py.Dataset, some: Samples, values: NDArray[Any]) -> None:
    """Write a chunk directly to its place in the file. The last LEDs and triangles may not fill a chunk; they are
    written in the ordinary way."""
    if values.shape == data.chunks:
        data.id.write_direct_chunk((some.rows.start, some.leds.start, 0)[: values.ndim], values.tobytes())
    else:
        data[some.rows, some.leds] = values
