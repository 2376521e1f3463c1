"""One pass over a run's frames: samples of reflectance of every triangle under every LED, view by view, on disk.

f = S / (P E/Phi cos_i): mean signal S of a triangle's pixels (DN/s over the flat field, dark and response taken
out) over the irradiance that the LED's power P (DN/s m^2 sr) throws on it (seed 003, Eqs. 1 to 3). The mean over a
triangle stands for the paper's prefilter of 0.1 degree: neighbouring LEDs are degrees apart.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.calibration.light.frames import LightFrame
from coupole.calibration.light.tile_views import Positions
from coupole.errors import InputError
from coupole.geometry import apply
from coupole.motion import occlusion
from coupole.reflectance.extraction.lamp_sight import AWAY, PENUMBRA, REACHED, SHADED, lamp_codes, lit_by
from coupole.reflectance.extraction.lamp_sight import neighbours_of as sides_of
from coupole.reflectance.extraction.measured_run import MeasuredRun, MeasuredView
from coupole.reflectance.extraction.radiance import Radiometry, SignalReader
from coupole.reflectance.extraction.seen_surface import SeenSurface, seen_surface
from coupole.reflectance.result_folder import complete

Floats = NDArray[np.float64]

BY_CELL = PENUMBRA + 1
"""Code of a triangle and an LED that arm, camera or tool may hide from each other."""
CODES = {"reached": REACHED, "away": AWAY, "shaded": SHADED, "penumbra": PENUMBRA, "hidden by the cell": BY_CELL}
BLOCK = 4096
"""Triangles in a chunk on disk."""
_BATCH_BYTES = 256_000_000
"""Of samples in memory before they are written."""
MOST_BLUR_PX = 2.0
"""Diameter of the circle of confusion."""
Say = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Geometry:
    """The object's triangles as all views share them."""

    scene: Any
    """For rays."""
    centres_mm: Floats
    normals: Floats
    """[triangles, 3] unit, outward."""
    sides: NDArray[np.int64]
    """[triangles, 3] neighbours."""


def geometry_of(measured: MeasuredRun) -> Geometry:
    corners = measured.corners_mm
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    scene = occlusion.ray_mesh(corners)
    return Geometry(scene, corners.mean(axis=1), normals, sides_of(measured.triangles))


def extract_view(
    measured: MeasuredRun, geometry: Geometry, radiometry: Radiometry, view: MeasuredView, path: Path, say: Say
) -> dict[str, Any]:
    """Write a view's samples to an HDF5 file, whole or not at all; what the report says of them."""
    focal_mm, focus_mm, f_number = measured.optics
    surface = seen_surface(
        geometry.scene,
        measured.corners_mm,
        measured.lens,
        view.base_from_camera,
        measured.frames.size_px,
        blur=(focal_mm, focus_mm, f_number, MOST_BLUR_PX),
    )
    if not len(surface.rows):
        raise InputError(
            f"{measured.run.folder}: no pixel of the view {view.name} shows the mesh: do mesh and hand-eye "
            "belong to this run, and is the object in focus?"
        )
    reader = SignalReader(radiometry, surface)
    leds = np.array(list(view.by_led), np.int64)
    codes = _codes(measured, geometry, view, surface, leds)
    used = 0

    def write(part: Path) -> None:
        nonlocal used
        with h5py.File(part, "w") as file:
            _write_head(file, measured, geometry, view, surface, reader, leds, codes)
            used = _write_samples(file, measured, geometry, view, surface, reader, leds, codes, say)

    complete(path, write)
    share = {name: float(np.mean(codes == code)) for name, code in CODES.items()}
    return {
        "view": view.name,
        "pixels": len(surface.rows),
        "triangles": len(surface.triangles),
        "leds": len(leds),
        "samples": used,
        "share_by_code": share,
    }


def _codes(
    measured: MeasuredRun,
    geometry: Geometry,
    view: MeasuredView,
    surface: SeenSurface,
    leds: NDArray[np.int64],
) -> NDArray[np.uint8]:
    """[triangles of the view, leds] codes: what the object hides, and what the cell may hide."""
    mine = surface.triangles
    place = np.full(len(geometry.centres_mm), -1)
    place[mine] = np.arange(len(mine))
    sides = geometry.sides[mine]
    sides = np.where(sides >= 0, place[sides], -1)
    centres_mm, led_normals = measured.leds.of(leds)
    positions = Positions(leds, centres_mm, led_normals)
    codes = lamp_codes(geometry.scene, geometry.centres_mm[mine], geometry.normals[mine], sides, positions)
    hidden = _hidden_by_cell(measured, view, geometry.centres_mm[mine], leds)
    codes[(codes == REACHED) & hidden] = BY_CELL
    return codes


