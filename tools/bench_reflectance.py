"""Speed and memory of reflectance: full-size frames to samples, fits of triangles, relit pictures.

The run is that of `bench_measured_run`. The peers are a read of the same bytes past the page cache, BLAS, SciPy,
Mitsuba, and the published figures of La Coupole (Lucat et al. 2025, 6.2 and 6.3: half a million triangles, ten
cores).
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
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from bench_measured_run import VIEW, Size, make_run, read_run
from reflectance_peers import scipy_ggx, scipy_harmonics, sgemm_products

FRAMES = 300
LIMIT_S, LIMIT_OVER_READ = 60.0, 1.5
PAPER_S = 150.0
"""Seconds of the paper: 100 to 200 s with ten cores."""
PAPER_BYTES = {"ggx_normal": 14e6, "sh": 600e6, "rbf": 600e6}
PAPER_TRIANGLES = 500_000
PAPER_TIMES = {"ggx_normal": 1.0, "sh": 2.0, "rbf": 6.0}
"""Times of making a picture, relative to that of GGX."""
_CHUNK = 16 << 20
FULL_RUN = Size()


@dataclass(frozen=True)
class Scope:
    """Scope of the measurement."""

    run: Size = FULL_RUN
    frames: int = FRAMES
    few_frames: int = 10
    """Frames of the run whose memory is compared with that of all frames."""
    fitted_count: int = 16_384
    """Number of fitted triangles."""
    by_scipy: int = 256


SMALLEST = Scope(Size((256, 192), 2_000), frames=40, few_frames=10, fitted_count=64, by_scipy=2)


def figures(
    root: Path, rounds: int, frames: int | None = None, *, smallest: bool = False
) -> Iterator[dict[str, Any]]:
    scope = SMALLEST if smallest else Scope()
    scope = replace(scope, frames=frames or scope.frames)
    with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as name:
        folder = Path(name)
        yield from _memory(root, folder, scope)
        yield from _extraction(folder, rounds)
        samples = _some_samples(folder, scope.fitted_count)
        yield from _fits(samples, rounds, scope.by_scipy)
        yield from _representations(samples, rounds)
        yield from _relit(root, folder, samples, rounds, scope.run.size_px)


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def _elapsed_s(work: Callable[[], Any]) -> float:
    started_s = time.perf_counter()
    work()
    return time.perf_counter() - started_s


def _medians(works: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Return the seconds of interleaved functions, each of which has been called before."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            times[name].append(_elapsed_s(work))
    return {name: statistics.median(seconds) for name, seconds in times.items()}


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


def _memory(root: Path, folder: Path, scope: Scope) -> Iterator[dict[str, Any]]:
    """Measure the peak memory of a process that extracts a run of few frames, and of one with many frames."""
    peaks = []
    for count in (scope.few_frames, scope.frames):
        shutil.rmtree(folder / "runs", ignore_errors=True)
        make_run(root, folder, count, scope.run)
        script = _ALONE.format(tools=str(root / "tools"), root=str(root), folder=str(folder))
        process = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
        peaks.append(json.loads(process.stdout) / 1e9)
    ratio = peaks[0] / peaks[1]
    yield _figure(
        "extraction_peak_memory", peaks[1], "GB", f"{scope.few_frames}_frames", ratio, frames=scope.frames
    )


def extract(folder: Path, say: Callable[[str, int, int], None]) -> dict[str, Any]:
    """Extract samples completely: visibility, shadows, samples, into a file."""
    from coupole.reflectance.extraction.extraction import extract_view, geometry_of

    measured_run, radiometry = read_run(folder)
    (folder / "samples").mkdir(exist_ok=True)
    path = folder / "samples" / f"{VIEW}.h5"
    path.unlink(missing_ok=True)
    return extract_view(measured_run, geometry_of(measured_run), radiometry, measured_run.views[0], path, say)[0]


def _extraction(folder: Path, rounds: int) -> Iterator[dict[str, Any]]:
    from coupole.reflectance.extraction.extraction import geometry_of, shadows_of, view_pass

    measured_run, radiometry = read_run(folder)
    path = measured_run.run.view_path(VIEW)
    geometry = geometry_of(measured_run)
    work, _ = view_pass(measured_run, geometry, radiometry, measured_run.views[0], _cores())
    count, frames = len(work.facets.centres_mm), len(measured_run.views[0].frames)
    codes_of = shadows_of(work, geometry)

    def all_reached(part: slice, _pool: Executor) -> NDArray[np.uint8]:
        return np.zeros((part.stop - part.start, count), np.uint8)

    def values() -> None:
        for _ in work.samples(all_reached, _cores()):
            pass

    def from_disk(work: Callable[[], object]) -> None:
        _forget(path)
        work()

    def shadows() -> None:
        with ThreadPoolExecutor(_cores()) as pool:
            for first in range(0, len(work.leds), work.together):
                codes_of(slice(first, min(first + work.together, len(work.leds))), pool)

    next(work.samples(all_reached, 1))  # numba compiles
    works: dict[str, Callable[[], Any]] = {
        "read": lambda: _read_direct(
            path, frames * measured_run.frames.size_px[0] * measured_run.frames.size_px[1] * 2
        ),
        "values": partial(from_disk, values),
        "seen": lambda: view_pass(measured_run, geometry, radiometry, measured_run.views[0], _cores()),
        "shadows": shadows,
        "whole": partial(from_disk, lambda: extract(folder, lambda step, done, of: None)),
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
    """Read this number of bytes of a file, past the page cache."""
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

    measured_run, _ = read_run(folder)
    write_object(folder / OBJECT, measured_run.corners_mm, measured_run.base_from_support)
    return RunResult(folder)


def _some_samples(folder: Path, count: int) -> Any:
    """Return samples of neighbouring triangles in the middle of the view."""
    result = _result(folder)
    view = result.views[0]
    first = len(view.triangles) // 2
    return result.view_samples(view, slice(first, first + count))


def _fits(samples: Any, rounds: int, by_scipy: int) -> Iterator[dict[str, Any]]:
    """Measure microseconds per triangle with all cores, for three channels."""
    from coupole.reflectance.slice_basis import HARMONICS, RADIAL
    from coupole.reflectance.slice_fit import fit_slices
    from coupole.reflectance.triangle_fit import fit_triangles

    count, leds, _ = samples.values.shape
    led_mask = np.ones(leds, np.bool_)
    samples_per_triangle = float(np.isfinite(samples.values).sum() / samples.values.shape[2] / count)
    works: dict[str, Callable[[], Any]] = {
        "sh": lambda: fit_slices(samples, led_mask, (HARMONICS, None)),
        "rbf": lambda: fit_slices(samples, led_mask, (RADIAL, None)),
        "ggx": lambda: fit_triangles(samples, led_mask, None),
        "ggx_normal": lambda: fit_triangles(samples, led_mask, 30.0),
        "sgemm": lambda: sgemm_products(round(samples_per_triangle), count, _cores()),
    }
    for work in works.values():
        work()
    times_us = {name: 1e6 * seconds / count for name, seconds in _medians(works, rounds).items()}
    few = samples.of_triangles(np.arange(0, count, count // by_scipy))
    scipy = {
        name: 1e6 * _elapsed_s(partial(fit, few)) / len(few.values) / _cores()
        for name, fit in (("sh", scipy_harmonics), ("ggx", scipy_ggx))
    }
    about = {"samples": round(samples_per_triangle), "triangles": count, "cores": _cores()}
    yield _figure(
        "sh_fit", times_us["sh"], "us", "half_ofsgemm_products", 2.0 * times_us["sgemm"] / times_us["sh"], **about
    )
    yield _figure("sh_fit", times_us["sh"], "us", "scipy_on_all_cores", scipy["sh"] / times_us["sh"], **about)
    yield _figure("rbf_fit", times_us["rbf"], "us", "twice_sh", 2.0 * times_us["sh"] / times_us["rbf"], **about)
    for name in ("ggx", "ggx_normal"):
        yield _figure(
            f"{name}_fit", times_us[name], "us", "scipy_on_all_cores", scipy["ggx"] / times_us[name], **about
        )


# -- representations and pictures -----------------------------------------------------------------------------


def _representations(samples: Any, rounds: int) -> Iterator[dict[str, Any]]:
    """Measure the bytes of half a million triangles on disk, and the times of computing values from them, relative
    to GGX."""
    from coupole.reflectance.run_result import FIELDS
    from coupole.reflectance.slice_basis import COUNT, HARMONICS, RADIAL
    from coupole.reflectance.slice_fit import fit_slices, slice_values
    from coupole.reflectance.triangle_fit import fit_triangles, model_values

    leds, channels = samples.values.shape[1:]
    led_mask = np.ones(leds, np.bool_)
    ggx = fit_triangles(samples, led_mask, 30.0)
    harmonics, radial = (fit_slices(samples, led_mask, (basis, None))[0] for basis in (HARMONICS, RADIAL))
    works: dict[str, Callable[[], Any]] = {
        "ggx_normal": lambda: model_values(samples, ggx),
        "sh": lambda: slice_values(samples, harmonics, HARMONICS),
        "rbf": lambda: slice_values(samples, radial, RADIAL),
    }
    for work in works.values():
        work()
    seconds = _medians(works, rounds)
    bytes_of_ggx = 4 * sum(3 if name == "normals" else channels if name in ("kd", "ks") else 1 for name in FIELDS)
    sizes = {"ggx_normal": bytes_of_ggx, "sh": 4 * channels * COUNT, "rbf": 4 * channels * COUNT}
    for name, size in sizes.items():
        megabytes = size * PAPER_TRIANGLES / 1e6
        yield _figure(f"bytes_{name}", megabytes, "MB", "paper", PAPER_BYTES[name] / 1e6 / megabytes)
    for name, taken_s in seconds.items():
        over = taken_s / seconds["ggx_normal"]
        ns = round(1e9 * taken_s / samples.values.size, 2)
        yield _figure(f"values_{name}_over_ggx", over, "1", "paper", PAPER_TIMES[name] / over, ns_per_value=ns)


def _relit(
    root: Path, folder: Path, samples: Any, rounds: int, size_px: tuple[int, int]
) -> Iterator[dict[str, Any]]:
    """Measure a full-size picture under a new light, with shadows, from the materials of some triangles, which are
    repeated.

    The picture is written into the memory of the one before. Mitsuba has one sample for each pixel, and its scene
    is loaded. The time for a picture in new memory is measured too, because the operating system may need most of
    it to clear that memory.
    """
    from bench_measured_run import MESH
    from bench_render import mitsuba_frame, photographer
    from coupole.reflectance.material_uncertainty import MaterialUncertainty
    from coupole.reflectance.new_light.light_kinds import DistantLight
    from coupole.reflectance.run_relighting import scene_of_view
    from coupole.reflectance.run_result import ABOUT, SCHEMA
    from coupole.reflectance.run_result_files import write_materials
    from coupole.reflectance.triangle_fit import fit_triangles

    result = _result(folder)
    materials = fit_triangles(samples, np.ones(samples.values.shape[1], np.bool_), 30.0)
    (folder / "fits").mkdir(exist_ok=True)
    whole = materials.at(np.arange(len(result.triangles)) % len(samples.values))
    count = len(result.triangles)
    certain = MaterialUncertainty(np.zeros((count, 5, 5)), *np.zeros((2, *whole.kd.shape)))
    nothing = np.zeros(count, np.float32)
    write_materials(result.materials_path("ggx_normal"), [whole], [certain], nothing, 0.0, result.triangles)
    about = {"schema": SCHEMA, "emission": "lambertian", "runs": {}, "mae": {}, "scan_noise_um": 30.0}
    (folder / ABOUT).write_text(json.dumps({**about, "simulated": True, "software": {"coupole": "bench"}}))
    by, _ = photographer(root, folder / MESH, size_px)
    mitsuba = mitsuba_frame(folder / MESH, by, size_px)
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
    first_s = _elapsed_s(lambda: scene_of_view(result, fit="ggx_normal"))
    more = {"triangles": len(result.triangles), "view_ready_s": round(first_s, 3)}
    more["in_new_memory_s"] = round(seconds["in_new_memory"], 3)
    tenth_s = seconds.get("mitsuba", float("nan")) / 10
    name = f"relit_frame_{1e-6 * size_px[0] * size_px[1]:.2g}mp"
    yield _figure(name, seconds["ours"], "s", "mitsuba_10_times", tenth_s / seconds["ours"], **more)
