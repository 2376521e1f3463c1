"""An isotropic BRDF as a table of RGL's format, which a renderer reads natively.

Angles of incidence and half vectors are those of the format. `ndf` has the reflectance back to the light, by the
half vector's elevation. The values in the table are divided by this reflectance, so they change little within a
lobe.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter.brdf import Brdf
from coupole.appearance.matter.hemisphere import directions
from coupole.appearance.matter.rgl_table import RglTable, read_fields
from coupole.appearance.matter.rgl_writing import (
    cosine_weighted,
    drawn_by,
    half_vectors,
    nodes_for_linear_reading,
    tensors,
)
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from coupole.errors import InputError

THETAS, SIDE = 32, 64
_CROWDING = 1.3
_NDF_NODES = 2048
_STEEPEST = np.radians(80.0)
"""Beyond this angle the reflectance back to the light is held constant, because some models diverge there."""
_FLOOR = 1e-5


@dataclass(frozen=True, eq=False)
class BakedTable:
    """Fields of a tensor file with channels, and the conversion of these channels to bands."""

    fields: Mapping[str, NDArray[Any]]
    """All fields except the values and their wavelengths."""
    values: NDArray[np.float32]
    """[phi_i, theta_i, channels, rows, columns]"""
    to_bands: Array
    """[channels, bands]"""

    def encode(self, wavelengths_nm: Sequence[float], bands: Sequence[int]) -> bytes:
        """Return the bytes of a file with the values of `bands` at `wavelengths_nm`."""
        band_values = np.einsum("ptcrk,cb->ptbrk", self.values, self.to_bands[:, list(bands)].astype(np.float32))
        return tensors(
            {
                **self.fields,
                "wavelengths": np.asarray(wavelengths_nm, np.float32),
                "spectra": np.ascontiguousarray(band_values, np.float32),
            }
        )

    def decoded_table(self) -> RglTable:
        """Return the table, with all channels, as a reader gets it from the file."""
        phi_i, theta_i, ndf, sigma, vndf = (
            np.asarray(self.fields[name], np.float64) for name in ("phi_i", "theta_i", "ndf", "sigma", "vndf")
        )
        planes = np.ascontiguousarray(np.moveaxis(self.values, 2, -1))
        jacobian = bool(self.fields["jacobian"][0])
        return RglTable(phi_i, theta_i, ndf, sigma, vndf, planes, None, jacobian=jacobian, description="")


def bake(source: Brdf, to_bands: Array | None = None, *, thetas: int = THETAS, side: int = SIDE) -> BakedTable:
    """Bake an isotropic BRDF of 81 bands, or of channels; `to_bands` [channels, 81] converts channels to bands."""
    steps = np.linspace(0.0, 1.0, thetas)
    theta_i = np.asarray(0.5 * np.pi * (1.0 - (1.0 - steps) ** _CROWDING), np.float32)
    ndf = _back(source)
    half = half_vectors(side)[: side // 2]
    one_side = cosine_weighted(source, theta_i, half)
    cosine = np.concatenate([one_side, one_side[..., ::-1, :]], axis=3)
    over = np.interp(np.linspace(0.0, 1.0, side), np.linspace(0.0, 1.0, _NDF_NODES), ndf).astype(np.float32)
    fields: dict[str, NDArray[Any]] = {
        "theta_i": theta_i,
        "phi_i": np.zeros(1, np.float32),
        "ndf": np.repeat(ndf[None], 2, axis=0).astype(np.float32),
        "sigma": np.full((2, 2), 0.25, np.float32),
        "vndf": np.ones((1, thetas, 2, 2), np.float32),
        "luminance": drawn_by(cosine, theta_i),
        "description": np.frombuffer(b"baked", np.uint8),
        "jacobian": np.ones(1, np.uint8),
    }
    values = nodes_for_linear_reading(np.asarray(cosine / over, np.float32), theta_i)
    return BakedTable(fields, values, np.eye(values.shape[2]) if to_bands is None else to_bands)


def from_file(path: Path, table: RglTable, to_bands: Array) -> BakedTable:
    """Return a table from an isotropic file of the format, unchanged, with its own grid. Raises InputError."""
    file_fields = read_fields(path)
    if "luminance" not in file_fields:
        raise InputError(f"{path}: expected a field `luminance`, by which directions are drawn; found none")
    names = ("phi_i", "theta_i", "ndf", "sigma", "vndf", "luminance")
    fields: dict[str, NDArray[Any]] = {name: np.asarray(file_fields[name], np.float32) for name in names}
    fields["description"] = np.frombuffer(b"from a file", np.uint8)
    fields["jacobian"] = np.array([table.jacobian], np.uint8)
    return BakedTable(fields, np.ascontiguousarray(np.moveaxis(table.values, -1, 2)), to_bands)


def _back(source: Brdf) -> Array:
    """[nodes] reflectance back to the light, as the mean over the channels."""
    theta = 0.5 * np.pi * np.linspace(0.0, 1.0, _NDF_NODES) ** 2
    ways = directions(np.cos(np.minimum(theta, _STEEPEST)), np.zeros(_NDF_NODES))
    reflectance = source(ways, ways).mean(axis=-1)
    return np.asarray(np.maximum(reflectance, _FLOOR * max(float(reflectance.max()), 1e-9)))


def wavelengths_of(table: RglTable) -> Array:
    """[channels, 81] weights: linear between the table's own wavelengths, constant beyond its ends."""
    assert table.wavelengths_nm is not None
    nodes_nm = table.wavelengths_nm
    return np.stack([np.interp(WAVELENGTHS_NM, nodes_nm, node_weights) for node_weights in np.eye(len(nodes_nm))])