def _hidden_by_cell(
    measured: MeasuredRun, view: MeasuredView, centres_mm: Floats, leds: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """[triangles, leds] what the run says that arm or tool hide from the nearest patch of the object."""
    with h5py.File(measured.run.view_path(view.name), "r") as file:
        if "entry/shadow/codes" not in file:
            return np.zeros((len(centres_mm), len(leds)), np.bool_)
        shadow = {name: file[f"entry/shadow/{name}"][()] for name in ("codes", "leds", "points_mm")}
    points_mm = apply(measured.base_from_support, shadow["points_mm"])
    patch = cKDTree(points_mm).query(centres_mm)[1]
    column = {int(led): n for n, led in enumerate(shadow["leds"])}
    codes = shadow["codes"][:, [column[int(led)] for led in leds]]
    by_cell = (codes == occlusion.BY_ARM) | (codes == occlusion.BY_TOOL)
    found: NDArray[np.bool_] = by_cell[patch]
    return found


def _write_head(
    file: h5py.File,
    measured: MeasuredRun,
    geometry: Geometry,
    view: MeasuredView,
    surface: SeenSurface,
    reader: SignalReader,
    leds: NDArray[np.int64],
    codes: NDArray[np.uint8],
) -> None:
    file.attrs["view"] = view.name
    file.attrs["channels"] = "".join(measured.channels)
    file.attrs["simulated"] = measured.run.simulated
    file.attrs["frame"] = "base of the robot"
    file.attrs["led_u_mm"] = measured.led_u_mm  # of each coordinate of an LED's place
    width, height = measured.frames.size_px
    seen = np.full((height, width), -1, np.int32)
    seen[surface.rows, surface.columns] = surface.triangle
    file.create_dataset("seen", data=seen, compression="gzip", compression_opts=1, track_times=False)
    file["seen"].attrs["told"] = "[h, w] place in `triangles` of what a pixel sees, -1 where it is not used"
    _dataset(file, "triangles", surface.triangles, "numbers of the mesh's triangles, from 0")
    _dataset(file, "pixels", reader.pixels, "pixels of each channel on each triangle")
    told = "relative standard uncertainty that a triangle's samples share, of pixels' own responses"
    _dataset(file, "u_response", reader.u_response, told)
    _dataset(file, "centres_mm", geometry.centres_mm[surface.triangles], "of the triangles, mm, base frame")
    _dataset(file, "normals", geometry.normals[surface.triangles], "of the triangles, unit, base frame")
    _dataset(file, "camera_mm", view.base_from_camera[:3, 3], "projection centre, mm, base frame")
    _dataset(file, "leds", leds, "numbers of the LEDs")
    centres_mm, normals = measured.leds.of(leds)
    _dataset(file, "led_positions_mm", centres_mm, "mm, base frame")
    _dataset(file, "led_normals", normals, "unit, base frame")
    powers = measured.powers.of(leds)
    _dataset(file, "led_u_own", powers.u_own, "relative standard uncertainty of an LED's power, its own")
    _dataset(file, "led_u_shared", powers.u_shared, "relative, of what all LEDs share")
    scales = np.stack([_dn_share(measured, view, int(led)) for led in leds])
    _dataset(file, "full_scales", scales, "of the camera that f cos_i E/Phi of 1 gives in the longest exposure")
    told = ", ".join(f"{code} {name}" for name, code in CODES.items())
    _dataset(file, "codes", codes, f"of a triangle and an LED: {told}", chunks=(BLOCK, len(leds)))


def _dn_share(measured: MeasuredRun, view: MeasuredView, led: int) -> Floats:
    """[channels] share of the camera's range that f cos_i E/Phi of 1 gives."""
    frame = max(view.by_led[led], key=lambda frame: frame.exposure_us)
    range_dn = measured.frames.white_dn - measured.frames.black_dn
    share: Floats = measured.power_of(frame) * frame.exposure_us * 1e-6 / range_dn
    return share


def _dataset(
    file: h5py.File, name: str, values: NDArray[Any], told: str, chunks: tuple[int, ...] | None = None
) -> None:
    if chunks is not None:
        chunks = tuple(min(size, length) for size, length in zip(chunks, values.shape, strict=True))
    file.create_dataset(name, data=values, chunks=chunks, track_times=False).attrs["told"] = told


def _write_samples(
    file: h5py.File,
    measured: MeasuredRun,
    geometry: Geometry,
    view: MeasuredView,
    surface: SeenSurface,
    reader: SignalReader,
    leds: NDArray[np.int64],
    codes: NDArray[np.uint8],
    say: Say,
) -> int:
    """`f` and `u_own` [triangles, leds, channels], batch by batch of LEDs in the order of the frames' file; the
    number of samples that can be used."""
    count, channels = reader.pixels.shape
    batch = int(np.clip(_BATCH_BYTES // (8 * max(1, count * channels)), 1, len(leds)))
    shape, chunks = (count, len(leds), channels), (min(BLOCK, count), batch, channels)
    told = {"f": "reflectance, 1/sr; NaN where there is none", "u_own": "relative standard uncertainty, of noise"}
    data = {
        name: file.create_dataset(name, shape, np.float32, chunks=chunks, fillvalue=np.nan, track_times=False)
        for name in told
    }
    for name, text in told.items():
        data[name].attrs["told"] = text
    mine = surface.triangles
    centres_mm, normals = geometry.centres_mm[mine], geometry.normals[mine]
    led_mm, led_normals = measured.leds.of(leds)

    def extract(column: int, f: NDArray[np.float32], u: NDArray[np.float32]) -> int:
        frames = view.by_led[int(leds[column])]
        signal, u_signal = _merged(reader, frames)
        _reflectance(
            signal, u_signal, centres_mm, normals, led_mm[column], led_normals[column],
            measured.power_of(frames[0]), measured.emission == "paper", codes[:, column], f, u,
        )  # fmt: skip
        return len(frames)

    used = done = 0
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for first in range(0, len(leds), batch):
            part = slice(first, min(first + batch, len(leds)))
            f = np.full((count, part.stop - first, channels), np.nan, np.float32)
            u = np.full(f.shape, np.nan, np.float32)
            columns = range(part.stop - first)
            each = pool.map(lambda n: extract(first + n, f[:, n], u[:, n]), columns)  # noqa: B023  taken below
            for frames in each:
                done += frames
                say(f"samples of {view.name}", done, len(view.frames))
            used += int(np.isfinite(f).sum())
            data["f"][:, part], data["u_own"][:, part] = f, u
    return used


def _merged(reader: SignalReader, frames: list[LightFrame]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Signal and its relative uncertainty of all exposures under one LED, weighted by their variances; by their
    times where noise is not known."""
    read = [reader.means(frame) for frame in frames]
    if len(read) == 1:
        return read[0].signal, read[0].u_signal
    signals = np.stack([one.signal for one in read]).astype(np.float64)
    absolute = signals * np.stack([one.u_signal for one in read])
    times = np.array([frame.exposure_us for frame in frames])[:, None, None]
    weights = np.where(np.isnan(absolute).all(), np.broadcast_to(times, signals.shape), absolute**-2.0)
    weights = np.where(np.isfinite(signals) & np.isfinite(weights), weights, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = weights.sum(axis=0)
        signal = np.sum(weights * np.nan_to_num(signals), axis=0) / total
        relative = total**-0.5 / signal if np.isfinite(absolute).any() else np.full(signal.shape, np.nan)
    return signal.astype(np.float32), relative.astype(np.float32)


@numba.njit(cache=True, nogil=True)
def _reflectance(  # type: ignore[no-untyped-def]
    signal, u_signal, centres, normals, led_centre, led_normal, power, paper, codes, f, u
):
    towards = np.empty(3)
    for triangle in range(len(signal)):
        if codes[triangle] != REACHED:
            continue
        lit = lit_by(centres[triangle], led_centre, led_normal, paper, towards)
        cosine = 0.0
        for k in range(3):
            cosine += towards[k] * normals[triangle, k]
        for channel in range(signal.shape[1]):
            if power[channel] > 0.0:
                f[triangle, channel] = signal[triangle, channel] / (power[channel] * lit * cosine)
                if not np.isnan(f[triangle, channel]):
                    u[triangle, channel] = u_signal[triangle, channel]


def blocks(path: Path) -> Iterator[slice]:
    """Of the triangles of a file of samples, as they are to be read."""
    with h5py.File(path, "r") as file:
        count = len(file["triangles"])
    for first in range(0, count, BLOCK):
        yield slice(first, min(first + BLOCK, count))
