"""A scan prepared for matching: thinned clouds with normals that face the scanner, their search trees, and the
scanner's picture."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.errors import InputError
from coupole.scan.mesh import Mesh
from coupole.scan.registration.extra import registration_libraries
from coupole.scan.registration.scan_content import ScanSource
from coupole.scan.registration.scan_files import read_scan
from coupole.scan.registration.viewpoint import DepthPicture, Floats, Stand, Viewpoint, folds

NEIGHBOURS = 12
"""Number of neighbours from which a point's normal is computed."""
PLACE_SPACINGS = 2.0
_SAMPLE, _MOST_PICTURED = 100_000, 120_000
_COARSEST_STEP = 0.05
"""Largest step of 32-bit coordinates, relative to the points' spacing."""


@dataclass(frozen=True)
class Cloud:
    """Points [n, 3] in mm in their scan's frame, one for each cell of a grid, with outward normals."""

    points_mm: Floats
    normals: Floats
    incidence: Floats
    """[n] cosine between normal and direction to the scanner; 1 if the viewpoint is not known."""
    pitch_mm: float
    """Pitch of the grid."""

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.points_mm)

    @cached_property
    def sphere(self) -> tuple[Floats, float]:
        """Middle [3] and radius of a sphere around all points, mm."""
        middle = (self.points_mm.min(axis=0) + self.points_mm.max(axis=0)) / 2
        return middle, float(np.linalg.norm(self.points_mm - middle, axis=1).max())

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without trees and the libraries' own clouds, which each process makes again."""
        return {name: self.__dict__[name] for name in ("points_mm", "normals", "incidence", "pitch_mm")}


@dataclass(frozen=True)
class Survey:
    """Facts about a scan that are needed before pitches and viewpoints are chosen for all scans."""

    count: int
    spacing_mm: float
    """Median distance of neighbouring points."""
    size_mm: float
    """Diagonal of the bounding box."""
    places: int
    """Number of occupied cells of a grid of `PLACE_SPACINGS` spacings."""
    folded_shares: dict[Stand, float]
    """Share of rays along which two surfaces lie, for each possible viewpoint of the scan."""


@dataclass(frozen=True)
class PreparedScan:
    """The parts of a scan that stay in memory; the whole scan is read again for merging."""

    source: ScanSource
    stated_pose: Floats | None
    """Pose that the scan's file states, 4x4 mm."""
    survey: Survey
    viewpoint: Viewpoint
    fine: Cloud
    coarse: Cloud
    picture: DepthPicture | None
    """None if the viewpoint is not known."""

    @property
    def name(self) -> str:
        return self.source.name


def survey(source: ScanSource, unit: str) -> Survey:
    """Read a scan to measure it. Raises InputError."""
    small_gicp, _ = registration_libraries()
    mesh = read_scan(source, unit).mesh
    spacing_mm = spacing(mesh.vertices)
    if spacing_mm == 0:
        raise InputError(f"{source}: all its points lie in one place")
    _expect_fine_steps(source, mesh, spacing_mm)
    normals, some = vertex_normals(mesh), _sample(len(mesh.vertices))
    places = len(small_gicp.voxelgrid_sampling(mesh.vertices.astype(float), PLACE_SPACINGS * spacing_mm).points())
    thinned_mm = spacing_mm * (len(mesh.vertices) / len(some)) ** 0.5
    fold_shares = folds(mesh.vertices[some].astype(float), None if normals is None else normals[some], thinned_mm)
    size_mm = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0).astype(np.float64)))
    return Survey(len(mesh.vertices), spacing_mm, size_mm, places, fold_shares)


def _expect_fine_steps(source: ScanSource, mesh: Mesh, spacing_mm: float) -> None:
    """Raise InputError if coordinates are too far from the origin for 32-bit numbers."""
    farthest_mm = np.abs(mesh.vertices).max()
    step_mm = float(np.spacing(farthest_mm))
    if step_mm > _COARSEST_STEP * spacing_mm:
        raise InputError(
            f"{source}: points are up to {farthest_mm / 1000:.0f} m from their origin, where 32-bit coordinates "
            f"have steps of {step_mm:.2g} mm, and {spacing_mm:.2g} mm apart: subtract the same vector from all "
            "scans"
        )


