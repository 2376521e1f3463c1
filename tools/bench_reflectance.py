"""Speed and memory of reflectance: full-size frames to samples, fits of triangles, relit pictures.

The run is that of `bench_measured_run`. Peers: a read of the same bytes past the page cache, BLAS, SciPy, Mitsuba,
and what was published of La Coupole (seed 003, 6.2 and 6.3: half a million triangles, ten cores).
"""

from __future__ import annotations

import json
import mmap
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from bench_measured_run import VIEW, make_run, read_run

FRAMES, FEW_FRAMES = 300, 10
LIMIT_S, LIMIT_OVER_READ = 60.0, 1.5
PAPER_S = 150.0
"""100 to 200 s with ten cores."""
PAPER_BYTES = {"ggx_normal": 14e6, "sh": 600e6, "rbf": 600e6}
PAPER_TRIANGLES = 500_000
PAPER_TIMES = {"ggx_normal": 1.0, "sh": 2.0, "rbf": 6.0}
"""Of making a picture, over GGX's."""
_FITTED, _BY_SCIPY = 16_384, 256
_CHUNK = 16 << 20


def figures(root: Path, rounds: int, frames: int = FRAMES) -> Iterator[dict[str, Any]]:
    with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as name:
        folder = Path(name)
        yield from _memory(root, folder, frames)
        yield from _extraction(folder, rounds)
        samples = _some_samples(folder)
        yield from _fits(samples, rounds)
        yield from _representations(samples, rounds)
        yield from _relit(root, folder, samples, rounds)


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def _timed(work: Callable[[], Any]) -> float:
    started_s = time.perf_counter()
    work()
    return time.perf_counter() - started_s


