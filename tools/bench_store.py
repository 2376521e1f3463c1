"""Speed of full-size frames to disk: the view writer against other writers, and the whole data path of a run.

All writers write the same frames, with the noise of a dim picture, to the same disk, and sync them. The whole data
path is a run as an operator would start it: world, camera, LED box, proof, journal. Its camera sends pictures that
were rendered before, at twice the frame rate of the real camera.
"""

from __future__ import annotations

import importlib.util
import json
import math
import mmap
import os
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

STREAM_FRAMES_PER_S = 200
Writer = Callable[[Path, NDArray[np.uint16], int], None]
"""Function that writes n frames (the given ones in turn) into a folder, and syncs them."""


@dataclass(frozen=True)
class Size:
    """Size of the written data."""

    height_px: int = 3072
    width_px: int = 4096
    frames: int = 240
    """Frames of each writer. A view has 1080 and more; with a few dozen, the 20 ms in which a file is made and
    closed would count as if each view had them twenty times."""
    distinct: int = 8
    """Number of different frames, which are written in turn."""
    stream_frames: int = 520
    """Number of frames of one burst. The view has two bursts; its disk space is reused in the next round."""


SMALLEST = Size(height_px=192, width_px=256, frames=4, distinct=2, stream_frames=20)


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    size = SMALLEST if smallest else Size()
    yield from writers(root, rounds, size)
    yield from stream(root, rounds, size)


def writers(root: Path, rounds: int, size: Size) -> Iterator[dict[str, Any]]:
    """Frames per second and CPU time per frame of each writer, in turn."""
    writer_of_name: dict[str, Writer] = {
        "coupole": _coupole,
        "coupole_packed12": partial(_coupole, is_packed=True),
        "o_direct_copy": _o_direct_copy,
        "h5py": _h5py,
        "zarr": _zarr,
        "acquire_zarr": _acquire_zarr,
        "tensorstore": _tensorstore,
        "tifffile": _tifffile,
    }
    for missing in [name for name in writer_of_name if not _is_installed(name)]:
        print(f"{missing} is not installed and is left out", file=sys.stderr)
        del writer_of_name[missing]
    seconds: dict[str, list[float]] = {name: [] for name in writer_of_name}
    cpu_ms: dict[str, list[float]] = {name: [] for name in writer_of_name}
    pixels = _pictures(size)
    for write in writer_of_name.values():  # libraries are imported and functions compiled before the clock runs
        with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as folder:
            write(Path(folder), pixels, 2)
    for _ in range(rounds):
        for name, write in writer_of_name.items():
            with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as folder:
                used_s, started_s = _cpu_s(), time.perf_counter()
                write(Path(folder), pixels, size.frames)
                seconds[name].append(time.perf_counter() - started_s)
                cpu_ms[name].append(1e3 * (_cpu_s() - used_s) / size.frames)
    ours_s, ours_ms = statistics.median(seconds["coupole"]), statistics.median(cpu_ms["coupole"])
    for name in list(writer_of_name)[1:]:
        peer_s = statistics.median(seconds[name])
        yield {
            "name": "store_full_size",
            "value": size.frames / ours_s,
            "unit": "frames/s",
            "peer": name,
            "ratio": peer_s / ours_s,
            "peer_value": round(size.frames / peer_s, 2),
            "frame_px": [size.width_px, size.height_px],
            "cpu_ms_per_frame": round(ours_ms, 2),
            "peer_cpu_ms_per_frame": round(statistics.median(cpu_ms[name]), 2),
        }


def _is_installed(name: str) -> bool:
    return name.startswith("coupole") or name == "o_direct_copy" or importlib.util.find_spec(name) is not None


def _pictures(size: Size) -> NDArray[np.uint16]:
    """[distinct, H, W] in page-aligned memory."""
    shape = (size.distinct, size.height_px, size.width_px)
    pixels = np.frombuffer(mmap.mmap(-1, 2 * math.prod(shape)), np.uint16).reshape(shape)
    pixels[:] = np.random.default_rng(1).normal(700, 40, pixels.shape).astype(np.uint16)
    return pixels


def _cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


# -- the writers ------------------------------------------------------------------------------------------


