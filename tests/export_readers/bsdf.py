"""Tables of RGL's format, by Mitsuba."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from lazily import lazily

mitsuba: Any = lazily("mitsuba")

MOST_LOST = 3e-3


def evaluate(path: Path, light: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Mitsuba's; it gives f times the cosine of the second direction, here the light's."""
    mitsuba.set_variant("scalar_rgb")
    bsdf = mitsuba.load_dict({"type": "measured", "filename": str(path)})
    interaction, context = mitsuba.SurfaceInteraction3f(), mitsuba.BSDFContext()
    rows = []
    for light_direction, camera_direction in zip(light, camera, strict=True):
        interaction.wi = mitsuba.Vector3f(*camera_direction)
        rows.append(np.array(bsdf.eval(context, interaction, mitsuba.Vector3f(*light_direction))))
    return np.pi * np.array(rows)
