"""Unknowns of the refinement: one vector of steps from the records' values, with its covariance before the
pictures are used.

The vector holds, in this order: the lens's estimated parameters; six steps for each view's camera (mm along the
base's axes, rad about the camera's, as `rotations.moved`); six of the whole mesh (mm along the base's axes, rad
about axes through its middle); and the displacement of the surface along its normals at control points, mm.

Hand-eye and axis zeros move all cameras together: the covariance of the cameras' steps contains their covariance,
and the arm's own scatter in each view. The displacement is a Gaussian process over space: control points are
correlated by exp(-r^2 / 2 scale^2), and they predict the values between them (Rasmussen and Williams 2006, Eq.
2.25).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve

from coupole.calibration.optics import NAMES, Intrinsics
from coupole.calibration.rotations import moved_transforms, rotation
from coupole.errors import InputError
from coupole.geometry import farthest_first
from coupole.reflectance.extraction.pointing import Doubts

Floats = NDArray[np.float64]
MOST_CONTROLS = 600
_TOGETHER = 1 << 16
"""Number of vertices that are processed together."""
_NUGGET = 1e-6
"""Part of a control point's variance that is not correlated with other points. It keeps the covariance's inverse
exact.
"""


@dataclass(frozen=True)
class Given:
    """Geometry as records and scan state it."""

    lens: Intrinsics
    free: tuple[str, ...]
    base_from_camera: Floats
    """[views, 4, 4] mm."""
    camera_covariance: Floats
    """[free + 6 views, free + 6 views] covariance of the lens and the cameras' steps."""
    vertices_mm: Floats
    """[n, 3] vertices that triangles use, base frame."""
    triangles: NDArray[np.uint32]
    """[m, 3] triangles as `renumbered_triangles` gives them."""


@dataclass(frozen=True)
class Unknowns:
    """The vector of steps: its parts, its covariance before the pictures are used, and the geometry that follows
    from it."""

    prior_geometry: Given
    doubts: Doubts
    controls_mm: Floats
    """[controls, 3]"""

    @property
    def lens(self) -> slice:
        return slice(0, len(self.prior_geometry.free))

    def camera(self, view: int) -> slice:
        first = self.lens.stop + 6 * view
        return slice(first, first + 6)

    @property
    def mesh(self) -> slice:
        first = self.lens.stop + 6 * len(self.prior_geometry.base_from_camera)
        return slice(first, first + 6)

    @property
    def shape(self) -> slice:
        return slice(self.mesh.stop, self.mesh.stop + len(self.controls_mm))

    @property
    def count(self) -> int:
        return int(self.shape.stop)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns with their units, in the vector's order."""
        steps = ("x_mm", "y_mm", "z_mm", "rx_rad", "ry_rad", "rz_rad")
        views = range(len(self.prior_geometry.base_from_camera))
        return (
            *(name + "_px" * (name in NAMES[:4]) for name in self.prior_geometry.free),
            *(f"camera{view}.{step}" for view in views for step in steps),
            *(f"mesh.{step}" for step in steps),
            *(f"shape{control}_mm" for control in range(len(self.controls_mm))),
        )

    @cached_property
    def covariance(self) -> Floats:
        """[count, count] covariance from records and doubts."""
        mesh = self.doubts.mesh_covariance
        return np.asarray(block_diag(self.prior_geometry.camera_covariance, mesh, self._shape_covariance))

    @cached_property
    def middle_mm(self) -> Floats:
        """[3] point about which the mesh turns."""
        return np.asarray(self.prior_geometry.vertices_mm.mean(axis=0))

    def lens_at(self, steps: Floats) -> Intrinsics:
        values = {name: getattr(self.prior_geometry.lens, name) for name in self.prior_geometry.free}
        return replace(self.prior_geometry.lens, **{n: values[n] + float(steps[i]) for i, n in enumerate(values)})

    def cameras_at(self, steps: Floats) -> Floats:
        """[views, 4, 4] base_from_camera."""
        return moved_transforms(
            self.prior_geometry.base_from_camera, steps[self.lens.stop : self.mesh.start].reshape(-1, 6)
        )

    def vertices_at(self, steps: Floats) -> Floats:
        """[n, 3] base frame."""
        geometry, mesh = self.prior_geometry, steps[self.mesh]
        along = cho_solve(cho_factor(self._shape_covariance), steps[self.shape])
        vertices_mm = geometry.vertices_mm.copy()
        for first in range(0, len(vertices_mm), _TOGETHER):
            rows = slice(first, first + _TOGETHER)
            displaced_mm = self._kernel(geometry.vertices_mm[rows], self.controls_mm) @ along
            vertices_mm[rows] += displaced_mm[:, None] * self.normals[rows]
        turned_mm: Floats = (vertices_mm - self.middle_mm) @ rotation(mesh[3:]).T + self.middle_mm + mesh[:3]
        return turned_mm

    def by_surface(self, points_mm: Floats, normals: Floats) -> Floats:
        """[n, 6 + controls] movement of the surface along its normal at places, for each step of mesh and
        shape."""
        arms = np.cross(points_mm - self.middle_mm, normals)
        return np.concatenate([normals, arms, self.weights(points_mm)], axis=1)

    def weights(self, points_mm: Floats) -> Floats:
        """[n, controls] weights of the control points' displacements in the displacement of a place."""
        near = self._kernel(points_mm, self.controls_mm)
        weights: Floats = cho_solve(cho_factor(self._shape_covariance), near.T).T
        return weights

    @cached_property
    def normals(self) -> Floats:
        """[n, 3] normals of the given vertices, weighted by the areas of their triangles."""
        return vertex_normals(self.prior_geometry.vertices_mm, self.prior_geometry.triangles)

    @cached_property
    def _shape_covariance(self) -> Floats:
        variance_mm2 = self.doubts.shape_mm**2
        return self._kernel(self.controls_mm, self.controls_mm) + _NUGGET * variance_mm2 * np.eye(
            len(self.controls_mm)
        )

    def _kernel(self, one_mm: Floats, other_mm: Floats) -> Floats:
        square = np.sum(one_mm**2, axis=1)[:, None] + np.sum(other_mm**2, axis=1) - 2 * one_mm @ other_mm.T
        covariance_mm2: Floats = self.doubts.shape_mm**2 * np.exp(
            -np.maximum(square, 0.0) / (2 * self.doubts.scale_mm**2)
        )
        return covariance_mm2