def _sample(count: int) -> NDArray[np.intp]:
    """Numbers of the points from which a scan's picture is drawn. They are random, because consecutive points make
    stripes."""
    if count <= _MOST_PICTURED:
        return np.arange(count)
    return np.random.default_rng(0).choice(count, _MOST_PICTURED, replace=False)


def prepare(
    source: ScanSource, unit: str, scan_survey: Survey, viewpoint: Viewpoint, fine_mm: float, coarse_mm: float
) -> PreparedScan:
    """Read a scan and thin it to two pitches. Raises InputError."""
    content = read_scan(source, unit)
    mesh = content.mesh
    fine = thinned_cloud(mesh.vertices.astype(np.float64), fine_mm, viewpoint, vertex_normals(mesh))
    coarse = thinned_cloud(fine.points_mm, coarse_mm, viewpoint, fine.normals)
    if len(coarse.points_mm) < 3 * NEIGHBOURS:
        raise InputError(f"{source}: its points lie in {len(coarse.points_mm)} places; expected a surface")
    picture = None
    if viewpoint.stand != "none":
        some = _sample(scan_survey.count)
        thinned_mm = scan_survey.spacing_mm * (scan_survey.count / len(some)) ** 0.5
        picture = DepthPicture(viewpoint, mesh.vertices[some].astype(np.float64), thinned_mm)
    return PreparedScan(source, content.stated_pose, scan_survey, viewpoint, fine, coarse, picture)


def thinned_cloud(points_mm: Floats, pitch_mm: float, viewpoint: Viewpoint, known_normals: Floats | None) -> Cloud:
    """Return the mean point of each cell, with normals that face the scanner, or that are on the side of
    `known_normals`."""
    small_gicp, _ = registration_libraries()
    middle = points_mm.mean(axis=0)
    thin = small_gicp.voxelgrid_sampling(points_mm - middle, pitch_mm)
    small_gicp.estimate_normals(thin, num_neighbors=min(NEIGHBOURS, len(thin.points())))
    points = np.ascontiguousarray(thin.points()[:, :3]) + middle
    normals = np.ascontiguousarray(thin.normals()[:, :3])
    if viewpoint.stand != "none":
        outward = viewpoint.towards(points)
    elif known_normals is not None:
        outward = known_normals[cKDTree(points_mm).query(points)[1]]
    else:
        return Cloud(points, normals, np.ones(len(points)), pitch_mm)
    incidence = np.sum(normals * outward, axis=1)
    normals *= np.where(incidence[:, None] < 0, -1.0, 1.0)
    known_stand = viewpoint.stand != "none"
    return Cloud(points, normals, np.abs(incidence) if known_stand else np.ones(len(points)), pitch_mm)


def spacing(points_mm: NDArray[np.float32]) -> float:
    """Return the median distance to the nearest other point, mm, from a compact part of the scan."""
    part = points_mm
    if len(points_mm) > _SAMPLE:
        at = points_mm[len(points_mm) // 2]
        away = np.abs(points_mm - at).max(axis=1)
        part = points_mm[away <= np.partition(away, _SAMPLE)[_SAMPLE]]
    distances: Floats = cKDTree(part).query(part[:: max(1, len(part) // 5000)], 2)[0][:, 1]
    positive = distances[distances > 0]
    return float(np.median(positive)) if len(positive) else 0.0


def vertex_normals(mesh: Mesh) -> Floats | None:
    """[n, 3] normals from the triangles, with length 1 or 0; None for a cloud without triangles."""
    vertices, triangles = mesh.vertices, mesh.triangles
    if not len(triangles):
        return None
    corners = vertices[triangles].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((len(vertices), 3))
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(triangles[:, corner], across[:, axis], len(vertices))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(lengths > 0, lengths, 1.0))
