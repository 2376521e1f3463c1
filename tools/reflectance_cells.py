"""Cells for the closed loop of reflectance: rendered runs, scans and records with random errors, and the
comparison of the result with the simulator's truth.

Frames are rendered by `sim`, acquired and proven as in the real cell, and evaluated by `coupole.reflectance`. The
truth is the simulator's own table of the material at the true triangles, LEDs and camera.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import trimesh
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import cells  # noqa: E402

from coupole.geometry import apply  # noqa: E402
from coupole.kernels import kernel  # noqa: E402
from coupole.reflectance.extraction.lamp_sight import lit_on  # noqa: E402
from coupole.reflectance.ggx import tangents  # noqa: E402
from coupole.reflectance.run_job import RunRequest, extract_runs, reflectance_of  # noqa: E402
from coupole.reflectance.run_pictures import read_check_frames  # noqa: E402
from coupole.reflectance.run_result import RunResult, ViewSamples  # noqa: E402
from coupole.reflectance.run_uncertainty import QUANTILE, known_samples  # noqa: E402
from coupole.reflectance.sample_uncertainty import bounds, tilt_covariance  # noqa: E402
from coupole.reflectance.triangle_fit import model_values  # noqa: E402
from drawn_records import Scale, draw_records, true_leds  # noqa: E402
from sim.objects.specimens import specimen  # noqa: E402
from sim.scene.brdf_table import look_up  # noqa: E402

Floats = NDArray[np.float64]
SCANS = ("normals", "independent", "correlated")
"""Errors of the scanner: normals by 2 degrees (rms), vertices by 30 um, and the same correlated over 1 mm."""
NORMALS_DEG, VERTICES_UM, CORRELATED_MM = 2.0, 30.0, 1.0
OLD_VIEWS = (cells.TOP, {**cells.TOP, "name": "side", "azimuth_deg": -60, "elevation_deg": 55})
NEW_VIEW = {**cells.TOP, "name": "third", "azimuth_deg": -130, "elevation_deg": 60}
THIRDS_DEG = (0.0, 30.0, 60.0, 90.0)
_SAMPLES = 20_000
"""Number of samples of each view and channel that are compared."""


@dataclass(frozen=True)
class Acquired:
    """Runs of one material: two views, and one that the fit does not use."""

    material: str
    old: Path
    new: Path
    mesh: Path
    """The true mesh."""


@dataclass(frozen=True)
class Judged:
    """A cell, compared with the truth."""

    inside: NDArray[np.int64]
    """[channels, thirds of theta, 2] number of samples within their intervals, and of all samples."""
    scanned_deg: float
    """Rms angle between the scan's normals and the truth."""
    fitted_deg: float
    normals_inside: tuple[int, int]
    mae: dict[str, float]
    old_view: float
    """Mean error of GGX with normal, as a share of the range, under LEDs that were left out."""
    new_view: float

    def line(self) -> dict[str, Any]:
        return {**vars(self), "inside": self.inside.tolist()}


def acquire(folder: Path, material: str, *, every: int = 12, size_mm: float = 36.0) -> Acquired:
    """Render and prove the runs of a material on a part of the shipped relief."""
    mesh = _part_of_relief(folder, size_mm)
    runs = []
    for name, views, lights in (
        ("old", OLD_VIEWS, {"kind": "every", "every": every}),
        ("new", (NEW_VIEW,), {"kind": "every", "every": 12 * every}),
    ):
        (folder / name).mkdir()
        cell = cells.CellFolder(folder / name, speed=10.0, write_now=False)
        cell.plan_data["object"]["mesh"] = str(mesh)
        cell.rig_data["sensor"] |= {"width_px": 512, "height_px": 384, "pixel_pitch_um": 44.0}
        cell.world_settings.update(white_at_us=8000, material={"specimen": material}, shading="pixel")
        cell.world_settings.update(interreflection=False)
        cell.write(views=list(views), lights=lights, darks_per_view=2)
        outcome = cell.acquire()
        if outcome.code:
            raise RuntimeError(f"{material}: {outcome.err}")
        runs.append(cell.run_folder)
    old, new = runs
    return Acquired(material, old, new, mesh)