def vertex_normals(vertices_mm: Floats, triangles: NDArray[np.uint32]) -> Floats:
    """[n, 3] unit normals of vertices: means of the triangles' normals, weighted by the triangles' areas."""
    corners = vertices_mm[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    corner_normals = np.repeat(across, 3, axis=0)
    count, corner = len(vertices_mm), triangles.reshape(-1)
    total = np.stack([np.bincount(corner, corner_normals[:, k], count) for k in range(3)], axis=1)
    result: Floats = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return result


def control_points(points_mm: Floats, spacing_mm: float) -> Floats:
    """Return some of the points [n, 3]. Each next point is the farthest from the points before it. The choice ends
    when all other points are within `spacing_mm` of a chosen one. Raises InputError if more than `MOST_CONTROLS`
    are needed."""
    middle = int(np.argmin(np.sum((points_mm - points_mm.mean(axis=0)) ** 2, axis=1)))
    indices: list[int] = []
    for index, far_mm in farthest_first(points_mm, middle):
        if far_mm <= spacing_mm:
            break
        if len(indices) == MOST_CONTROLS:
            raise InputError(
                f"--scale-mm: expected {np.ceil(far_mm):g} or more for an object of this size, "
                f"got {spacing_mm:g}; the surface is refined at {MOST_CONTROLS} points at most"
            )
        indices.append(index)
    return points_mm[indices]


def renumbered_triangles(triangles: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """[m, 3] corners of triangles, as places among the vertices that triangles use; these vertices keep their
    order."""
    in_use = np.zeros(int(triangles.max()) + 1, np.bool_)
    in_use[triangles] = True
    return (np.cumsum(in_use) - 1)[triangles].astype(np.uint32)


def welded_vertices(corners_mm: Floats, triangles: NDArray[np.uint32]) -> Floats:
    """[n, 3] vertices of the triangles of `renumbered_triangles`, from their corners [m, 3, 3]."""
    vertices = np.zeros((int(triangles.max()) + 1, 3))
    vertices[triangles] = corners_mm
    return vertices
