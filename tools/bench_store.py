"""Speed of full-size frames to disk: the view writer against other writers, and the whole data path of a run.

All write the same frames, with the noise of a dim picture, to the same disk, and sync them. The whole data path is
a run as an operator would start it: world, camera, LED box, proof, journal; its camera sends pictures rendered
beforehand, at twice the frame rate of the real one.
"""

from __future__ import annotations

import importlib.util
import json
import mmap
import os
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

HEIGHT_PX, WIDTH_PX = 3072, 4096
FRAME_BYTES = HEIGHT_PX * WIDTH_PX * 2
FRAMES, DISTINCT = 48, 8
STREAM_FRAMES = 520
"""Frames of one burst; the view has two bursts, and its disk space is reused in the next round."""
STREAM_FRAMES_PER_S = 200
Writer = Callable[[Path, NDArray[np.uint16], int], None]
"""Writes n frames (the given ones in turn) into a folder, and syncs them."""


def figures(root: Path, rounds: int) -> Iterator[dict[str, Any]]:
    yield from writers(root, rounds)
    yield from stream(root, rounds)


def writers(root: Path, rounds: int) -> Iterator[dict[str, Any]]:
    """Frames per second and CPU time per frame of each writer, in turn."""
    known: dict[str, Writer] = {
        "coupole": _coupole,
        "coupole_packed12": partial(_coupole, packed=True),
        "o_direct_copy": _o_direct_copy,
        "h5py": _h5py,
        "zarr": _zarr,
        "acquire_zarr": _acquire_zarr,
        "tensorstore": _tensorstore,
        "tifffile": _tifffile,
    }
    for missing in [name for name in known if not _installed(name)]:
        print(f"{missing} is not installed and is left out", file=sys.stderr)
        del known[missing]
    seconds: dict[str, list[float]] = {name: [] for name in known}
    cpu_ms: dict[str, list[float]] = {name: [] for name in known}
    pixels = _pictures()
    for _ in range(rounds):
        for name, write in known.items():
            with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as folder:
                used_s, started_s = _cpu_s(), time.perf_counter()
                write(Path(folder), pixels, FRAMES)
                seconds[name].append(time.perf_counter() - started_s)
                cpu_ms[name].append(1e3 * (_cpu_s() - used_s) / FRAMES)
    ours_s, ours_ms = statistics.median(seconds["coupole"]), statistics.median(cpu_ms["coupole"])
    for name in list(known)[1:]:
        peer_s = statistics.median(seconds[name])
        yield {
            "name": "store_full_size",
            "value": FRAMES / ours_s,
            "unit": "frames/s",
            "peer": name,
            "ratio": peer_s / ours_s,
            "peer_value": round(FRAMES / peer_s, 2),
            "cpu_ms_per_frame": round(ours_ms, 2),
            "peer_cpu_ms_per_frame": round(statistics.median(cpu_ms[name]), 2),
        }


def _installed(name: str) -> bool:
    return name.startswith("coupole") or name == "o_direct_copy" or importlib.util.find_spec(name) is not None


def _pictures() -> NDArray[np.uint16]:
    """[DISTINCT, H, W] in page-aligned memory."""
    memory = mmap.mmap(-1, DISTINCT * FRAME_BYTES)
    pixels = np.frombuffer(memory, np.uint16).reshape(DISTINCT, HEIGHT_PX, WIDTH_PX)
    pixels[:] = np.random.default_rng(1).normal(700, 40, pixels.shape).astype(np.uint16)
    return pixels


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


# -- the writers ------------------------------------------------------------------------------------------


def _coupole(folder: Path, pixels: NDArray[np.uint16], frames: int, *, packed: bool = False) -> None:
    from coupole.devices import FrameFormat
    from coupole.storage.frame_file_creation import create
    from coupole.storage.view_writer import ViewWriter

    view = folder / "view.h5"
    metadata = {"title": "bench", "sample": "none", "simulated": True, "pixel_pitch_um": 5.5}
    create(view, frames, FrameFormat(HEIGHT_PX, WIDTH_PX, 12, "GBRG", 64, 4095), metadata, packed=packed)
    writer = ViewWriter(view, {})
    keep = partial(writer.put, camera_ns=0, exposure_us=8000)
    with ThreadPoolExecutor(3) as pool:  # as `coupole.acquisition.frame_grabber` does
        slots = [pool.submit(keep, pixels[k % len(pixels)], frame_id=k) for k in range(frames)]
        for k, slot in enumerate(slots):
            writer.prove(slot.result(), f"view/led{k:04d}/e0", led=k)
    writer.sync()
    writer.close()


def _o_direct_copy(folder: Path, pixels: NDArray[np.uint16], frames: int) -> None:
    fd = os.open(folder / "copy.raw", os.O_WRONLY | os.O_CREAT | os.O_DIRECT)
    os.posix_fallocate(fd, 0, frames * FRAME_BYTES)
    for k in range(frames):
        os.pwrite(fd, pixels[k % len(pixels)].data.cast("B"), k * FRAME_BYTES)
    os.fdatasync(fd)
    os.close(fd)


def _h5py(folder: Path, pixels: NDArray[np.uint16], frames: int) -> None:
    import h5py

    path = folder / "frames.h5"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("data", (frames, HEIGHT_PX, WIDTH_PX), np.uint16)
        for k in range(frames):
            data[k] = pixels[k % len(pixels)]
    _sync(path)


