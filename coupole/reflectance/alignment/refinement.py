"""Adjustment of poses, lens and mesh that reduces the disagreement of views; records and scan limit the steps.

A match names a block of one view and the block of a second view that shows the same spot. By the geometry, the
spot lies where the first view's ray meets the surface. If the first camera takes a step a and the surface moves by
s along its normal n, that place moves by dP, with J dP = -(d block / d a) a and n dP = s, where J = d block / d
place of the first camera. Each match has its own variance. The adjustment estimates one factor on all these
variances; gross errors are rejected (`calibration.adjustment`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from coupole.calibration import optics
from coupole.calibration.adjustment import Adjusted, Block, Group, adjust
from coupole.calibration.rotations import skew
from coupole.errors import InputError
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.alignment.unknowns import Given, Unknowns, control_points
from coupole.reflectance.alignment.view_matches import Matches, match_views
from coupole.reflectance.alignment.view_surface import ViewSurface, view_surface
from coupole.reflectance.extraction.pointing import Doubts

Floats = NDArray[np.float64]
Said = Callable[[str, int, int], None]

ROUNDS = 4
SETTLED_MM = 0.005
"""The matches are not made again if the median disagreement changes by less than this from round to round."""
SEARCH_SHRINKS = 3.0
LEAST_SEARCH_MM = 0.3
"""Least width to which a search is narrowed."""
FEWEST_MATCHES = 30
MATCHES, STATED = "matches", "records and scan"
_GROUPS = (Group(MATCHES, is_estimated=True, rejects=2), Group(STATED, is_estimated=False))
_TOGETHER = 1 << 16
"""Number of vertices that are processed together."""


@dataclass(frozen=True)
class Refined:
    """Geometry that agrees with the pictures, its covariance, and the matches before and after."""

    unknowns: Unknowns
    steps: Floats
    """[count] steps from the values of records and scan."""
    covariance: Floats
    """[count, count]"""
    before: Matches
    after: Matches
    noise_factor: float
    """Scatter of the matches, as a multiple of the scatter that noise and texture alone would leave."""
    rejected_count: int
    """Number of matches that the last adjustment rejected."""

    @cached_property
    def uncertainties(self) -> Floats:
        """[count] standard uncertainties."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def chi2_of_steps(self) -> float:
        """Square of the steps, weighted by the inverse of the records' covariance. The value is near
        `determined_count` if records and scan state their uncertainties well.
        """
        return float(self.steps @ np.linalg.solve(self.unknowns.covariance, self.steps))

    def vertex_u_mm(self, vertex_numbers: NDArray[np.int64] | slice = slice(None)) -> Floats:
        """[n] standard uncertainty of vertices along their normals."""
        unknowns, surface = self.unknowns, slice(self.unknowns.mesh.start, self.unknowns.count)
        vertices = unknowns.prior_geometry.vertices_mm[vertex_numbers]
        normals, covariance = unknowns.normals[vertex_numbers], self.covariance[surface, surface]
        u_mm = np.empty(len(vertices))
        for first in range(0, len(vertices), _TOGETHER):
            rows = slice(first, first + _TOGETHER)
            by = unknowns.by_surface(vertices[rows], normals[rows])
            u_mm[rows] = np.sqrt(np.sum((by @ covariance) * by, axis=1))
        return u_mm

    @property
    def determined_count(self) -> float:
        """Number of unknowns that the pictures determine. Each unknown is counted with the share of its
        information that comes from the pictures.
        """
        return self.unknowns.count - float(np.trace(np.linalg.solve(self.unknowns.covariance, self.covariance)))


def refine(
    prior_geometry: Given,
    pictures: list[NDArray[np.float32]],
    doubts: Doubts,
    search_mm: float,
    threads: int,
    say: Said,
) -> Refined:
    """Match the views, adjust, and match again with the adjusted geometry, until the disagreement no longer falls.

    Raises InputError if the views have too little in common, or the object is too large for the field's scale.
    """
    unknowns = Unknowns(prior_geometry, doubts, control_points(prior_geometry.vertices_mm, doubts.scale_mm))
    steps = np.zeros(unknowns.count)
    matches = before = _find_matches(unknowns, steps, pictures, search_mm, threads, say)
    for number in range(ROUNDS):
        adjustment = _adjust(unknowns, steps, matches)
        say("rounds of refinement", number + 1, ROUNDS)
        apart_before_mm = float(np.median(matches.apart_mm))
        search_mm = min(search_mm, max(search_mm / SEARCH_SHRINKS, LEAST_SEARCH_MM))
        steps = adjustment.state
        matches = _find_matches(unknowns, steps, pictures, search_mm, threads, say)
        if number and apart_before_mm - float(np.median(matches.apart_mm)) < SETTLED_MM:
            break
    say("rounds of refinement", ROUNDS, ROUNDS)
    component = adjustment.components[0]
    return Refined(
        unknowns, steps, adjustment.covariance, before, matches, component.factor, component.rejected_count
    )


