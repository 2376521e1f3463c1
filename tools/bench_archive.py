"""Archiving a view: compression ratio, speed, and reading from the archive against reading from the file before.

The frames are full-size pictures of a dim object on a dark ground, with the shot and read noise of the simulated
sensor; eight different frames are repeated. Speed is measured on a view of 40 frames. Reading is measured on a
view of up to 1080 frames, as the disk allows; the file is first removed from the page cache.
"""

from __future__ import annotations

import mmap
import os
import resource
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

SIZE_PX, SMALLEST_PX = (4096, 3072), (512, 384)
"""Width and height of frames."""
FRAMES, FEW_FRAMES, DISTINCT = 1080, 40, 8
SMALLEST_FRAMES = 16
_DATA = "entry/instrument/detector/data"
TILE_PX, TILE_AT = 256, (1900 / 4096, 1100 / 3072)
"""A window of 256 x 256 that is not aligned with any tile; position of its first corner, as shares of width and
height."""


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    """Yield ratio, speed and two readings for each codec; peers are plain h5py, and the file before archiving."""
    import hdf5plugin  # noqa: F401  # registers the filter

    from coupole.storage.bitshuffle import CODECS

    originals = pictures(DISTINCT, SMALLEST_PX if smallest else SIZE_PX)
    few = SMALLEST_FRAMES if smallest else FEW_FRAMES
    most = SMALLEST_FRAMES if smallest else FRAMES
    frames = min(most, int(shutil.disk_usage(root).free * 0.4 / originals[0].nbytes))
    with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as folder:
        for name, codec in CODECS.items():
            yield from _speeds(Path(folder) / "small.h5", originals, few, name, codec, rounds)
        path, target_folder = Path(folder) / "view.h5", Path(folder) / "kept"
        proven = _write_view(path, originals, frames)
        for name, codec in CODECS.items():
            _archive(path, proven, codec, target_folder)
            for reading, reader in (("tile_through_all_frames", _read_tile), ("one_frame", _read_frame)):
                ours_s, before_s = _median_read_s(rounds, reader, path, target_folder / path.name)
                figure = _figure(f"archive_{name}_{reading}", ours_s, "s", "contiguous", before_s / ours_s)
                yield {**figure, "peer_value": round(before_s, 4), "frames": frames}
            (target_folder / path.name).replace(path)


def _speeds(
    path: Path, pictures: NDArray[np.uint16], frames: int, name: str, codec: Any, rounds: int
) -> Iterator[dict[str, Any]]:
    """Ratio and speed for a small view, repeated, interleaved with plain h5py."""
    proven, target_folder = _write_view(path, pictures, frames), path.parent / "kept_small"
    compress, read_back, plain, cpu_ms = [], [], [], []
    for _ in range(rounds):
        _forget(path)
        used_s = _cpu_s()
        archiving = _archive(path, proven, codec, target_folder)
        cpu_ms.append(1e3 * (_cpu_s() - used_s) / frames)
        compress.append(archiving.pixel_bytes / archiving.compress_s / 1e6)
        read_back.append(archiving.pixel_bytes / archiving.read_back_s / 1e6)
        (target_folder / path.name).replace(path)
        plain.append(_plain_h5py_mb_s(path.with_name("plain.h5"), path, codec))
    speed_mb_s, peer, cost_ms = statistics.median(compress), statistics.median(plain), statistics.median(cpu_ms)
    yield _figure(f"archive_{name}_ratio", archiving.ratio, "1", "uncompressed", archiving.ratio)
    yield {
        **_figure(f"archive_{name}_compress", speed_mb_s, "MB/s", "plain_h5py", speed_mb_s / peer),
        "peer_value": round(peer, 1),
        "both_passes_cpu_ms_per_frame": round(cost_ms, 1),
        "both_passes_mb_s_per_core": round(pictures[0].nbytes / cost_ms / 1e3, 1),
    }
    back = statistics.median(read_back)
    yield _figure(f"archive_{name}_read_back", back, "MB/s", "compress", back / speed_mb_s)


def _archive(path: Path, proven: list[Any], codec: Any, archive_folder: Path) -> Any:
    from coupole.storage.archive_view import archive_view

    return archive_view(path, proven, codec, lambda what, done, total: None, keep_in=archive_folder)


def _figure(name: str, value: float, unit: str, peer: str, ratio: float, **more: Any) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "peer": peer, "ratio": ratio, **more}


