"""Robot poses from a file, and the conventions that their numbers may follow.

::

    schema_version: 1
    length_unit: m                  # mm or m
    angle_unit: rad                 # deg or rad
    rotation: rotation_vector       # abc (KUKA: Rz Ry Rx), xyz (Rx Ry Rz), rotation_vector, quaternion_wxyz
    gives: base_from_flange         # or flange_from_base
    poses:
      1.png: [0.335091, -0.0321497, 0.30857, -3.01226, 0.0236777, -0.451343]
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from coupole.calibration.rotations import Floats, inverses, rotation
from coupole.errors import InputError
from coupole.geometry import abc_from_rotation
from coupole.plan import yamlfile
from coupole.plan.base_model import Model

Rotation = Literal["abc", "xyz", "rotation_vector", "quaternion_wxyz"]
_AXES = np.eye(3)


class Convention(Model):
    """Convention of the numbers of a pose: x y z, then the rotation."""

    length_unit: Literal["mm", "m"] = "mm"
    angle_unit: Literal["deg", "rad"] = "deg"
    rotation: Rotation = "abc"
    order: tuple[int, int, int] = (0, 1, 2)
    """Order of the three numbers of a rotation. (2, 1, 0) means that they are written backwards."""
    gives: Literal["base_from_flange", "flange_from_base"] = "base_from_flange"


class PoseFile(Convention):
    """Poses of the robot by the name of the image that was taken there. Image names are relative to this file."""

    schema_version: Literal[1]
    poses: Annotated[dict[str, tuple[float, ...]], Field(min_length=1)]

    @model_validator(mode="after")
    def _lengths(self) -> PoseFile:
        count = 7 if self.rotation == "quaternion_wxyz" else 6
        for name, numbers in self.poses.items():
            if len(numbers) != count:
                raise ValueError(f"{count} numbers for each pose; {name} has {len(numbers)}")
        return self


@dataclass(frozen=True)
class ReportedPoses:
    """Poses as numbers, and their stated convention."""

    numbers: Floats
    """[n, 6], or [n, 7] with quaternions."""
    convention: Convention

    @property
    def base_from_flange(self) -> Floats:
        """[n, 4, 4] poses, mm."""
        return base_from_flange(self.numbers, self.convention)


def read_poses(path: Path) -> tuple[PoseFile, ReportedPoses]:
    """Read a pose file. Raises InputError with every problem of the file."""
    document = yamlfile.read_document(path)
    file = document.validate(PoseFile)
    absurd = [
        document.problem(("poses", name), "expected finite numbers, and a quaternion that is not zero")
        for name, numbers in file.poses.items()
        if not np.all(np.isfinite(numbers)) or (len(numbers) == 7 and not np.any(numbers[3:]))
    ]
    if absurd:
        raise InputError(absurd)
    convention = Convention(**{name: getattr(file, name) for name in Convention.model_fields})
    return file, ReportedPoses(np.array(list(file.poses.values())), convention)


def kuka_poses(base_from_flange_mm: Floats) -> ReportedPoses:
    """Return transforms [n, 4, 4] in the form that a KUKA controller writes."""
    numbers = [[*t[:3, 3], *abc_from_rotation(t[:3, :3])] for t in base_from_flange_mm]
    return ReportedPoses(np.array(numbers), Convention())


def base_from_flange(numbers: Floats, convention: Convention) -> Floats:
    """Return [n, 4, 4] in mm for poses [n, 6 or 7]."""
    poses = np.broadcast_to(np.eye(4), (len(numbers), 4, 4)).copy()
    poses[:, :3, 3] = numbers[:, :3] * (1000.0 if convention.length_unit == "m" else 1.0)
    poses[:, :3, :3] = _rotations(numbers[:, 3:], convention)
    return poses if convention.gives == "base_from_flange" else inverses(poses)


def _rotations(numbers: Floats, convention: Convention) -> Floats:
    if convention.rotation == "quaternion_wxyz":
        unit = numbers / np.linalg.norm(numbers, axis=1, keepdims=True)
        half = np.linalg.norm(unit[:, 1:], axis=1, keepdims=True)
        angle = 2 * np.arctan2(half, unit[:, :1])
        return rotation(unit[:, 1:] / np.where(half > 0, half, 1.0) * angle)
    angles = numbers[:, list(convention.order)]
    if convention.angle_unit == "deg":
        angles = np.radians(angles)
    if convention.rotation == "rotation_vector":
        return rotation(angles)
    first, second, third = (
        rotation(angles[:, i : i + 1] * _AXES[axis]) for i, axis in enumerate(_turns(convention))
    )
    return np.asarray(first @ second @ third)


def _turns(convention: Convention) -> tuple[int, int, int]:
    """Return the axes of the three angles, in the order of the angles."""
    return (2, 1, 0) if convention.rotation == "abc" else (0, 1, 2)
