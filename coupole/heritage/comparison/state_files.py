"""States of an object as files: a mesh or points, with or without colours of its vertices."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import ExtraMissing, InputError
from coupole.intake.plain_data import read_json
from coupole.scan.registration.prepared_scan import spacing, vertex_normals
from coupole.scan.registration.scan_files import read_scan, sources_of

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Colours:
    """Colours of a state's points, in CIELAB under D65."""

    lab: Floats
    """[n, 3] colours; NaN where a point has none."""
    covariance: Floats | None = None
    """[n, 3, 3] covariances of the points; None if they are not known. The covariance is then estimated from the
    scatter between points.
    """


@dataclass(frozen=True)
class State:
    """An object at some time."""

    name: str
    points_mm: Floats
    """[n, 3]"""
    triangles: NDArray[np.int64]
    """[m, 3] triangles; empty for a cloud of points."""
    outward: Floats | None
    """[n, 3] normals from the triangles."""
    colours: Colours | None
    spacing_mm: float
    is_upright: bool = False
    """True if z of its frame is known to point up."""

    @property
    def size_mm(self) -> float:
        """Diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.points_mm, axis=0)))


def read_state(path: Path, unit: str) -> State:
    """Read the file of a scan, with its colours. Raises InputError, ExtraMissing."""
    sources = sources_of([path])
    if len(sources) != 1:
        raise InputError(
            f"{path}: expected one state; the file holds {len(sources)} scans: register and merge them"
        )
    content = read_scan(sources[0], unit, colours=True)
    mesh, colours = content.mesh, None
    if content.srgba is not None:
        lab = np.where(content.srgba[:, 3:] > 0, lab_of(content.srgba[:, :3]), np.nan)
        colours = Colours(lab)
    spacing_mm = spacing(mesh.vertices)
    if spacing_mm == 0:
        raise InputError(f"{path}: all its points lie in one place")
    return State(
        path.name,
        mesh.vertices.astype(np.float64),
        mesh.triangles.astype(np.int64),
        vertex_normals(mesh),
        colours,
        spacing_mm,
        _is_on_site(path),
    )


def _is_on_site(path: Path) -> bool:
    """Tell, by the record beside the file, whether `coupole register` merged it in the frame of its control
    points."""
    record = path.with_name("registration.json")
    if not record.is_file():
        return False
    try:
        mesh = read_json(record)["mesh"]
        return path.name == "mesh.ply" and bool(mesh["frame"] == "site")
    except (InputError, KeyError, TypeError):
        return False


def lab_of(srgb: NDArray[np.uint8]) -> Floats:
    """[n, 3] CIELAB under D65, 2 degrees, of sRGB colours. Raises ExtraMissing."""
    return np.asarray(colour_library().rgb2lab(srgb[None].astype(np.float64) / 255.0)[0], np.float64)


def colour_library() -> Any:
    """Import `skimage.color`. Raises ExtraMissing."""
    try:
        from skimage import color
    except ImportError as error:
        raise ExtraMissing(
            f"comparing needs scikit-image: pip install 'coupole[registration]' ({error})"
        ) from error
    return color
