"""Time and memory for reading a scanner's mesh; the scan is replaced by a wavy sheet of many triangles."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

MILLIONS, MOST_MILLIONS = 10.0, 40.0
"""Numbers of triangles, in millions."""
SMALLEST_MILLIONS = 0.002
MOST_MEMORY_GB = 8.0
_FACE = np.dtype([("corners", "u1"), ("indices", "<i4", (3,))])


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    millions, most = (SMALLEST_MILLIONS, SMALLEST_MILLIONS) if smallest else (MILLIONS, MOST_MILLIONS)
    with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as folder:
        yield from _times(Path(folder) / "sheet.ply", millions, rounds)
        for ending in (".ply", ".stl"):
            yield _memory(Path(folder) / f"large{ending}", most)


def _times(path: Path, millions: float, rounds: int) -> Iterator[dict[str, Any]]:
    """Yield times of reading one file in several ways, interleaved; the file is then removed."""
    from coupole.scan.mesh_files import read_mesh
    from coupole.scan.scanner_export import read_scan

    vertices = _write_sheet(path, round(1e6 * millions))
    read_mesh(path)  # numba compiles
    works: dict[str, Callable[[], Any]] = {
        "coupole": lambda: read_mesh(path),
        "numpy": lambda: _plain_numpy(path, vertices),
        "trimesh": lambda: _trimesh(path),
        "with_checks": lambda: read_scan(path),
    }
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            started_s = time.perf_counter()
            work()
            seconds[name].append(time.perf_counter() - started_s)
    path.unlink()
    medians = {name: statistics.median(times) for name, times in seconds.items()}
    name = f"mesh_ply_{millions:g}m_triangles"
    for peer in ("numpy", "trimesh"):
        yield _figure(name, medians["coupole"], peer, medians[peer])
    yield _figure(f"{name}_with_all_checks", medians["with_checks"], "trimesh", medians["trimesh"])


def _memory(path: Path, millions: float) -> dict[str, Any]:
    """Return the memory of a process that reads a large file; the file is then removed."""
    (_write_sheet if path.suffix == ".ply" else _write_stl)(path, round(1e6 * millions))
    took_s, peak_gb = _in_a_process(path)
    path.unlink()
    return {
        "name": f"mesh{path.suffix.replace('.', '_')}_{millions:g}m_triangles_peak_memory",
        "value": peak_gb,
        "unit": "GB",
        "peer": "limit_8_gb",
        "ratio": MOST_MEMORY_GB / peak_gb,
        "seconds": round(took_s, 1),
    }


def _figure(name: str, ours_s: float, peer: str, peer_s: float) -> dict[str, Any]:
    ratio = peer_s / ours_s
    return {
        "name": name,
        "value": ours_s,
        "unit": "s",
        "peer": peer,
        "ratio": ratio,
        "peer_value": round(peer_s, 3),
    }


def _sheet(triangles: int) -> tuple[int, Any, Any]:
    """Return the number of vertices in a row, and functions of the first and the last row that return the vertices
    and the triangles of a strip."""
    side = int(np.sqrt(triangles / 2)) + 1

    def rows(first: int, last: int) -> Any:
        y, x = np.mgrid[first:last, 0:side].astype(np.float32) * np.float32(0.2)
        z = 5 * np.sin(x / 7) * np.cos(y / 11)
        return np.stack([x, y, z], axis=2).reshape(-1, 3).astype("<f4")

    def strip(first: int, last: int) -> Any:
        a = (np.arange(first, last)[:, None] * side + np.arange(side - 1)).reshape(-1)
        quads = np.stack([a, a + 1, a + side, a + 1, a + side + 1, a + side], axis=1)
        return quads.reshape(-1, 3).astype("<i4")

    return side, rows, strip


def _write_sheet(path: Path, triangles: int) -> int:
    side, rows, strip = _sheet(triangles)
    count = 2 * (side - 1) ** 2
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {side * side}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {count}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    with path.open("wb") as file:
        file.write(header.encode())
        for first in range(0, side, 200):
            rows(first, min(side, first + 200)).tofile(file)
        for first in range(0, side - 1, 200):
            indices = strip(first, min(side - 1, first + 200))
            faces = np.empty(len(indices), _FACE)
            faces["corners"], faces["indices"] = 3, indices
            faces.tofile(file)
    return side * side


def _write_stl(path: Path, triangles: int) -> None:
    side, rows, strip = _sheet(triangles)
    record = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    with path.open("wb") as file:
        file.write(b"VXelements".ljust(80) + (2 * (side - 1) ** 2).to_bytes(4, "little"))
        for first in range(0, side - 1, 200):
            last = min(side - 1, first + 200)
            some = np.zeros(2 * (side - 1) * (last - first), record)
            some["corners"] = rows(first, last + 1)[strip(first, last) - first * side]
            some.tofile(file)


def _plain_numpy(path: Path, vertices: int) -> Any:
    with path.open("rb") as file:
        while file.readline() != b"end_header\n":
            pass
        points = np.fromfile(file, "<f4", 3 * vertices).reshape(-1, 3)
        return points, np.ascontiguousarray(np.fromfile(file, _FACE)["indices"])


def _trimesh(path: Path) -> Any:
    import trimesh

    return trimesh.load(path, process=False)


def _in_a_process(path: Path) -> tuple[float, float]:
    """Return seconds and peak memory (GB) for reading and checking a scan, in a separate process."""
    code = (
        "import json, resource, sys, time; from pathlib import Path; "
        "from coupole.scan.scanner_export import read_scan; "
        "start = time.perf_counter(); read_scan(Path(sys.argv[1])); took = time.perf_counter() - start; "
        "peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss; print(json.dumps([took, peak * 1024 / 1e9]))"
    )
    process = subprocess.run(
        [sys.executable, "-c", code, str(path)], check=True, capture_output=True, text=True, env=os.environ
    )
    seconds, peak_gb = json.loads(process.stdout)
    return seconds, peak_gb