def _zarr(folder: Path, pixels: NDArray[np.uint16], frames: int) -> None:
    import zarr

    shape, chunks = (frames, HEIGHT_PX, WIDTH_PX), (1, HEIGHT_PX, WIDTH_PX)
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

    dimensions = [
        dimension("t", aqz.DimensionType.TIME, 0, 1),
        dimension("y", aqz.DimensionType.SPACE, HEIGHT_PX, HEIGHT_PX),
        dimension("x", aqz.DimensionType.SPACE, WIDTH_PX, WIDTH_PX),
    ]
    array = aqz.ArraySettings(dimensions=dimensions, data_type=aqz.DataType.UINT16)
    stream = aqz.ZarrStream(aqz.StreamSettings(store_path=str(folder / "a.zarr"), arrays=[array]))
    for k in range(frames):
        stream.append(pixels[k % len(pixels)])
    stream.close()
    os.sync()


def _tensorstore(folder: Path, pixels: NDArray[np.uint16], frames: int) -> None:
    import tensorstore

    shape, chunks = [frames, HEIGHT_PX, WIDTH_PX], [1, HEIGHT_PX, WIDTH_PX]
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


def stream(root: Path, rounds: int) -> Iterator[dict[str, Any]]:
    """Whole bursts of a run, from the first frame to the last proof, and a plain copy of as many bytes."""
    ours, peers, cpu_ms, lost, megabytes = [], [], [], 0, []
    pixels = _pictures()
    for _ in range(rounds):
        with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as folder:
            burst = _burst(root, Path(folder))
        ours.append(burst["frames_per_s"])
        cpu_ms.append(burst["cpu_ms_per_frame"])
        lost += burst["lost"]
        megabytes.append(burst["grown_mb"])
        with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as folder:
            started_s = time.perf_counter()
            _o_direct_copy(Path(folder), pixels, STREAM_FRAMES)
            peers.append(STREAM_FRAMES / (time.perf_counter() - started_s))
    value, peer = statistics.median(ours), statistics.median(peers)
    for name, limit in (("o_direct_copy", peer), ("camera_100_frames_per_s", 100.0)):
        yield {
            "name": "stream_full_size",
            "value": value,
            "unit": "frames/s",
            "peer": name,
            "ratio": value / limit,
            "peer_value": round(limit, 2),
            "frames": rounds * STREAM_FRAMES,
            "lost": lost,
            "cpu_ms_per_frame": round(statistics.median(cpu_ms), 2),
            "memory_grown_mb": round(max(megabytes), 1),
        }


def _burst(root: Path, folder: Path) -> dict[str, float]:
    """Figures of the second burst of a run; in the first one the camera's memory is filled with pictures."""
    from ruamel.yaml import YAML

    from coupole.acquisition.observer import Observer, Progress
    from coupole.acquisition.opened_cell import open_cell
    from coupole.acquisition.recorder import RunRecorder
    from coupole.acquisition.sequencer import Sequencer
    from coupole.acquisition.session import about_run, metadata_of_views
    from coupole.preflight.job import read_job
    from coupole.storage.run import Run

    rig = YAML(typ="safe").load(root / "configs/rigs/sim.yaml")
    rig["sensor"] = {
        "width_px": WIDTH_PX,
        "height_px": HEIGHT_PX,
        "pixel_pitch_um": 5.5,
        "max_frames_per_s": STREAM_FRAMES_PER_S,
    }
    rig["dome"]["leds"] = str(root / "configs/domes/coupole.csv")
    rig["led_limits"] |= {"cooldown_ratio": 0.0}
    rig["world"]["settings"] |= {"camera": {"render_once": True}}
    # The box's own clock sets the rate, so that a delay of the arm by a frame's rendering has no effect.
    rig["robot"]["settings"] = {"link_timeout_s": 30.0}
    (folder / "rig.yaml").write_text(json.dumps(rig))
    plan = {
        "schema_version": 1,
        "name": "stream",
        "rig": "rig.yaml",
        "views": [{"kind": "joints", "name": "here", "joints_deg": [0, -170, 150, 0, -70, 0]}],
        "lights": {"kind": "ids", "ids": list(range(STREAM_FRAMES))},
        "exposure": {"kind": "bracket", "exposures_us": [1000, 1001]},
    }
    (folder / "plan.yaml").write_text(json.dumps(plan))
    job = read_job(folder / "plan.yaml")
    burst_frames = len(job.schedule.bursts[0][0].labels)
    seen: list[tuple[float, int, float, float]] = []

    class Watch(Observer):
        def progress(self, progress: Progress) -> None:
            seen.append((time.perf_counter(), progress.proven, _cpu_s(), _resident_mb()))

    with open_cell(job.cell, job=job) as cell:
        run = Run.create(folder, "stream", job.inputs, about_run(job, cell))
        recorder = RunRecorder(run, metadata_of_views(job, cell))
        try:
            outcome = Sequencer(job, cell, recorder, observer=Watch()).acquire()
        finally:
            recorder.close()
    second = [row for row in seen if row[1] > burst_frames]
    (first_s, first, cpu_before_s, mb_before), (last_s, last, cpu_after_s, mb_after) = second[0], second[-1]
    return {
        "frames_per_s": (last - first) / (last_s - first_s),
        "cpu_ms_per_frame": 1e3 * (cpu_after_s - cpu_before_s) / (last - first),
        "lost": outcome.lost_transfers + outcome.reshot,
        "grown_mb": mb_after - mb_before,
    }


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * mmap.PAGESIZE / 1e6
