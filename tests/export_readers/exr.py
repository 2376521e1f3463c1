"""OpenEXR of several parts, by its makers' library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from export_readers.lit_models import Lit, Materials, ggx

MOST_LOST = 1e-4


def relit(folder: Path, lit: Lit) -> np.ndarray:
    """GGX of the pixels of each view."""
    radiance = np.empty((len(lit.triangles), 3))
    for view in sorted(set(lit.views)):
        parts = {part.name(): part.channels for part in OpenEXR.File(str(folder / f"{view}.exr"), True).parts}
        in_view = lit.views == view
        here = lit.of(in_view)

        def pixels(part: str, names: str, parts: dict[str, Any] = parts, here: Lit = here) -> np.ndarray:
            planes = [parts[part][name].pixels[here.rows, here.columns] for name in names]
            return np.stack(planes, axis=1).astype(float)

        alpha = pixels("alpha", "Y")[:, 0]
        values = Materials(pixels("normal", "XYZ"), pixels("kd", "RGB"), pixels("ks", "RGB"), alpha)
        radiance[in_view] = ggx(values, here)
    return radiance
