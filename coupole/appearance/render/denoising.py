"""Intel Open Image Denoise for pictures for viewing; spectra are never denoised."""

from __future__ import annotations

import numpy as np

from coupole.appearance.render.variant import import_extra
from coupole.appearance.spectra.grid import Array

DENOISED = "denoised by Open Image Denoise"


def denoised_xyz(xyz: Array) -> Array:
    """Return XYZ [h, w, 3] with less noise. Raises InputError if the library is missing (extra `denoiser`)."""
    pyoidn = import_extra("pyoidn", extra="denoiser")
    level = max(float(xyz.mean()), 1e-30)
    picture = pyoidn.denoise(np.ascontiguousarray(xyz / level, np.float32), hdr=True)
    return np.asarray(picture, dtype=float) * level
