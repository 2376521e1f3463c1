"""RGL's tensor format (Dupuy and Jakob, An adaptive parameterization for efficient material acquisition and
rendering, 2018), as a plain table: the fields that adapt a measured table to its material are constant.
`adaptive_table` makes tables that adapt."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coupole.appearance.matter.rgl_writing import (
    cosine_weighted,
    drawn_by,
    fields_of,
    half_vectors,
    nodes_for_linear_reading,
    tensors,
)
from coupole.exchange.of_results.adaptive_table import encode_adaptive
from coupole.exchange.of_results.material_tables import Material, materials_of
from coupole.exchange.of_results.measured_surface import MeasuredSurface
from coupole.storage.durable import write_synced

THETAS, SIDE = 64, 128
"""Number of angles of incidence; numbers of rows and columns of half vectors at each."""


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """Write `NAME.bsdf` for each material. A file has about 17 MB, or the size that `surface.options.most_error`
    needs."""
    paths = []
    for material in materials_of(surface):
        paths.append(folder / f"{material.name}.bsdf")
        if surface.options.most_error is None:
            write_synced(paths[-1], encode(material, surface.remark))
        else:
            write_synced(paths[-1], encode_adaptive(material, surface.options.most_error, surface.remark))
    return paths


def encode(material: Material, description: str = "") -> bytes:
    """Return f cos(theta_o) for isotropic incidence at `THETAS` angles. Rows are half vectors at azimuth (2 u - 1)
    pi, columns at elevation pi/2 v^2."""
    theta_i = np.linspace(0.0, 0.5 * np.pi, THETAS, dtype=np.float32)
    values = cosine_weighted(material.reflectance, theta_i, half_vectors(SIDE))
    rgb = nodes_for_linear_reading(values, theta_i)
    return tensors(fields_of(theta_i, rgb, drawn_by(values, theta_i), f"{material.name}; {description}"))
