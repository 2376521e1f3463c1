"""RGL's tensor format (Dupuy and Jakob, An adaptive parameterization for efficient material acquisition and
rendering, 2018), as a plain table: the fields by which a measured table adapts to its material are constant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.of_results.material_tables import Material, materials_of
from coupole.exchange.of_results.measured_surface import MeasuredSurface
from coupole.storage.durable import write_synced

THETAS, SIDE = 64, 128
"""Angles of incidence; rows and columns of half vectors at each."""
_NDF = 4.0
"""Over 4 sigma it is 1."""
_TYPES = {"uint8": 1, "float32": 10}


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """`NAME.bsdf` for each material, some 13 MB."""
    paths = []
    for material in materials_of(surface):
        paths.append(folder / f"{material.name}.bsdf")
        write_synced(paths[-1], encode(material, surface.remark))
    return paths


def encode(material: Material, told: str = "") -> bytes:
    """f cos(theta_o) for isotropic incidence at `THETAS` angles; half vectors at azimuth (2 u - 1) pi by rows, and
    elevation pi/2 v^2 by columns."""
    theta_i = np.linspace(0.0, 0.5 * np.pi, THETAS, dtype=np.float32)
    steps = np.linspace(0.0, 1.0, SIDE)
    phi_m, theta_m = np.meshgrid((2.0 * steps - 1.0) * np.pi, 0.5 * np.pi * steps**2, indexing="ij")
    sine = np.sin(theta_m)
    half = np.stack([sine * np.cos(phi_m), sine * np.sin(phi_m), np.cos(theta_m)], axis=-1).reshape(-1, 3)
    rgb = np.zeros((1, THETAS, 3, SIDE, SIDE), np.float32)
    for number, theta in enumerate(theta_i.astype(np.float64)):
        way_in = np.array([np.sin(theta), 0.0, max(np.cos(theta), 1e-6)])
        ways_out = 2.0 * (half @ way_in)[:, None] * half - way_in
        values = material.reflectance(np.broadcast_to(way_in, half.shape), ways_out) * ways_out[:, 2:]
        rgb[0, number] = np.maximum(values, 0.0).T.reshape(3, SIDE, SIDE)
    rgb = nodes_for_linear_reading(rgb)
    text = f"{material.name}; {told}".encode()
    return tensors(
        {
            "theta_i": theta_i,
            "phi_i": np.zeros(1, np.float32),
            "ndf": np.full((2, 2), _NDF, np.float32),
            "sigma": np.ones((2, 2), np.float32),
            "vndf": np.ones((1, THETAS, 2, 2), np.float32),
            "luminance": rgb.mean(axis=2),
            "rgb": rgb,
            "description": np.frombuffer(text, np.uint8),
            "jacobian": np.ones(1, np.uint8),
        }
    )


def nodes_for_linear_reading(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Nodes [1, theta_i, channels, phi, theta_m] whose linear interpolation misses least, of values there.

    Between values h apart it misses f by f'' h^2 t (1 - t) / 2, in the mean by f'' h^2 / 12, on each axis: that
    much is taken from the nodes, but not where f ends at the horizon.
    """
    found = values.copy()
    for axis, periodic in ((1, False), (3, True), (4, False)):
        along, nodes = np.moveaxis(values, axis, 0), np.moveaxis(found, axis, 0)
        whole = along > 0.0
        inner = whole[2:] & whole[1:-1] & whole[:-2]
        nodes[1:-1] -= np.where(inner, along[2:] - 2.0 * along[1:-1] + along[:-2], 0.0) / 12.0
        if periodic:
            bend = np.where(whole[1] & whole[0] & whole[-2], along[1] - 2.0 * along[0] + along[-2], 0.0) / 12.0
            nodes[0] -= bend
            nodes[-1] -= bend
    return np.maximum(found, 0.0)


def tensors(fields: dict[str, NDArray[np.float32] | NDArray[np.uint8]]) -> bytes:
    """A tensor file: its head, then the fields, each at a multiple of 8 bytes."""
    size = 12 + 2 + 4 + sum(2 + len(name) + 2 + 1 + 8 + 8 * values.ndim for name, values in fields.items())
    head = [b"tensor_file\0", bytes([1, 0]), len(fields).to_bytes(4, "little")]
    blocks: list[bytes] = []
    for name, values in fields.items():
        gap = -size % 8
        blocks += [bytes(gap), values.tobytes()]
        size += gap
        head += [len(name).to_bytes(2, "little"), name.encode(), values.ndim.to_bytes(2, "little")]
        head += [bytes([_TYPES[values.dtype.name]]), size.to_bytes(8, "little")]
        head += [length.to_bytes(8, "little") for length in values.shape]
        size += values.nbytes
    return b"".join(head + blocks)