def _coupole(folder: Path, pixels: NDArray[np.uint16], frames: int, *, is_packed: bool = False) -> None:
    from coupole.devices import FrameFormat
    from coupole.storage.frame_file_creation import create
    from coupole.storage.view_writer import ViewWriter

    view = folder / "view.h5"
    metadata = {"title": "bench", "sample": "none", "simulated": True, "pixel_pitch_um": 5.5}
    height_px, width_px = pixels.shape[1:]
    create(view, frames, FrameFormat(height_px, width_px, 12, "GBRG", 64, 4095), metadata, is_packed=is_packed)
    writer = ViewWriter(view, {})
    keep = partial(writer.store, camera_ns=0, exposure_us=8000)
    with ThreadPoolExecutor(3) as pool:  # like `coupole.acquisition.frame_grabber`
        slots = [pool.submit(keep, pixels[k % len(pixels)], frame_id=k) for k in range(frames)]
        for k, slot in enumerate(slots):
            writer.prove(slot.result(), f"view/led{k:04d}/e0", led=k)
    writer.sync()
    writer.close()


def _o_direct_copy(folder: Path, pixels: NDArray[np.uint16], frames: int) -> None:
    fd = os.open(folder / "copy.raw", os.O_WRONLY | os.O_CREAT | os.O_DIRECT)
    frame_bytes = pixels[0].nbytes
    os.posix_fallocate(fd, 0, frames * frame_bytes)
    for k in range(frames):
        os.pwrite(fd, pixels[k % len(pixels)].data.cast("B"), k * frame_bytes)
    os.fdatasync(fd)
    os.close(fd)


def _h5py(folder: Path, pixels: NDArray[np.uint16], frames: int) -> None:
    import h5py

    path = folder / "frames.h5"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("data", (frames, *pixels.shape[1:]), np.uint16)
        for k in range(frames):
            data[k] = pixels[k % len(pixels)]
    _sync(path)


def _zarr(folder: Path, pixels: NDArray[np.uint16], frames: int) -> None:
    import zarr

    shape, chunks = (frames, *pixels.shape[1:]), (1, *pixels.shape[1:])
    data = zarr.create_array(folder / "a.zarr", shape=shape, chunks=chunks, dtype="uint16", compressors=None)
    for k in range(frames):
        data[k] = pixels[k % len(pixels)]
    os.sync()


def _acquire_zarr(folder: Path, pixels: NDArray[np.uint16], frames: int) -> None:
    import acquire_zarr as aqz

    def dimension(name: str, kind: Any, size_px: int, chunk_px: int) -> Any:
        return aqz.Dimension(
            name=name, kind=kind, array_size_px=size_px, chunk_size_px=chunk_px, shard_size_chunks=1
        )

    _, height_px, width_px = pixels.shape
    dimensions = [
        dimension("t", aqz.DimensionType.TIME, 0, 1),
        dimension("y", aqz.DimensionType.SPACE, height_px, height_px),
        dimension("x", aqz.DimensionType.SPACE, width_px, width_px),
    ]
    array = aqz.ArraySettings(dimensions=dimensions, data_type=aqz.DataType.UINT16)
    stream = aqz.ZarrStream(aqz.StreamSettings(store_path=str(folder / "a.zarr"), arrays=[array]))
    for k in range(frames):
        stream.append(pixels[k % len(pixels)])
    stream.close()
    os.sync()


def _tensorstore(folder: Path, pixels: NDArray[np.uint16], frames: int) -> None:
    import tensorstore

    shape, chunks = [frames, *pixels.shape[1:]], [1, *pixels.shape[1:]]
    spec = {
        "driver": "zarr3",
        "kvstore": {"driver": "file", "path": str(folder / "a.zarr")},
        "metadata": {
            "shape": shape,
            "data_type": "uint16",
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunks}},
            "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}],
        },
    }
    data = tensorstore.open(spec, create=True).result()
    pending: list[Any] = []
    for k in range(frames):
        pending.append(data[k].write(pixels[k % len(pixels)]))
        if len(pending) > 2:
            pending.pop(0).result()
    for write in pending:
        write.result()


def _tifffile(folder: Path, pixels: NDArray[np.uint16], frames: int) -> None:
    import tifffile

    path = folder / "frames.tif"
    with tifffile.TiffWriter(path, bigtiff=True) as writer:
        for k in range(frames):
            writer.write(pixels[k % len(pixels)], contiguous=True)
    _sync(path)


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    os.fsync(fd)
    os.close(fd)


# -- the stream -------------------------------------------------------------------------------------------


