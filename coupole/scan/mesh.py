"""A triangle mesh, and the checks that all readers share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.kernels import kernel
from coupole.scan.mesh_text import OK, TOO_FEW

CHUNK = 4_000_000
"""Number of records that are converted together."""
MOST_VERTICES = 2**31
"""Greatest number of vertices: an edge is stored as one 64-bit number (`coupole.scan.mesh_defects`)."""


@dataclass(frozen=True)
class Mesh:
    """Triangles over shared vertices, in the file's unit."""

    vertices: NDArray[np.float32]
    """[n, 3], finite."""
    triangles: NDArray[np.uint32]
    """[m, 3] for each triangle the rows of its corners in `vertices`."""


def expect_records(
    path: Path, record_name: str, count: int, read_count: int, wanted_count: int | None = None
) -> None:
    if read_count < (count if wanted_count is None else wanted_count):
        raise InputError(f"{path}: the file ends in {record_name} {read_count} of {count}: it was cut off")


def expect_room(path: Path, record_name: str, count: int, least_bytes: int, size_bytes: int) -> None:
    """Raise InputError if a file of this size cannot hold the stated number of records. This is checked before
    memory is allocated."""
    if count * least_bytes > size_bytes:
        raise InputError(
            f"{path}: expected {count} of {record_name}, as its header says, of {least_bytes} bytes or more each; "
            f"the file has {size_bytes} bytes: it was cut off, or its header is wrong"
        )


def expect_finite(path: Path, points: NDArray[np.float32], where: str) -> None:
    """Raise InputError if a coordinate is not finite; `where` is a format string for the number of the point."""
    bad = _first_not_finite(points.reshape(-1, 3))
    if bad >= 0:
        xyz = ", ".join(f"{value:g}" for value in points.reshape(-1, 3)[bad])
        raise InputError(f"{path}: {where.format(bad)}: expected finite coordinates, found {xyz}")


def expect_corners(path: Path, triangles: NDArray[np.uint32], vertices: int, first: int) -> None:
    bad = _first_beyond(triangles, vertices)
    if bad >= 0:
        worst = int(triangles[bad].max())
        raise InputError(
            f"{path}: face {first + bad}: corner {worst} does not exist; there are {vertices} vertices"
        )


@kernel
def _first_not_finite(points):  # type: ignore[no-untyped-def]
    for k in range(len(points)):
        if not np.isfinite(points[k, 0] + points[k, 1] + points[k, 2]):
            return k
    return -1


@kernel
def _first_beyond(triangles, vertices):  # type: ignore[no-untyped-def]
    for k in range(len(triangles)):
        if triangles[k, 0] >= vertices or triangles[k, 1] >= vertices or triangles[k, 2] >= vertices:
            return k
    return -1


def expect_text(path: Path, state: int, line: int, expected_text: str) -> None:
    if state == TOO_FEW:
        raise InputError(f"{path}:{line}: expected {expected_text}; the file ends here: it was cut off")
    if state != OK:
        raise InputError(f"{path}:{line}: expected {expected_text}")
