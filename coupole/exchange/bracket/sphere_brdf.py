"""The BRDF of a finish from linear photographs of a sphere of it (seed 002, section 3.1).

Each pixel of the sphere has a normal of its own, so that one photograph under one light from afar has
thousands of samples of an isotropic BRDF; several lights cover it. Samples are fitted in specular coordinates
(`tabulated`), the logarithm linear between nodes that crowd about the peak, and smooth where there are no
samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from coupole.appearance.matter.tabulated import SpecularTable, specular_coordinates, tabulated_brdf
from coupole.errors import InputError

Array = NDArray[np.float64]
_INCIDENCE_DEG = np.arange(0.0, 85.0, 6.0)
_THETAS, _PHIS = 24, 5
_LEAST_COSINE = 0.12
_MOST_SAMPLES = 60_000
_SMOOTH = 2e-3
_FEWEST = 1000
_AT_ONCE = 100_000


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Lit(_Model):
    """A photograph of the sphere under one light from afar."""

    path: Path
    """OpenEXR with R, G, B, as `coupole bracket` writes it."""
    to_light: tuple[float, float, float]
    """x to the right of the picture, y up, z to the camera."""


class White(_Model):
    """A white at the sphere's place that faced the light, photographed in the same way."""

    values: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
    reflectance: Annotated[float, Field(gt=0, le=1)] = 0.99


class SphereSample(_Model):
    """A sphere in photographs from so far away that they are orthographic."""

    photographs: Annotated[tuple[Lit, ...], Field(min_length=1)]
    centre_px: tuple[float, float]
    """Column and row; the middle of the first pixel is 0, 0."""
    radius_px: Annotated[float, Field(gt=3)]
    white: White


@dataclass(frozen=True)
class Samples:
    """Pixels' directions in their own frames, and what they reflect."""

    ways_in: Array
    """[n, 3]."""
    ways_out: Array
    f: Array
    """[n, 3] 1/sr."""


def samples_of(sample: SphereSample, pictures: Sequence[NDArray[np.float32]]) -> Samples:
    """Take samples from linear pictures [h, w, 3], NaN where nothing is known. Samples near the horizon of the
    light or of the camera are left out.

    Raises InputError where the sphere is not in the picture, or too few pixels say anything.
    """
    parts = []
    rho_over_pi = sample.white.reflectance / np.pi
    for lit, picture in zip(sample.photographs, pictures, strict=True):
        rows, columns = picture.shape[:2]
        u, v = sample.centre_px
        if min(u, v, columns - 1 - u, rows - 1 - v) < sample.radius_px - 0.5:
            raise InputError(
                f"{lit.path}: expected all of the sphere in the picture; correct centre_px or radius_px"
            )
        y, x = np.mgrid[:rows, :columns]
        x, y = (x - u) / sample.radius_px, (v - y) / sample.radius_px
        inside = x**2 + y**2 < 1.0
        normals = np.stack([x[inside], y[inside], np.sqrt(1.0 - x[inside] ** 2 - y[inside] ** 2)], axis=1)
        to_light = np.asarray(lit.to_light) / np.linalg.norm(lit.to_light)
        f = picture[inside] / np.asarray(sample.white.values) * rho_over_pi / (normals @ to_light)[:, None]
        good = (normals @ to_light > _LEAST_COSINE) & (normals[:, 2] > _LEAST_COSINE)
        good &= np.isfinite(f).all(axis=1) & (f > 0.0).all(axis=1)
        frames = _frames(normals[good])
        parts.append((frames @ to_light, frames @ np.array([0.0, 0.0, 1.0]), f[good]))
    ways_in, ways_out, f = (np.concatenate(part) for part in zip(*parts, strict=True))
    if len(f) < _FEWEST:
        raise InputError(
            f"sphere: expected at least {_FEWEST} lit pixels, neither dark nor saturated; found {len(f)}"
        )
    return Samples(ways_in, ways_out, f)