def surfaces_of(
    unknowns: Unknowns, steps: Floats, pictures: list[NDArray[np.float32]], threads: int
) -> list[ViewSurface]:
    """Return the surface that each view sees of the mesh, with the geometry after some steps."""
    corners = unknowns.vertices_at(steps)[unknowns.prior_geometry.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    mesh, lens = PacketMesh(corners), unknowns.lens_at(steps)
    cameras = unknowns.cameras_at(steps)
    return [
        view_surface(picture, mesh, normals, lens, camera, threads)
        for picture, camera in zip(pictures, cameras, strict=True)
    ]


def _find_matches(
    unknowns: Unknowns,
    steps: Floats,
    pictures: list[NDArray[np.float32]],
    search_mm: float,
    threads: int,
    say: Said,
) -> Matches:
    matches = match_views(surfaces_of(unknowns, steps, pictures, threads), search_mm, threads, say)
    if len(matches.blocks) < FEWEST_MATCHES:
        raise InputError(
            f"views are matched by the texture that they show: expected {FEWEST_MATCHES} matches or more, "
            f"found {len(matches.blocks)}. Do the views overlap, has the object texture, and is --search-mm as "
            "large as their disagreement?"
        )
    return matches


def _adjust(unknowns: Unknowns, steps: Floats, matches: Matches) -> Adjusted[Floats]:
    """Return all steps from the records' values, by matches that were made after `steps`."""
    lines = match_lines(unknowns, steps, matches)
    lower = np.linalg.cholesky(unknowns.covariance)
    inverse = solve_triangular(lower, np.eye(unknowns.count), lower=True)
    everything = np.arange(unknowns.count)

    def evaluate(state: Floats) -> list[Block]:
        blocks = [
            replace(block, residuals=block.residuals - block.jacobian @ (state - steps)[block.columns])
            for block in lines
        ]
        return [*blocks, Block(-inverse @ state, inverse, everything, 1)]

    return adjust(
        steps,
        evaluate,
        lambda state, change: state + change,
        _GROUPS,
        unknowns.count,
        calibration_name="the refinement of views",
    )


def match_lines(unknowns: Unknowns, steps: Floats, matches: Matches) -> list[Block]:
    """Return residuals and derivatives of the matches of each pair of views, whitened by their covariances."""
    views = range(len(unknowns.prior_geometry.base_from_camera))
    lens, cameras = unknowns.lens_at(steps), unknowns.cameras_at(steps)
    surface = np.arange(unknowns.mesh.start, unknowns.count)
    blocks = []
    for a, b in product(views, repeat=2):
        pair_matches = matches.some((matches.reference == a) & (matches.other == b))
        if not len(pair_matches.blocks):
            continue
        first = _sight_of_points(cameras[a], lens, unknowns, pair_matches.points_mm)
        second = _sight_of_points(cameras[b], lens, unknowns, pair_matches.points_mm)
        # [n, 3, 3]: rows of the first view's derivatives by the place, and the normal
        across = np.linalg.inv(np.concatenate([first.by_place, pair_matches.normals[:, None]], axis=1))
        along = across[:, :, 2:] @ unknowns.by_surface(pair_matches.points_mm, pair_matches.normals)[:, None]
        by_place = second.by_place
        second_by_first = -by_place @ across[:, :, :2]
        derivatives = np.concatenate(
            [
                second.by_lens + second_by_first @ first.by_lens,
                second_by_first @ first.by_camera,
                second.by_camera,
                by_place @ along,
            ],
            axis=2,
        )
        columns = np.concatenate(
            [np.r_[unknowns.lens], np.r_[unknowns.camera(a)], np.r_[unknowns.camera(b)], surface]
        )
        whitening = np.linalg.inv(np.linalg.cholesky(pair_matches.covariance))
        residuals = whitening @ (pair_matches.matched_blocks - pair_matches.expected_blocks)[..., None]
        blocks.append(
            Block(residuals.reshape(-1), (whitening @ derivatives).reshape(-1, len(columns)), columns, 0)
        )
    return blocks


@dataclass(frozen=True)
class _Seen:
    """Derivatives of the block at which a view sees places."""

    by_place: Floats
    """[n, 2, 3] per mm, base frame."""
    by_lens: Floats
    """[n, 2, free]"""
    by_camera: Floats
    """[n, 2, 6]"""


def _sight_of_points(camera: Floats, lens: optics.Intrinsics, unknowns: Unknowns, points_mm: Floats) -> _Seen:
    """Return the blocks of places and their derivatives; `lens` is in pixels, and a block is two pixels wide."""
    turn, place = camera[:3, :3], camera[:3, 3]
    inside = (points_mm - place) @ turn
    projection = optics.project(inside, lens.vector())
    by_point = projection.by_point / 2
    by_place = by_point @ turn.T
    free = [optics.NAMES.index(name) for name in unknowns.prior_geometry.free]
    by_camera = np.concatenate([-by_place, by_point @ skew(inside)], axis=2)
    return _Seen(by_place, projection.by_intrinsics[:, :, free] / 2, by_camera)
