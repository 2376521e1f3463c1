"""Coupole's codecs against libraries: equality of output, and speed.

The data are one full-size 12-bit frame, on one core and, for the compression, on two threads at once. The Exif
reader gets the small DNG of the conformance tests. The libraries are those of the dependency group `bench`.
"""

from __future__ import annotations

import importlib.util
import statistics
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

FEWEST_ROUNDS = 9


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    """Yield figures. `same_output` is true if the peer's bytes or pixels equal Coupole's."""
    from bench_archive import SIZE_PX, SMALLEST_PX, pictures

    if missing := [name for name in ("imagecodecs", "exifread") if importlib.util.find_spec(name) is None]:
        sys.exit(f"bench codecs: {' and '.join(missing)} not installed; run it by `uv run --group bench`")
    rounds = rounds if smallest else max(rounds, FEWEST_ROUNDS)
    frame = pictures(1, SMALLEST_PX if smallest else SIZE_PX)[0]
    yield from _packing(frame, rounds)
    yield from _bitshuffle(frame, rounds)
    yield from _exif(root, rounds)


def _packing(frame: NDArray[np.uint16], rounds: int) -> Iterator[dict[str, Any]]:
    """Pack twelve bits per pixel into reused memory, and unpack them, in both orders."""
    import imagecodecs

    from coupole.storage.packing import pack12, unpack12

    orders: tuple[tuple[Literal["lsb", "msb"], str | None], ...] = (("lsb", "<"), ("msb", None))
    for order, bitorder in orders:
        packed_bytes, out = pack12(frame, order), np.empty(frame.size * 3 // 2, np.uint8)
        encode = partial(imagecodecs.packints_encode, frame.reshape(-1), 12, bitorder=bitorder, out=out)
        decode = partial(imagecodecs.packints_decode, packed_bytes, np.uint16, 12, bitorder=bitorder)
        encode_with_coupole = partial(pack12, frame, order, out=out.copy())
        same = bool(np.array_equal(np.frombuffer(encode(), np.uint8), packed_bytes))
        yield _figure(f"pack12_{order}", "imagecodecs", _medians_s(rounds, encode_with_coupole, encode), same)
        same = bool(np.array_equal(decode(), unpack12(packed_bytes, order)))
        yield _figure(
            f"unpack12_{order}",
            "imagecodecs",
            _medians_s(rounds, partial(unpack12, packed_bytes, order), decode),
            same,
        )


def _bitshuffle(frame: NDArray[np.uint16], rounds: int) -> Iterator[dict[str, Any]]:
    """Compress all tiles of a frame, by one thread and by two threads with a frame each."""
    from coupole.storage.bitshuffle import CODECS, compressed_tiles, tile_shape

    tile = tile_shape(*frame.shape)
    for name, codec in CODECS.items():

        def run_coupole(codec: Any = codec) -> list[bytes]:
            return [data for _, data in compressed_tiles(frame, tile, codec)]

        def run_peer(codec: Any = codec) -> list[bytes]:
            return [_imagecodecs_tile(part, codec) for part in _tiles(frame, tile)]

        same = run_coupole() == run_peer()
        for threads in (1, 2):
            times = _medians_s(
                rounds, partial(_at_once, run_coupole, threads), partial(_at_once, run_peer, threads)
            )
            yield _figure(f"bitshuffle_{name}_{threads}_threads", "imagecodecs", times, same)


def _tiles(frame: NDArray[np.uint16], tile: tuple[int, int]) -> Iterator[NDArray[np.uint16]]:
    rows, columns = tile
    for top in range(0, frame.shape[0], rows):
        for column in range(0, frame.shape[1], columns):
            yield np.ascontiguousarray(frame[top : top + rows, column : column + columns])


def _imagecodecs_tile(part: NDArray[np.uint16], codec: Any) -> bytes:
    """Compress by HDF5's filter 32008, composed of functions of imagecodecs, which has the shuffle but not the
    format."""
    import imagecodecs

    from coupole.storage.bitshuffle import BLOCK_PIXELS

    block_bytes = BLOCK_PIXELS * part.itemsize
    shuffled_bytes = memoryview(
        imagecodecs.bitshuffle_encode(part.tobytes(), itemsize=part.itemsize, blocksize=BLOCK_PIXELS)
    )
    pieces = [struct.pack(">QI", part.nbytes, block_bytes)]
    for start in range(0, part.nbytes, block_bytes):
        block = shuffled_bytes[start : start + block_bytes]
        small = (
            imagecodecs.lz4_encode(block)
            if codec.level is None
            else imagecodecs.zstd_encode(block, level=codec.level)
        )
        pieces += [struct.pack(">I", len(small)), small]
    return b"".join(pieces)


def _exif(root: Path, rounds: int) -> Iterator[dict[str, Any]]:
    """Read capture time and exposure of one file."""
    import exifread

    sys.path.insert(0, str(root / "tests/conformance"))
    from tiny_dng import write_dng

    from drivers.camera.raw.exif import read_exif

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "IMG_0001.DNG"
        write_dng(path, np.zeros((2, 2), np.uint16), taken="2026:03:04 05:06:07", subseconds="12")

        def run_peer() -> dict[str, Any]:
            with path.open("rb") as file:
                return dict(exifread.process_file(file, details=False))

        tags = run_peer()
        texts = (str(tags["EXIF DateTimeOriginal"]), str(tags["EXIF SubSecTimeOriginal"]))
        same = texts == ("2026:03:04 05:06:07", "12") and read_exif(path).taken_ns % 10**9 == 120_000_000
        yield _figure("read_exif", "exifread", _medians_s(10 * rounds, partial(read_exif, path), run_peer), same)


def _at_once(work: Callable[[], object], threads: int) -> None:
    running = [threading.Thread(target=work) for _ in range(threads)]
    for thread in running:
        thread.start()
    for thread in running:
        thread.join()


def _medians_s(
    rounds: int, run_coupole: Callable[[], object], run_peer: Callable[[], object]
) -> tuple[float, float]:
    """Return medians of interleaved rounds. The first round of each is left out, because numba compiles and memory
    is allocated then."""
    times: tuple[list[float], list[float]] = ([], [])
    for number in range(-1, rounds):
        for work, seconds in zip((run_coupole, run_peer), times, strict=True):
            start_s = time.perf_counter()
            work()
            if number >= 0:
                seconds.append(time.perf_counter() - start_s)
    return statistics.median(times[0]), statistics.median(times[1])


def _figure(name: str, peer: str, times_s: tuple[float, float], same: bool) -> dict[str, Any]:
    ours_s, theirs_s = times_s
    return {
        "name": name,
        "value": 1e3 * ours_s,
        "unit": "ms",
        "peer": peer,
        "ratio": theirs_s / ours_s,
        "peer_value": round(1e3 * theirs_s, 4),
        "same_output": same,
    }