def judge(acquisition: Acquired, scan: str, seed: int, folder: Path, scale: Scale | None = None) -> Judged:
    """Evaluate the runs of a material with the errors of a seed."""
    records = draw_records(folder / "records", seed, scale)
    scan_path, noise_um = _scan(folder, acquisition.mesh, scan, seed)
    request = RunRequest((acquisition.old,), scan_path, records, scan_noise_um=noise_um)
    about = reflectance_of(request, folder / "old")
    result, truth = RunResult(folder / "old"), Truth.of(acquisition, folder / "old")
    inside = np.sum([_inside(result, view, noise_um, truth) for view in result.views], axis=0)
    materials = result.materials("ggx_normal")
    has_fit = np.isfinite(materials.alpha)
    true_normals = truth.normals[result.triangles]
    fitted_normals = materials.normals[has_fit]
    steps = np.array([tangents(*normal) for normal in fitted_normals])
    tilts = np.einsum("nki,ni->nk", steps, true_normals[has_fit] - fitted_normals)
    spreads = np.sqrt(np.einsum("nii->ni", result.material_covariances("ggx_normal")[has_fit])[:, :2])
    inside_interval = np.abs(tilts) < QUANTILE * spreads
    scan_normals = _flat_normals(result.corners_mm[result.triangles].astype(float))
    leds = tuple(_leds_of(acquisition.new))
    extract_runs(replace(request, runs=(acquisition.new,), left_out=leds), folder / "new")
    return Judged(
        inside,
        _off_deg(scan_normals[has_fit], true_normals[has_fit]),
        _off_deg(fitted_normals, true_normals[has_fit]),
        (int(inside_interval.sum()), inside_interval.size),
        {name: float(value) for name, value in about["mae"].items()},
        float(about["mae"]["ggx_normal"]),
        _new_view_error(result, RunResult(folder / "new")),
    )


@dataclass(frozen=True)
class Truth:
    """The simulator's truth, base frame."""

    table: NDArray[np.float32]
    corners_mm: Floats
    normals: Floats
    leds_mm: Floats
    """[leds, 3] by their numbers."""
    cameras_mm: dict[str, Floats]

    @staticmethod
    def of(acquisition: Acquired, result: Path) -> Truth:
        mesh = trimesh.load(acquisition.mesh, process=False)
        corners = apply(RunResult(result).base_from_support, mesh.vertices)[mesh.faces]
        cameras = {}
        for path in (acquisition.old / "views").glob("*.h5"):
            with h5py.File(path, "r") as file:
                cameras[path.stem] = file["entry/instrument/robot/poses"]["base_from_camera"][0][:3, 3]
        table = specimen(acquisition.material).table
        assert table is not None
        return Truth(table, corners, _flat_normals(corners), true_leds().positions_mm, cameras)

    def reflectance(self, view: str, triangles: NDArray[np.int64], leds: NDArray[np.int64]) -> Floats:
        """Return [n, 3] reflectance of samples, by their triangles and LEDs' numbers."""
        centres, normals = self.corners_mm[triangles].mean(axis=1), self.normals[triangles]
        lights, eyes = _unit(self.leds_mm[leds] - centres), _unit(self.cameras_mm[view] - centres)
        values = np.full((len(leds), 3), np.nan)
        _look_up_all(self.table, normals, lights, eyes, values)
        return values


def _inside(result: RunResult, view: ViewSamples, noise_um: float, truth: Truth) -> NDArray[np.int64]:
    counts = np.zeros((3, 3, 2), np.int64)
    for channel in range(3):
        samples = known_samples(result, view, channel, noise_um, most=_SAMPLES, of_triangles=len(view.triangles))
        triangles = view.triangles[samples.rows]
        true = truth.reflectance(view.view, triangles, view.leds[samples.leds])[:, channel]
        low, high = bounds(samples.places, samples.sources, QUANTILE)
        ratio = true / samples.f
        centres = samples.places.corners_mm.mean(axis=1)
        cosine = np.sum(_unit(samples.places.led_mm - centres) * _flat_normals(samples.places.corners_mm), axis=1)
        third = np.digitize(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))), THIRDS_DEG[1:3])
        for number in range(3):
            in_third = (third == number) & np.isfinite(ratio)
            counts[channel, number] += [
                np.count_nonzero((ratio > low) & (ratio < high) & in_third),
                in_third.sum(),
            ]
    return counts


