"""Uncertainty of the places that a pixel looks at, from lens, camera and mesh with their covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from coupole.calibration import optics
from coupole.calibration.optics import Intrinsics
from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.rotations import moved_transforms, rotation, skew

Floats = NDArray[np.float64]

_SMALL = 1e-3
"""Step of a finite difference that approximates a derivative, as a share of the unknown's standard uncertainty."""
_POINTS = 100
"""Number of places on the object that represent all places of a view."""


@dataclass(frozen=True)
class Doubts:
    """Standard uncertainties that no record states."""

    arm_mm: float = 0.03
    """Standard uncertainty of the flange's position in each view, in each direction."""
    arm_deg: float = 0.003
    mesh_mm: float = 0.1
    """Standard uncertainty of the mesh's place in the base frame, in each direction."""
    mesh_deg: float = 0.02
    shape_mm: float = 0.03
    """Standard uncertainty of the surface along its normals; the error is about the same over `scale_mm`."""
    scale_mm: float = 20.0

    @property
    def mesh_covariance(self) -> Floats:
        """[6, 6] covariance of the mesh's steps, mm and rad."""
        return np.diag(np.repeat([self.mesh_mm**2, np.radians(self.mesh_deg) ** 2], 3))


STATED = Doubts()
"""Uncertainties that are used unless a user states others."""


def camera_covariance(prior: CameraPrior, base_from_camera: Floats, doubts: Doubts) -> Floats:
    """[free + 6 views, free + 6 views] covariance of lens and cameras' steps, from hand-eye, axis zeros and the
    arm's scatter."""
    lens, count = len(prior.free), len(base_from_camera)
    flange_from_camera = prior.flange_from_camera
    base_from_flange = base_from_camera @ np.linalg.inv(flange_from_camera)
    by_flange = np.zeros((count, 6, 6))
    by_flange[:, :3, :3] = np.eye(3)
    by_flange[:, :3, 3:] = -base_from_flange[:, :3, :3] @ skew(flange_from_camera[:3, 3])
    by_flange[:, 3:, 3:] = flange_from_camera[:3, :3].T
    by_hand_eye = np.zeros((count, 6, 6))
    by_hand_eye[:, :3, :3] = base_from_flange[:, :3, :3]
    by_hand_eye[:, 3:, 3:] = np.eye(3)
    by_record = np.concatenate([by_hand_eye, by_flange @ prior.by_axes(base_from_flange)], axis=2)
    propagation = block_diag(np.eye(lens), by_record.reshape(6 * count, -1))
    flange_covariance = np.diag(np.repeat([doubts.arm_mm**2, np.radians(doubts.arm_deg) ** 2], 3))
    scatter = block_diag(np.zeros((lens, lens)), *(by_flange @ flange_covariance @ np.swapaxes(by_flange, 1, 2)))
    result: Floats = propagation @ prior.covariance @ propagation.T + scatter
    return result


@dataclass(frozen=True)
class Pointing:
    """Uncertain steps of lens, camera and mesh in one view."""

    free: tuple[str, ...]
    """Parameters of the lens."""
    covariance: Floats
    """[free + 12, free + 12] covariance of the lens, the camera's steps and the mesh's steps, as in `unknowns`."""
    middle_mm: Floats
    """[3] point about which the mesh turns."""

    def u_lateral_mm(self, lens: Intrinsics, base_from_camera: Floats, points_mm: Floats) -> float:
        """Return the standard uncertainty of the places that pixels look at, in each direction across the line of
        sight. It is the root mean square over some of `points_mm` [n, 3], which the view sees."""
        points_mm = points_mm[:: max(1, len(points_mm) // _POINTS)]

        def pixels_after(steps: Floats) -> Floats:
            shift = steps[len(self.free) :]
            steps_of_lens = zip(self.free, steps, strict=False)
            bent_lens = replace(lens, **{name: getattr(lens, name) + float(step) for name, step in steps_of_lens})
            camera = moved_transforms(base_from_camera[None], shift[None, :6])[0]
            there = (points_mm - self.middle_mm) @ rotation(shift[9:]).T + self.middle_mm + shift[6:9]
            inside = (there - camera[:3, 3]) @ camera[:3, :3]
            pixels: Floats = optics.project(inside, bent_lens.vector()).pixels
            return pixels

        sizes = np.sqrt(np.diag(self.covariance))
        steps = _SMALL * np.diag(np.where(sizes > 0.0, sizes, 1.0))
        by_step = np.stack(
            [
                (pixels_after(deviation) - pixels_after(-deviation)) / (2.0 * deviation.max())
                for deviation in steps
            ],
            axis=-1,
        )
        in_pixels = np.einsum("nki,ij,nkj->n", by_step, self.covariance, by_step) / 2.0
        depth_mm = (points_mm - base_from_camera[:3, 3]) @ base_from_camera[:3, 2]
        return float(np.sqrt(np.mean(in_pixels * (depth_mm / lens.fx) ** 2)))


def pointings(prior: CameraPrior, base_from_camera: Floats, middle_mm: Floats) -> tuple[Pointing, ...]:
    """Return the pointings of the views of an object from poses [v, 4, 4], by a camera's records and the
    uncertainties that no record states. Each view is computed alone, so that even the last bit does not depend on
    the number of views."""
    view_pointings = []
    for view in range(len(base_from_camera)):
        alone, sensitivity = slice(view, view + 1), prior.axis_sensitivity
        view_prior = replace(prior, axis_sensitivity=None if sensitivity is None else sensitivity[alone])
        camera = camera_covariance(view_prior, base_from_camera[alone], STATED)
        covariance = block_diag(camera, STATED.mesh_covariance)
        view_pointings.append(Pointing(prior.free, covariance, middle_mm))
    return tuple(view_pointings)
