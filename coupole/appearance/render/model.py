"""Common models of the parts of a scene file."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from coupole.geometry import Transform, transform

Vector = tuple[float, float, float]
Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]
Roughness = Annotated[float, Field(ge=0.01, le=1)]
"""GGX alpha. Perfect mirrors are not allowed, because point lights would be invisible in them."""
Index = Annotated[float, Field(gt=1, le=3)]
"""Index of refraction of a transparent material."""


class Model(BaseModel):
    """Base of the models: frozen, and unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Pose(Model):
    """Pose of an object: translation in mm, KUKA's A, B, C in degrees."""

    translation_mm: Vector = (0.0, 0.0, 0.0)
    abc_deg: Vector = (0.0, 0.0, 0.0)

    def scene_from_thing(self) -> Transform:
        return transform(self.translation_mm, self.abc_deg)


def unit(vector: Vector) -> Vector:
    """Return `vector` with length 1."""
    x, y, z = np.asarray(vector, dtype=float) / np.linalg.norm(vector)
    return float(x), float(y), float(z)