def stream(root: Path, rounds: int, size: Size) -> Iterator[dict[str, Any]]:
    """Measure whole bursts of a run, from the first frame to the last proof, and a plain copy of the same number
    of bytes."""
    bursts: list[Burst] = []
    peers: list[float] = []
    pixels = _pictures(size)
    for _ in range(rounds):
        with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as folder:
            bursts.append(_burst(root, Path(folder), size))
        with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as folder:
            started_s = time.perf_counter()
            _o_direct_copy(Path(folder), pixels, size.stream_frames)
            peers.append(size.stream_frames / (time.perf_counter() - started_s))
    value, peer = statistics.median(burst.frames_per_s for burst in bursts), statistics.median(peers)
    for name, limit in (("o_direct_copy", peer), ("camera_100_frames_per_s", 100.0)):
        yield {
            "name": "stream_full_size",
            "value": value,
            "unit": "frames/s",
            "peer": name,
            "ratio": value / limit,
            "peer_value": round(limit, 2),
            "frames": rounds * size.stream_frames,
            "frame_px": [size.width_px, size.height_px],
            "lost": sum(burst.lost_count for burst in bursts),
            "cpu_ms_per_frame": round(statistics.median(burst.cpu_ms_per_frame for burst in bursts), 2),
            "memory_grown_mb": round(max(burst.grown_mb for burst in bursts), 1),
        }


@dataclass(frozen=True)
class Burst:
    """Figures of a burst."""

    frames_per_s: float
    cpu_ms_per_frame: float
    lost_count: int
    """Number of lost frames, or of shots that were taken again."""
    grown_mb: float
    """Growth of the process's memory, MB."""


def _burst(root: Path, folder: Path, size: Size) -> Burst:
    """Return the figures of the second burst of a run. In the first burst, the camera's memory is filled with
    pictures."""
    from ruamel.yaml import YAML

    from coupole.acquisition.observer import Unwatched
    from coupole.acquisition.opened_cell import open_cell
    from coupole.acquisition.recorder import RunRecorder
    from coupole.acquisition.run_description import about_run, metadata_of_views
    from coupole.acquisition.sequencer import Sequencer
    from coupole.preflight.job import read_job
    from coupole.storage.run import Run
    from coupole.viewing.progress import Progress

    rig = YAML(typ="safe", pure=True).load(root / "configs/rigs/sim.yaml")
    rig["sensor"] = {
        "width_px": size.width_px,
        "height_px": size.height_px,
        "pixel_pitch_um": 22528.0 / size.width_px,
        "max_frames_per_s": STREAM_FRAMES_PER_S,
    }
    rig["dome"]["leds"] = str(root / "configs/domes/coupole.csv")
    rig["led_limits"] |= {"cooldown_ratio": 0.0}
    rig["world"]["settings"] |= {"camera": {"render_once": True}}
    # The box's own clock sets the rate, so a delay of the arm by the rendering of a frame has no effect.
    rig["robot"]["settings"] = {"link_timeout_s": 30.0}
    (folder / "rig.yaml").write_text(json.dumps(rig))
    plan = {
        "schema_version": 1,
        "name": "stream",
        "rig": "rig.yaml",
        "views": [{"kind": "joints", "name": "here", "joints_deg": [0, -170, 150, 0, -70, 0]}],
        "lights": {"kind": "ids", "ids": list(range(size.stream_frames))},
        "exposure": {"kind": "bracket", "exposures_us": [1000, 1001]},
    }
    (folder / "plan.yaml").write_text(json.dumps(plan))
    job = read_job(folder / "plan.yaml")
    burst_frames = len(job.schedule.bursts[0][0].labels)
    readings: list[tuple[float, int, float, float]] = []

    class Watch(Unwatched):
        def progress(self, progress: Progress) -> None:
            readings.append((time.perf_counter(), progress.proven, _cpu_s(), _resident_mb()))

    with open_cell(job.cell, job=job) as cell:
        run = Run.create(folder, "stream", job.inputs, about_run(job, cell))
        recorder = RunRecorder(run, metadata_of_views(job, cell))
        try:
            outcome = Sequencer(job, cell, recorder, observer=Watch()).acquire()
        finally:
            recorder.close()
    second = [row for row in readings if row[1] > burst_frames]
    (first_s, first, cpu_before_s, mb_before), (last_s, last, cpu_after_s, mb_after) = second[0], second[-1]
    return Burst(
        frames_per_s=(last - first) / (last_s - first_s),
        cpu_ms_per_frame=1e3 * (cpu_after_s - cpu_before_s) / (last - first),
        lost_count=outcome.lost_transfers + outcome.reshot,
        grown_mb=mb_after - mb_before,
    )


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * mmap.PAGESIZE / 1e6
