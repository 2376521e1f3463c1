"""Camera and hand-eye from their records: the ray of a pixel at a reported pose, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coupole.calibration.earlier import read_earlier
from coupole.calibration.optics import Intrinsics
from coupole.calibration.record import Record, intrinsics_of, step_names
from coupole.calibration.rotations import Floats
from coupole.calibration.sources import About
from coupole.errors import InputError
from coupole.geometry import transform

HAND_EYE = "flange_from_camera"
MOST_APART = 5.0
"""Largest difference of two records of one lens, divided by its standard uncertainty."""


@dataclass(frozen=True)
class CameraPrior:
    """Lens and hand-eye with their common covariance."""

    lens: Intrinsics
    free: tuple[str, ...]
    """Parameters of the lens that were estimated."""
    flange_from_camera: Floats
    covariance: Floats
    """[free + 6 + k, free + 6 + k] covariance of the lens, then of the hand-eye's step (mm, rad), then of the
    zeros of k axes (deg)."""
    axis_sensitivity: Floats | None = None
    """[views, 6, k] step of the flange in its own frame (mm, rad) per degree of these axes, at each view; None: k
    is 0."""

    @property
    def hand_eye_covariance(self) -> Floats:
        """[6, 6] covariance, mm and rad."""
        hand_eye_part = slice(len(self.free), len(self.free) + 6)
        return self.covariance[hand_eye_part, hand_eye_part]

    def by_axes(self, base_from_flange: Floats) -> Floats:
        """Return [v, 6, k], the step of each pose [v, 4, 4] per degree of the axes, in the form of
        `rotations.moved_transforms`."""
        if self.axis_sensitivity is None:
            return np.zeros((len(base_from_flange), 6, 0))
        shift = base_from_flange[:, :3, :3] @ self.axis_sensitivity[:, :3]
        return np.concatenate([shift, self.axis_sensitivity[:, 3:]], axis=1)


def read_posed_camera(hand_eye: Path, camera: Path | None, about: About, size_px: tuple[int, int]) -> CameraPrior:
    """Read camera and hand-eye from a hand-eye record. It contains the lens of its own camera.

    `camera` may name that camera's record too, as a check. `about` and `size_px` describe the camera of the
    images. Raises InputError for a record of another kind, camera, focus, aperture or size, and for two records of
    different lenses.
    """
    record = read_earlier(hand_eye, "hand-eye", about, size_px)
    prior = _prior(record)
    if camera is not None:
        alone = read_earlier(camera, "camera", about, size_px)
        _refuse_other_lens(hand_eye, prior, camera, alone)
    return prior


def _prior(record: Record) -> CameraPrior:
    lens, free = intrinsics_of(record)
    names = [parameter.name for parameter in record.parameters]
    needed_names = [n for n in names if n.removesuffix("_px") in free] + list(step_names(HAND_EYE))
    at = [names.index(name) for name in needed_names]
    units = np.ones(len(at))
    units[-3:] = np.radians(1.0)
    covariance = record.covariance_matrix[np.ix_(at, at)] * np.outer(units, units)
    pose = record.transforms[HAND_EYE]
    return CameraPrior(lens, free, transform(pose.translation_mm, pose.abc_deg), covariance)


def _refuse_other_lens(hand_eye: Path, prior: CameraPrior, camera: Path, alone: Record) -> None:
    lens, free = intrinsics_of(alone)
    u = dict(zip(free, np.sqrt(np.diag(alone.covariance_matrix)), strict=True))
    for i, name in enumerate(prior.free):
        together = float(np.hypot(np.sqrt(prior.covariance[i, i]), u.get(name, 0.0)))
        apart = abs(getattr(lens, name) - getattr(prior.lens, name))
        if apart > MOST_APART * together:
            raise InputError(
                f"{camera} and {hand_eye} are of different lenses or focus: {name} differs by {apart:.4g}, "
                f"{apart / together:.0f} times its standard uncertainty. Calibrate one of them again"
            )