def _cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def pictures(count: int, size_px: tuple[int, int] = SIZE_PX) -> NDArray[np.uint16]:
    """Frames [count, H, W] in page-aligned memory: photons and 13 electrons of read noise at 3.35 electrons per
    DN, 64 DN black. The light comes from a different side in each. Smaller frames show the object smaller."""
    width_px, height_px = size_px
    memory = mmap.mmap(-1, count * width_px * height_px * 2)
    images = np.frombuffer(memory, np.uint16).reshape(count, height_px, width_px)
    y, x = np.mgrid[:height_px, :width_px].astype(np.float32)
    scale = width_px / SIZE_PX[0]
    object_here = np.hypot(x - width_px / 2, y - height_px / 2) < 1300 * scale
    relief = (0.6 + 0.4 * np.sin(x / 37) * np.sin(y / 53)) * object_here
    relief[::2, ::2] *= 0.8
    relief[1::2, ::2] *= 0.6
    random = np.random.default_rng(1)
    for number, picture in enumerate(images):
        angle = 2 * np.pi * number / count
        away = np.hypot(x - width_px * (0.5 + 0.2 * np.cos(angle)), y - height_px * (0.5 + 0.2 * np.sin(angle)))
        electrons = 3.35 * 700 * relief * np.exp(-0.5 * (away / (900 * scale)) ** 2)
        noise = random.standard_normal((height_px, width_px), np.float32) * np.sqrt(electrons + 13**2)
        picture[:] = np.clip(np.rint((electrons + noise) / 3.35 + 64), 0, 4095)
    return images


def _write_view(path: Path, pictures: NDArray[np.uint16], frames: int) -> list[Any]:
    """Write a view whose frames are all proven; returns the corresponding entries of its journal."""
    from coupole.devices import FrameFormat
    from coupole.plan.shot_id import ShotId
    from coupole.storage.frame_file_creation import create
    from coupole.storage.journal_events import FrameProven
    from coupole.storage.view_writer import ViewWriter

    metadata = {"title": "bench", "sample": "none", "simulated": True, "pixel_pitch_um": 5.5}
    height_px, width_px = pictures.shape[1:]
    create(path, frames, FrameFormat(height_px, width_px, 12, "GBRG", 64, 4095), metadata)
    writer = ViewWriter(path, {})
    proven: list[FrameProven] = []
    for number in range(frames):
        slot = writer.store(pictures[number % DISTINCT], frame_id=number, camera_ns=0, exposure_us=8000)
        shot = ShotId.parse(f"view/led{number:04d}/e0")
        xxh3 = f"{writer.prove(slot, str(shot), led=number):016x}"
        proven.append(FrameProven(shot=shot, file=path.name, index=slot, frame_id=number, xxh3=xxh3))
    writer.sync()
    writer.close()
    return proven


def _plain_h5py_mb_s(path: Path, before: Path, codec: Any) -> float:
    """Return the speed of plain h5py. Each frame is read and assigned to a dataset with the same chunks and
    filter; then the file is synced, without a comparison."""
    from coupole.storage.bitshuffle import tile_shape

    _forget(before)
    start_s = time.perf_counter()
    with h5py.File(before) as source, h5py.File(path, "w") as file:
        pixels = source[_DATA]
        chunks = (1, *tile_shape(*pixels.shape[1:]))
        data = file.create_dataset("d", pixels.shape, np.uint16, chunks=chunks, **codec.filter)
        for number in range(len(pixels)):
            data[number] = pixels[number]
        size_bytes = pixels.size * pixels.dtype.itemsize
    with path.open("r+b") as raw_file:
        os.fsync(raw_file.fileno())
    return float(size_bytes / (time.perf_counter() - start_s) / 1e6)


def _forget(path: Path) -> None:
    """Remove a file from the page cache."""
    with path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _median_read_s(
    rounds: int, read_dataset: Callable[[h5py.Dataset], None], archive_path: Path, before: Path
) -> tuple[float, float]:
    """Median seconds for reading from either file."""
    times: dict[Path, list[float]] = {archive_path: [], before: []}
    for _ in range(rounds):
        for path, times_s in times.items():
            _forget(path)
            with h5py.File(path) as file:
                start_s = time.perf_counter()
                read_dataset(file[_DATA])
                times_s.append(time.perf_counter() - start_s)
    return statistics.median(times[archive_path]), statistics.median(times[before])


def _read_tile(data: h5py.Dataset) -> None:
    first_column, top = (round(share * size_px) for share, size_px in zip(TILE_AT, data.shape[:0:-1], strict=True))
    for number in range(len(data)):
        data[number, top : top + TILE_PX, first_column : first_column + TILE_PX]


def _read_frame(data: h5py.Dataset) -> None:
    data[len(data) // 2]
