"""RGL's tensor format (Dupuy and Jakob, An adaptive parameterization for efficient material acquisition and
rendering, 2018), as a plain table: the fields by which a measured table adapts to its material are constant.
`adaptive_table` has one that adapts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter.rgl_writing import (
    cosine_weighted,
    drawn_by,
    half_vectors,
    nodes_for_linear_reading,
    tensors,
)
from coupole.exchange.of_results.material_tables import Material, materials_of
from coupole.exchange.of_results.measured_surface import MeasuredSurface
from coupole.storage.durable import write_synced

THETAS, SIDE = 64, 128
"""Angles of incidence; rows and columns of half vectors at each."""
_NDF = 4.0
"""Over 4 sigma it is 1."""


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """`NAME.bsdf` for each material: some 17 MB, or what `surface.most_error` needs."""
    from coupole.exchange.of_results.adaptive_table import encode_adaptive

    paths = []
    for material in materials_of(surface):
        paths.append(folder / f"{material.name}.bsdf")
        if surface.most_error is None:
            write_synced(paths[-1], encode(material, surface.remark))
        else:
            write_synced(paths[-1], encode_adaptive(material, surface.most_error, surface.remark))
    return paths


def encode(material: Material, told: str = "") -> bytes:
    """f cos(theta_o) for isotropic incidence at `THETAS` angles; half vectors at azimuth (2 u - 1) pi by rows, and
    elevation pi/2 v^2 by columns."""
    theta_i = np.linspace(0.0, 0.5 * np.pi, THETAS, dtype=np.float32)
    values = cosine_weighted(material.reflectance, theta_i, half_vectors(SIDE))
    rgb = nodes_for_linear_reading(values, theta_i)
    return tensors(fields_of(theta_i, rgb, drawn_by(values, theta_i), f"{material.name}; {told}"))


def fields_of(
    theta_i: NDArray[np.float32], rgb: NDArray[np.float32], luminance: NDArray[np.float32], text: str
) -> dict[str, NDArray[np.float32] | NDArray[np.uint8]]:
    """Of an isotropic file whose half vectors are not warped, and whose values are not divided by anything."""
    return {
        "theta_i": theta_i,
        "phi_i": np.zeros(1, np.float32),
        "ndf": np.full((2, 2), _NDF, np.float32),
        "sigma": np.ones((2, 2), np.float32),
        "vndf": np.ones((1, len(theta_i), 2, 2), np.float32),
        "luminance": luminance,
        "rgb": rgb,
        "description": np.frombuffer(text.encode(), np.uint8),
        "jacobian": np.ones(1, np.uint8),
    }
