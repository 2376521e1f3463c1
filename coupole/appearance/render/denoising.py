"""Intel Open Image Denoise for the pictures that people look at; spectra are never denoised."""

from __future__ import annotations

import numpy as np

from coupole.appearance.render.variant import import_extra
from coupole.appearance.spectra.grid import Array

DENOISED = "denoised by Open Image Denoise"


def denoised_xyz(xyz: Array) -> Array:
    """XYZ [h, w, 3] with less noise. Raises InputError without the library (extra `denoiser`)."""
    pyoidn = import_extra("pyoidn", extra="denoiser")
    level = max(float(xyz.mean()), 1e-30)
    picture = pyoidn.denoise(np.ascontiguousarray(xyz / level, np.float32), hdr=True)
    return np.asarray(picture, dtype=float) * level