def _new_view_error(fitted_result: RunResult, check_result: RunResult) -> float:
    """Return the mean error of GGX with normal, as a share of the range, in pictures of a view that the fit did
    not use."""
    (view,) = check_result.views
    places = np.searchsorted(fitted_result.triangles, view.triangles).clip(max=len(fitted_result.triangles) - 1)
    same = fitted_result.triangles[places] == view.triangles
    frames = read_check_frames(check_result, view)
    rows = slice(0, len(view.triangles))
    samples = check_result.view_samples(view, rows, np.isin(view.leds, frames.leds))
    predictions = model_values(samples, fitted_result.materials("ggx_normal").at(places))
    predictions[~same] = np.nan
    lit = lit_on(samples.centres_mm, samples.led_mm, view.led_normals, False)
    share = predictions * lit[..., None] * view.full_scales
    off = []
    for channel in range(3):
        place, measurements = frames.pairs(rows, channel)
        differences = share[place, :, channel] - measurements
        off.append(np.abs(differences[np.isfinite(differences)]))
    return float(np.concatenate(off).mean())


def _scan(folder: Path, mesh: Path, scan: str, seed: int) -> tuple[Path, float]:
    """Return the mesh as a scanner with errors measures it, and the stated noise of its vertices."""
    scan_mesh = trimesh.load(mesh, process=False)
    random = np.random.default_rng((seed, SCANS.index(scan)))
    noise_um = VERTICES_UM
    if scan == "normals":
        corners = np.asarray(scan_mesh.vertices)[scan_mesh.faces]
        tilts = np.einsum("nii->n", tilt_covariance(corners, np.ones(len(corners))))
        noise_um = float(np.radians(NORMALS_DEG) / np.sqrt(tilts.mean()))
    errors = random.standard_normal(scan_mesh.vertices.shape)
    if scan == "correlated":
        apart = np.linalg.norm(scan_mesh.vertices[:, None] - scan_mesh.vertices[None], axis=2) / CORRELATED_MM
        values, vectors = np.linalg.eigh(np.exp(-0.5 * apart**2))
        errors = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * errors)
    scan_mesh.vertices = scan_mesh.vertices + 1e-3 * noise_um * errors
    path = folder / "scan.ply"
    scan_mesh.export(path)
    return path, noise_um


def _part_of_relief(folder: Path, size_mm: float) -> Path:
    """Return a square of the shipped relief, with about 0.7 mm2 for each triangle."""
    relief = trimesh.load(ROOT / "configs/objects/relief.ply", process=False)
    x, y, _ = relief.triangles_center.T
    relief.update_faces((x > 10) & (x < 10 + size_mm) & (np.abs(y) < 0.5 * size_mm))
    relief.remove_unreferenced_vertices()
    path = folder / "object.ply"
    relief.export(path)
    return path


def _leds_of(run: Path) -> list[int]:
    with h5py.File(next((run / "views").glob("*.h5")), "r") as file:
        leds = file["entry/instrument/detector/frames"]["led"]
    return [int(led) for led in np.unique(leds) if led != 65535]


def _off_deg(normals: Floats, truth: Floats) -> float:
    """Return the root mean square angle between the normals and the truth, degrees."""
    chord = np.linalg.norm(normals - truth, axis=1)
    return float(np.degrees(np.sqrt(np.mean((2.0 * np.arcsin(0.5 * chord)) ** 2))))


def _flat_normals(corners_mm: Floats) -> Floats:
    return _unit(np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0]))


def _unit(vectors: Floats) -> Floats:
    unit_vectors: Floats = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit_vectors


@kernel
def _look_up_all(table, normals, lights, eyes, values):  # type: ignore[no-untyped-def]
    for n in range(len(values)):
        a, b, c = normals[n], lights[n], eyes[n]
        if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] > 0.0 and a[0] * c[0] + a[1] * c[1] + a[2] * c[2] > 0.0:
            look_up(table, a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2], values[n])
