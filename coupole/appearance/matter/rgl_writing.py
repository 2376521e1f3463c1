"""Writing of tables in RGL's tensor format: nodes, the density for drawing directions, and the file.

Half vectors are not warped by `vndf`; `ndf` holds the fast change with the half vector's elevation
(docs/decisions/0038).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter.brdf import Brdf

_LEAST_DRAWN = 1e-3
"""Share of the mean density that is added everywhere, so that all reflecting directions are drawn at times."""
_NDF = 4.0
"""Value of `ndf`: divided by 4 sigma it is 1."""
_TYPES = {"uint8": 1, "float32": 10}


def half_vectors(side: int) -> NDArray[np.float64]:
    """[side, side, 3] unit vectors for the rows and columns."""
    steps = np.linspace(0.0, 1.0, side)
    phi_m, theta_m = np.meshgrid((2.0 * steps - 1.0) * np.pi, 0.5 * np.pi * steps**2, indexing="ij")
    sine = np.sin(theta_m)
    return np.stack([sine * np.cos(phi_m), sine * np.sin(phi_m), np.cos(theta_m)], axis=-1)


def way_in(theta_i: float) -> NDArray[np.float64]:
    """[3] direction at azimuth 0, and above the horizon."""
    return np.array([np.sin(theta_i), 0.0, max(np.cos(theta_i), 1e-6)])


def cosine_weighted(
    reflectance: Brdf, theta_i: NDArray[np.float32], half: NDArray[np.float64]
) -> NDArray[np.float32]:
    """[1, theta_i, channels, rows, columns] f cos(theta_o) of half vectors [rows, columns, 3]; 0 for light from
    below."""
    slices = []
    ways = half.reshape(-1, 3)
    for theta in theta_i.astype(np.float64):
        light = way_in(theta)
        ways_out = 2.0 * (ways @ light)[:, None] * ways - light
        values = reflectance(np.broadcast_to(light, ways.shape), ways_out) * ways_out[:, 2:]
        slices.append(np.maximum(values, 0.0).T.reshape(-1, *half.shape[:2]).astype(np.float32))
    return np.stack(slices)[None]


def nodes_for_linear_reading(values: NDArray[np.float32], theta_i: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return nodes [1, theta_i, channels, phi, theta_m] with the smallest error of linear interpolation, from the
    values at the nodes.

    Between nodes at a distance h, the interpolation differs from f by f'' h^2 t (1 - t) / 2, on average by f'' h^2
    / 12, on each axis. This amount is subtracted from the nodes, with h before and after them, but not where f
    ends at the horizon.
    """
    node_values = values.copy()
    even = np.linspace(0.0, 1.0, values.shape[3])
    for axis, places in ((1, theta_i.astype(np.float64)), (3, even), (4, np.linspace(0.0, 1.0, values.shape[4]))):
        along, nodes = np.moveaxis(values, axis, 0), np.moveaxis(node_values, axis, 0)
        before, after = (step.reshape(-1, 1, 1, 1, 1) for step in (np.diff(places)[:-1], np.diff(places)[1:]))
        whole = along > 0.0
        inner = whole[2:] & whole[1:-1] & whole[:-2]
        second = 2.0 * ((along[2:] - along[1:-1]) / after - (along[1:-1] - along[:-2]) / before) / (before + after)
        nodes[1:-1] -= np.where(inner, second * (before**2 + after**2) / 24.0, 0.0)
        if axis == 3:  # azimuth, whose first node is the last
            bend = np.where(whole[1] & whole[0] & whole[-2], along[1] - 2.0 * along[0] + along[-2], 0.0) / 12.0
            nodes[0] -= bend
            nodes[-1] -= bend
    return np.maximum(node_values, 0.0)


def drawn_by(values: NDArray[np.float32], theta_i: NDArray[np.float32]) -> NDArray[np.float32]:
    """[1, theta_i, rows, columns] `luminance`, by which renderers draw directions. The `luminance` of a cell is
    the light that this step of rows and columns reflects; it is computed from `values`, which are f cos(theta_o).
    The solid angle of its outgoing directions is in proportion to (wi m) u sin(theta_m).
    """
    half = half_vectors(values.shape[-1])
    u = np.linspace(0.0, 1.0, values.shape[-1])
    lights = np.stack([way_in(float(theta)) for theta in theta_i])
    solid_angle = np.maximum(half @ lights.T, 0.0) * (u * np.sin(0.5 * np.pi * u**2))[None, :, None]
    densities = values.mean(axis=2) * np.moveaxis(solid_angle, -1, 0)[None]
    return np.asarray(densities + _LEAST_DRAWN * densities.mean(axis=(2, 3), keepdims=True) + 1e-12, np.float32)


def fields_of(
    theta_i: NDArray[np.float32], rgb: NDArray[np.float32], luminance: NDArray[np.float32], text: str
) -> dict[str, NDArray[np.float32] | NDArray[np.uint8]]:
    """Return the fields of an isotropic file with half vectors that are not warped and values that are not
    divided."""
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


def tensors(fields: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the bytes of a tensor file: its head, then the fields, each at a multiple of 8 bytes."""
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
