"""A scan in a file that may contain several scans, and its content."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.scan.mesh import Mesh


@dataclass(frozen=True)
class ScanSource:
    """File and place where a scan is stored."""

    path: Path
    name: str
    """Name of the file; from the second scan of a file on, with `#2` and so on."""
    number: int = 0
    """Number of the scan in its file."""
    at_byte: int = 0
    at_line: int = 1
    """Line where the scan's own header begins, for text files."""

    def __str__(self) -> str:
        return str(self.path) if self.number == 0 else f"{self.path}, scan {self.number + 1}"


@dataclass(frozen=True)
class ScanContent:
    """Points or a mesh of one scan, in the frame of its scanner."""

    mesh: Mesh
    """Mesh of the scan; without triangles if it is a cloud."""
    srgba: NDArray[np.uint8] | None = None
    """[n, 4] sRGB colours, 8 bits, and 255 for a point with a colour, 0 for a point without a colour; None if no
    point has a colour."""
    stated_pose: NDArray[np.float64] | None = None
    """4x4 transform of the scan to the frame that its file states; it is not proven."""