def table_of(samples: Samples) -> SpecularTable:
    """Fit a table by least squares of log f, each sample as it is and with its directions exchanged."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve

    picks = np.random.default_rng(1).permutation(len(samples.f))[: _MOST_SAMPLES // 2]
    ways_in, ways_out = samples.ways_in[picks], samples.ways_out[picks]
    incidence = np.radians(_INCIDENCE_DEG)
    theta = (0.5 * np.pi + incidence[-1]) * np.linspace(0.0, 1.0, _THETAS) ** 2
    phi = np.linspace(0.0, np.pi, _PHIS)
    pairs = zip(specular_coordinates(ways_in, ways_out), specular_coordinates(ways_out, ways_in), strict=True)
    at = [np.concatenate(pair) for pair in pairs]
    places = [_between(nodes, where) for nodes, where in zip((incidence, theta, phi), at, strict=True)]
    shape = (len(incidence), _THETAS, _PHIS)
    rows, columns, weights = [], [], []
    for corner in np.ndindex(2, 2, 2):
        index = [low + side for (low, _), side in zip(places, corner, strict=True)]
        rows.append(np.arange(len(at[0])))
        columns.append(np.ravel_multi_index(index, shape))
        shares = [share if side else 1.0 - share for (_, share), side in zip(places, corner, strict=True)]
        weights.append(np.prod(shares, axis=0))
    entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    design = coo_matrix(entries, (len(at[0]), int(np.prod(shape)))).tocsr()
    logs = np.tile(np.log(samples.f[picks]), (2, 1))
    normal = (design.T @ design + _SMOOTH * len(logs) / np.prod(shape) * _roughness(shape)).tocsc()
    values = np.stack([spsolve(normal, design.T @ logs[:, band]) for band in range(3)], axis=1)
    cosines = np.linalg.inv(np.cos(np.outer(phi, np.arange(_PHIS))))
    return SpecularTable(incidence, theta, np.einsum("kj,itjb->itkb", cosines, values.reshape(*shape, 3)))


def table_function(table: SpecularTable) -> Callable[[Array, Array], Array]:
    """The table as a function of directions [n, 3], in parts that fit into memory."""

    def reflectance(ways_in: Array, ways_out: Array) -> Array:
        parts = range(0, len(ways_in), _AT_ONCE)
        blocks = [
            tabulated_brdf(ways_in[at : at + _AT_ONCE], ways_out[at : at + _AT_ONCE], table=table) for at in parts
        ]
        return np.concatenate(blocks)

    return reflectance


def misses(samples: Samples, table: SpecularTable) -> tuple[float, float]:
    """Median and 95 % of the relative differences between table and samples."""
    off = np.abs(table_function(table)(samples.ways_in, samples.ways_out) / samples.f - 1.0)
    median, most = np.quantile(off, [0.5, 0.95])
    return float(median), float(most)


def _roughness(shape: tuple[int, int, int]) -> Any:
    """Squares of second differences along each coordinate; those along theta count least."""
    from scipy.sparse import diags, eye, kron

    parts = []
    level = diags([-30.0, 30.0], [0, 1], shape=(1, shape[1]))  # a lobe is level at its peak
    parts.append(kron(kron(eye(shape[0]), level.T @ level), eye(shape[2])))
    for axis, weight in ((0, 10.0), (1, 1.0), (2, 10.0)):
        second = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(shape[axis] - 2, shape[axis]))
        factors = [eye(count) for count in shape]
        factors[axis] = second.T @ second
        parts.append(weight * kron(kron(factors[0], factors[1]), factors[2]))
    return sum(parts[1:], parts[0])


def _between(nodes: Array, where: Array) -> tuple[NDArray[np.intp], Array]:
    low = np.clip(np.searchsorted(nodes, where) - 1, 0, len(nodes) - 2)
    return low, np.clip((where - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0, 1.0)


def _frames(normals: Array) -> Array:
    """[n, 3, 3] whose rows are two tangents and the normal."""
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = np.cross(least, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=1)