def _medians(works: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Seconds of interleaved functions, that have been called before."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            times[name].append(_timed(work))
    return {name: statistics.median(each) for name, each in times.items()}


def _figure(name: str, value: float, unit: str, peer: str, ratio: float, **more: Any) -> dict[str, Any]:
    return {"name": f"reflectance_{name}", "value": value, "unit": unit, "peer": peer, "ratio": ratio, **more}


# -- extraction ---------------------------------------------------------------------------------------------

_ALONE = """
import json, sys
from pathlib import Path
sys.path[:0] = [{tools!r}, {root!r}]
from bench_reflectance import extract
told = extract(Path({folder!r}), lambda step, done, of: None)
peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
print(json.dumps(int(peak.split()[1]) * 1024))
"""


def _memory(root: Path, folder: Path, frames: int) -> Iterator[dict[str, Any]]:
    """Peak memory of a process that extracts a run of few frames, and of many."""
    peaks = []
    for count in (FEW_FRAMES, frames):
        shutil.rmtree(folder / "runs", ignore_errors=True)
        make_run(root, folder, count)
        script = _ALONE.format(tools=str(root / "tools"), root=str(root), folder=str(folder))
        done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
        peaks.append(json.loads(done.stdout) / 1e9)
    ratio = peaks[0] / peaks[1]
    yield _figure("extraction_peak_memory", peaks[1], "GB", f"{FEW_FRAMES}_frames", ratio, frames=frames)


def extract(folder: Path, say: Callable[[str, int, int], None]) -> dict[str, Any]:
    """The whole of it: what a view sees, shadows, samples, into a file."""
    from coupole.reflectance.extraction.extraction import extract_view, geometry_of

    measured, radiometry = read_run(folder)
    (folder / "samples").mkdir(exist_ok=True)
    path = folder / "samples" / f"{VIEW}.h5"
    path.unlink(missing_ok=True)
    return extract_view(measured, geometry_of(measured), radiometry, measured.views[0], path, say)


def _extraction(folder: Path, rounds: int) -> Iterator[dict[str, Any]]:
    from coupole.reflectance.extraction.extraction import geometry_of, shadows_of, view_pass

    measured, radiometry = read_run(folder)
    path = measured.run.view_path(VIEW)
    geometry = geometry_of(measured)
    work, _ = view_pass(measured, geometry, radiometry, measured.views[0], _cores())
    count, frames = len(work.facets.centres_mm), len(measured.views[0].frames)
    codes_of = shadows_of(work, geometry)

    def all_reached(part: slice, _pool: Executor) -> NDArray[np.uint8]:
        return np.zeros((part.stop - part.start, count), np.uint8)

    def values() -> None:
        for _ in work.samples(all_reached, _cores()):
            pass

    def shadows() -> None:
        with ThreadPoolExecutor(_cores()) as pool:
            for first in range(0, len(work.leds), work.together):
                codes_of(slice(first, min(first + work.together, len(work.leds))), pool)

    next(work.samples(all_reached, 1))  # compiles
    works: dict[str, Callable[[], Any]] = {
        "read": lambda: _read_direct(path, frames * measured.frames.size_px[0] * measured.frames.size_px[1] * 2),
        "values": lambda: (_forget(path), values()),
        "seen": lambda: view_pass(measured, geometry, radiometry, measured.views[0], _cores()),
        "shadows": shadows,
        "whole": lambda: (_forget(path), extract(folder, lambda step, done, of: None)),
    }
    seconds = _medians(works, rounds)
    used_s = time.process_time()
    works["whole"]()
    used_s = time.process_time() - used_s
    about = {"frames": frames, "triangles": count, "cores": _cores()}
    over_read = LIMIT_OVER_READ * seconds["read"] / seconds["values"]
    yield _figure("values_and_angles", seconds["values"], "s", "1.5_o_direct_reads", over_read, **about)
    steps = {f"{name}_s": round(seconds[name], 3) for name in ("read", "seen", "shadows", "values")}
    steps["cpu_s"] = round(used_s, 3)
    for peer, limit_s in (("limit_60_s", LIMIT_S), ("paper_10_cores", PAPER_S)):
        yield _figure("extraction", seconds["whole"], "s", peer, limit_s / seconds["whole"], **about, **steps)


def _forget(path: Path) -> None:
    """Have the operating system drop a file from its page cache."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _read_direct(path: Path, size: int) -> None:
    """As many bytes of a file, past the page cache."""
    _forget(path)
    memory = mmap.mmap(-1, _CHUNK)
    fd = os.open(path, os.O_RDONLY | os.O_DIRECT)
    try:
        for offset in range(0, size, _CHUNK):
            os.preadv(fd, [memory], offset)
    finally:
        os.close(fd)


# -- fits ---------------------------------------------------------------------------------------------------


def _result(folder: Path) -> Any:
    from coupole.reflectance.run_result import OBJECT, RunResult
    from coupole.reflectance.run_result_files import write_object

    measured, _ = read_run(folder)
    write_object(folder / OBJECT, measured.corners_mm, measured.base_from_support)
    return RunResult(folder)


def _some_samples(folder: Path) -> Any:
    """Of neighbouring triangles in the middle of the view."""
    result = _result(folder)
    view = result.views[0]
    first = len(view.triangles) // 2
    return result.view_samples(view, slice(first, first + _FITTED))


def _fits(samples: Any, rounds: int) -> Iterator[dict[str, Any]]:
    """Microseconds a triangle with all cores, three channels."""
    from coupole.reflectance.slice_basis import HARMONICS, RADIAL
    from coupole.reflectance.slice_fit import fit_slices
    from coupole.reflectance.triangle_fit import fit_triangles

    count, leds, _ = samples.values.shape
    used = np.ones(leds, np.bool_)
    each = float(np.isfinite(samples.values).sum() / samples.values.shape[2] / count)
    works: dict[str, Callable[[], Any]] = {
        "sh": lambda: fit_slices(samples, used, (HARMONICS, None)),
        "rbf": lambda: fit_slices(samples, used, (RADIAL, None)),
        "ggx": lambda: fit_triangles(samples, used, None),
        "ggx_normal": lambda: fit_triangles(samples, used, 30.0),
        "sgemm": lambda: _sgemm(round(each), count),
    }
    for work in works.values():
        work()
    us = {name: 1e6 * seconds / count for name, seconds in _medians(works, rounds).items()}
    few = samples.of_triangles(np.arange(0, count, count // _BY_SCIPY))
    scipy = {
        name: 1e6 * _timed(lambda fit=fit: fit(few)) / len(few.values) / _cores()
        for name, fit in (("sh", _scipy_harmonics), ("ggx", _scipy_ggx))
    }
    about = {"samples": round(each), "triangles": count, "cores": _cores()}
    yield _figure("sh_fit", us["sh"], "us", "half_of_sgemm", 2.0 * us["sgemm"] / us["sh"], **about)
    yield _figure("sh_fit", us["sh"], "us", "scipy_on_all_cores", scipy["sh"] / us["sh"], **about)
    yield _figure("rbf_fit", us["rbf"], "us", "twice_sh", 2.0 * us["sh"] / us["rbf"], **about)
    for name in ("ggx", "ggx_normal"):
        yield _figure(f"{name}_fit", us[name], "us", "scipy_on_all_cores", scipy["ggx"] / us[name], **about)


def _sgemm(samples: int, count: int) -> None:
    """The products that the normal equations of as many triangles need: 100 functions with themselves and with
    three channels."""
    from scipy.linalg.blas import sgemm

    a = np.asfortranarray(np.random.default_rng(0).random((samples, 100), np.float32))
    b = np.asfortranarray(np.random.default_rng(1).random((samples, 103), np.float32))

    def some(_: int) -> None:
        for _ in range(count // _cores()):
            sgemm(1.0, a, b, trans_a=True)

    with ThreadPoolExecutor(_cores()) as pool:
        list(pool.map(some, range(_cores())))


def _frame_of(samples: Any, triangle: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """[n, 3] directions to the lights in the slice's frame, the axes [3, 3], and which samples are there."""
    normal, centre = samples.normals[triangle], samples.centres_mm[triangle]
    across = samples.cameras_mm[0] - centre
    across -= normal * (across @ normal)
    axes = np.stack([across, np.cross(normal, across), normal])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    there = np.isfinite(samples.values[triangle]).all(axis=1)
    light = samples.led_mm[there] - centre
    return (light / np.linalg.norm(light, axis=1, keepdims=True)) @ axes.T, axes, there


def _scipy_harmonics(samples: Any) -> None:
    """The same normal equations, triangle by triangle."""
    from scipy.linalg import cho_factor, cho_solve
    from scipy.special import sph_harm_y_all

    from coupole.reflectance.slice_basis import HARMONICS

    for triangle in range(len(samples.values)):
        light, _, there = _frame_of(samples, triangle)
        known = sph_harm_y_all(9, 9, np.arccos(light[:, 2]), np.arctan2(light[:, 1], light[:, 0]))
        rows = np.concatenate(
            [
                part
                for degree in range(10)
                for part in (known[degree, : degree + 1].real, known[degree, 1 : degree + 1].imag)
            ]
        )
        rows *= light[:, 2]
        matrix = rows @ rows.T + np.diag(HARMONICS.penalty)
        cho_solve(cho_factor(matrix), rows @ samples.values[triangle][there])


def _scipy_ggx(samples: Any) -> None:
    """The same robust problem from the same three starts, normal fitted, triangle by triangle."""
    from scipy.optimize import least_squares

    for triangle in range(len(samples.values)):
        light, axes, there = _frame_of(samples, triangle)
        view = samples.cameras_mm[0] - samples.centres_mm[triangle]
        view = axes @ (view / np.linalg.norm(view))
        half = (light + view) / np.linalg.norm(light + view, axis=1, keepdims=True)
        roots = np.sqrt(np.maximum(samples.values[triangle][there].mean(axis=1), 0.0))
        kd = float(np.median(roots**2 / np.maximum(light[:, 2], 0.02)))

        def off(x: Any, light: Any = light, view: Any = view, half: Any = half, roots: Any = roots) -> Any:
            normal = np.array([x[0], x[1], 1.0])
            normal /= np.linalg.norm(normal)
            nl, nv, nh = np.maximum(light @ normal, 1e-9), max(normal @ view, 1e-9), half @ normal
            a2 = np.exp(2 * x[4])
            d = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
            s = nl * np.sqrt(a2 + (1 - a2) * nv * nv) + nv * np.sqrt(a2 + (1 - a2) * nl * nl)
            return np.sqrt(nl * (np.exp(x[2]) + np.exp(x[3]) * 0.5 * d / s)) - roots

        for alpha in (0.08, 0.2, 0.45):
            start = [0.0, 0.0, np.log(kd), np.log(0.02 * kd), np.log(alpha)]
            least_squares(off, start, loss="cauchy", f_scale=0.05 * kd**0.5, ftol=1e-5)


# -- representations and pictures -----------------------------------------------------------------------------


def _representations(samples: Any, rounds: int) -> Iterator[dict[str, Any]]:
    """Bytes of half a million triangles on disk, and times of making values from them, over GGX's."""
    from coupole.reflectance.run_result import FIELDS
    from coupole.reflectance.slice_basis import COUNT, HARMONICS, RADIAL
    from coupole.reflectance.slice_fit import fit_slices, slice_values
    from coupole.reflectance.triangle_fit import fit_triangles, model_values

    leds, channels = samples.values.shape[1:]
    used = np.ones(leds, np.bool_)
    ggx = fit_triangles(samples, used, 30.0)
    harmonics, radial = (fit_slices(samples, used, (basis, None))[0] for basis in (HARMONICS, RADIAL))
    works: dict[str, Callable[[], Any]] = {
        "ggx_normal": lambda: model_values(samples, ggx),
        "sh": lambda: slice_values(samples, harmonics, HARMONICS),
        "rbf": lambda: slice_values(samples, radial, RADIAL),
    }
    for work in works.values():
        work()
    seconds = _medians(works, rounds)
    own = 4 * sum(3 if name == "normals" else channels if name in ("kd", "ks") else 1 for name in FIELDS)
    sizes = {"ggx_normal": own, "sh": 4 * channels * COUNT, "rbf": 4 * channels * COUNT}
    for name, size in sizes.items():
        megabytes = size * PAPER_TRIANGLES / 1e6
        yield _figure(f"bytes_{name}", megabytes, "MB", "paper", PAPER_BYTES[name] / 1e6 / megabytes)
    for name, taken_s in seconds.items():
        over = taken_s / seconds["ggx_normal"]
        ns = round(1e9 * taken_s / samples.values.size, 2)
        yield _figure(f"values_{name}_over_ggx", over, "1", "paper", PAPER_TIMES[name] / over, ns_per_value=ns)


def _relit(root: Path, folder: Path, samples: Any, rounds: int) -> Iterator[dict[str, Any]]:
    """A full-size picture under a new light, with shadows, from the materials of some triangles, repeated, in the
    memory of the one before; Mitsuba has one sample for each pixel, and its scene loaded. How long a picture takes
    in new memory is told too: the operating system may need most of that time to clear it."""
    from bench_measured_run import MESH
    from bench_render import FULL, mitsuba_frame, photographer
    from coupole.reflectance.material_uncertainty import MaterialUncertainty
    from coupole.reflectance.new_light.light_kinds import DistantLight
    from coupole.reflectance.run_relighting import scene_of_view
    from coupole.reflectance.run_result import ABOUT, SCHEMA
    from coupole.reflectance.run_result_files import write_materials
    from coupole.reflectance.triangle_fit import fit_triangles

    result = _result(folder)
    found = fit_triangles(samples, np.ones(samples.values.shape[1], np.bool_), 30.0)
    (folder / "fits").mkdir(exist_ok=True)
    whole = found.at(np.arange(len(result.triangles)) % _FITTED)
    count = len(result.triangles)
    certain = MaterialUncertainty(np.zeros((count, 5, 5)), *np.zeros((2, *whole.kd.shape)))
    nothing = np.zeros(count, np.float32)
    write_materials(result.materials_path("ggx_normal"), [whole], [certain], nothing, 0.0, result.triangles)
    about = {"schema": SCHEMA, "emission": "lambertian", "runs": {}, "mae": {}, "scan_noise_um": 30.0}
    (folder / ABOUT).write_text(json.dumps({**about, "simulated": True, "software": {"coupole": "bench"}}))
    by, _ = photographer(root, folder / MESH, FULL)
    mitsuba = mitsuba_frame(folder / MESH, by)
    ready = scene_of_view(result, fit="ggx_normal")
    directions = iter(np.random.default_rng(0).normal(0, 0.4, (100, 3)) + np.array([0, 0, 1]))

    def relit(into: Any = None) -> Any:
        return ready.picture([DistantLight(towards=tuple(next(directions)))], into=into)

    before = relit()
    works: dict[str, Callable[[], Any]] = {"ours": lambda: relit(before), "in_new_memory": relit}
    if mitsuba is not None:
        works["mitsuba"] = lambda: mitsuba(0)
    for work in works.values():
        work()
    seconds = _medians(works, rounds)
    first_s = _timed(lambda: scene_of_view(result, fit="ggx_normal"))
    more = {"triangles": len(result.triangles), "view_ready_s": round(first_s, 3)}
    more["in_new_memory_s"] = round(seconds["in_new_memory"], 3)
    tenth_s = seconds.get("mitsuba", float("nan")) / 10
    yield _figure("relit_frame_12mp", seconds["ours"], "s", "mitsuba_10_times", tenth_s / seconds["ours"], **more)
