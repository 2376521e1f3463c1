"""Residuals of GGX for each triangle, for a page: a few principal components of all residuals of a view.

A result's fit `ggx_rbf` gives each triangle, for each view, a share of its GGX and coefficients of a hundred
radial functions of the light's direction (`coupole.reflectance.slice_fit`). The components minimise the error of f
cos_i over the hemisphere, which is what a picture shows. Each component is a plane: a table of reflectance by the
light's direction in the triangle's own frame. Each triangle has a coefficient for each plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from coupole.exchange.look.look_blocks import Block, block_of
from coupole.exchange.material_values import red_green_blue
from coupole.geometry import apply, inverse
from coupole.reflectance.fits import SLICES
from coupole.reflectance.run_result import RunResult, ViewSamples
from coupole.reflectance.slice_basis import COUNT, functions
from coupole.reflectance.triangle_fit import TriangleSamples, model_values

Floats = NDArray[np.float64]

FIT = SLICES["ggx_rbf"]
PLANES = 9
"""Default number of planes. Together with the three shares of GGX, the planes fill whole groups of four bytes."""
SIDE = 48
"""Number of entries on a side of a plane's table."""
_STEPS = 127
_SHARE_STEPS = 254
_LEARNT, _JUDGED = 20_000, 1500
"""Number of a view's triangles from which planes are computed, and number of triangles on which the planes' error
is measured.
"""
_BLOCK = 1 << 14
_DIRECTIONS = 600
"""Number of lights in all directions for measuring the error of planes."""
_FAR_MM = 1e5


@dataclass(frozen=True)
class ResidualPlanes:
    """Planes of a view's triangles: f cos_i = max(share f_GGX cos_i + z sum_k number_k plane_k(light), 0), where z
    is the cosine of the light to the mesh's normal."""

    planes: NDArray[np.float16]
    """[planes, SIDE, SIDE, 3] 1/sr by y and x of `table_directions`, multiplied by the greatest coefficient of the
    plane."""
    codes: NDArray[np.uint8]
    """[3 + planes, n] codes: of the shares by channel (1 to 255 for 0 to 1; 0 for no residual), and of the
    coefficients. The code of a coefficient is 128 + 127 times the signed root of its share of the greatest one."""
    missed_energy: float
    """Sum of the squared errors of pages relative to the fit, over some triangles, directions and channels."""
    energy: float
    """The sum of squares for GGX alone: the energy of the residual."""


def residual_fit(result: RunResult) -> str | None:
    """The material to which residuals are added; None if no view has such a fit."""
    whole = all(result.slices_path(FIT.name, view).exists() for view in result.views)
    return FIT.over.name if FIT.over and whole and result.views else None


def residual_blocks(
    result: RunResult, planes: int, say: Callable[[str, int, int], None]
) -> tuple[dict[str, Any], list[Block]]:
    """Return a page's facts of residuals, and two blocks of each view: codes [3 + planes, triangles of the mesh]
    and planes.

    Among the facts, `kept` is the share of the energy of all views' residuals that the planes contain.
    """
    views, blocks, missed_energy, energy = [], [], 0.0, 0.0
    support_from_base = inverse(result.base_from_support)
    for number, view in enumerate(result.views):
        planes_of_view = residual_planes(result, view, planes)
        codes = np.zeros((len(planes_of_view.codes), len(result.corners_mm)), np.uint8)
        codes[:, view.triangles] = planes_of_view.codes
        names = [f"residual-{view.path.stem}", f"planes-{view.path.stem}"]
        blocks += [block_of(names[0], codes), block_of(names[1], planes_of_view.planes)]
        camera_mm = apply(support_from_base, view.camera_mm).tolist()
        views.append({"name": view.view, "blocks": names, "camera_mm": camera_mm})
        missed_energy, energy = missed_energy + planes_of_view.missed_energy, energy + planes_of_view.energy
        say("residuals", number + 1, len(result.views))
    share = 1.0 - missed_energy / energy if energy > 0.0 else 1.0
    return {"planes": planes, "side": SIDE, "kept": round(share, 4), "views": views}, blocks


def residual_planes(result: RunResult, view: ViewSamples, count: int) -> ResidualPlanes:
    """Compute `count` planes of a view's residuals."""
    coefficients = result.slices(FIT.name, view)
    rows_of_fit = np.flatnonzero(np.isfinite(coefficients).all(axis=(1, 2)))
    channels = coefficients.shape[1]
    some = np.random.default_rng(0).permutation(rows_of_fit)
    training = coefficients[np.sort(some[:_LEARNT]), :, :COUNT].astype(np.float64)
    rows, back = _components(training, count)
    numbers = np.empty((count, len(rows_of_fit)), np.float32)
    for first in range(0, len(rows_of_fit), _BLOCK):
        part = coefficients[rows_of_fit[first : first + _BLOCK], :, :COUNT]
        numbers[:, first : first + _BLOCK] = rows @ part.reshape(len(part), -1).T
    peaks = np.maximum(np.abs(numbers).max(axis=1, initial=0.0), 1e-30)
    codes = np.zeros((3 + count, len(coefficients)), np.uint8)
    shares = np.clip(red_green_blue(coefficients[rows_of_fit, :, COUNT].astype(np.float64)), 0.0, 1.0)
    codes[:3, rows_of_fit] = 1.0 + np.rint(_SHARE_STEPS * shares.T)
    roots = np.sign(numbers) * np.sqrt(np.abs(numbers) / peaks[:, None])
    codes[3:, rows_of_fit] = 128.0 + np.rint(_STEPS * roots)
    basis = (peaks[:, None] * back).reshape(count, channels, COUNT)
    table = np.einsum("pck,kn->npc", basis, _functions(table_directions().reshape(-1, 3)))
    planes = red_green_blue(table.reshape(-1, channels)).reshape(SIDE, SIDE, count, 3).transpose(2, 0, 1, 3)
    check_rows = np.sort(some[:_JUDGED])
    missed_energy, energy = _missed_energy(
        result, view, coefficients[check_rows], codes[:, check_rows], basis, check_rows
    )
    return ResidualPlanes(planes.astype(np.float16), codes, missed_energy, energy)


def table_directions() -> Floats:
    """[SIDE, SIDE, 3] directions of lights in the triangle's frame: Lambert's azimuthal equal-area projection, x
    and y from -1 to 1. The hemisphere is a disk of radius 1; outside the disk are lights from below."""
    line = np.linspace(-1.0, 1.0, SIDE)
    u, v = np.meshgrid(line, line)
    square = u * u + v * v
    stretch = np.sqrt(2.0 - square)
    return np.stack([u * stretch, v * stretch, 1.0 - square], axis=-1)


def _components(learnt_coefficients: Floats, count: int) -> tuple[Floats, Floats]:
    """Find the components of coefficients [n, channels, COUNT].

    Returns rows [count, channels * COUNT] that map coefficients to components, and the coefficients of each
    component, which map back. If there are fewer components, the rest is 0.
    """
    channels = learnt_coefficients.shape[1]
    root = _metric()
    apart = (learnt_coefficients @ root).reshape(len(learnt_coefficients), -1)
    size = apart.shape[1]
    powers, axes = eigh(apart.T @ apart, subset_by_index=(max(0, size - count), size - 1))
    axes = np.where(powers > 1e-12 * max(powers.max(initial=0.0), 1e-300), axes, 0.0)[:, ::-1].T
    components = axes.reshape(-1, channels, COUNT)
    rows, back = np.zeros((2, count, channels * COUNT))
    rows[: len(components)] = (components @ root.T).reshape(len(components), -1)
    back[: len(components)] = (components @ np.linalg.inv(root)).reshape(len(components), -1)
    return rows, back


@cache
def _metric() -> Floats:
    """[COUNT, COUNT] lower root of the integral, over the hemisphere, of the products of functions times the
    cosine."""
    directions = _half_sphere(4000)
    values = _functions(directions) * directions[:, 2]
    gram = values @ values.T * (2.0 * math.pi / len(directions))
    root: Floats = np.linalg.cholesky(gram + 1e-10 * np.trace(gram) / COUNT * np.eye(COUNT))
    return root


def _functions(directions: Floats) -> Floats:
    """[COUNT, n] values of the radial functions."""
    rows = np.empty((COUNT, len(directions)))
    x, y, z = np.ascontiguousarray(directions.T)
    functions(FIT.basis.harmonic, x, y, z, rows)
    return rows


def _half_sphere(count: int) -> Floats:
    """[count, 3] directions on a Fibonacci spiral."""
    number = np.arange(count) + 0.5
    z = 1.0 - number / count
    azimuth = number * math.pi * (3.0 - math.sqrt(5.0))
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)


def _missed_energy(
    result: RunResult,
    view: ViewSamples,
    coefficients: NDArray[np.float32],
    codes: NDArray[np.uint8],
    scaled_planes: Floats,
    rows: NDArray[np.int64],
) -> tuple[float, float]:
    """`missed_energy` and `energy` of `ResidualPlanes`, of some rows of the view's file, under distant lights."""
    assert FIT.over is not None
    samples = result.view_samples(view, slice(None), np.zeros(len(view.leds), np.bool_))
    half = _half_sphere(_DIRECTIONS // 2)
    middle_mm = samples.centres_mm[rows].mean(axis=0) if len(rows) else np.zeros(3)
    lights = TriangleSamples(
        np.zeros((len(rows), _DIRECTIONS, coefficients.shape[1]), np.float32),
        middle_mm + _FAR_MM * np.concatenate([half, -half]),
        np.zeros(_DIRECTIONS, np.int64),
        view.camera_mm[None],
        samples.centres_mm[rows],
        samples.normals[rows],
        np.ones(len(rows)),
    )
    places = np.searchsorted(result.triangles, view.triangles[rows])
    model = np.nan_to_num(model_values(lights, result.materials(FIT.over.name, places)))
    fit = FIT.values(lights, coefficients, model)
    roots = (codes[3:].astype(np.float64) - 128.0) / _STEPS
    short = np.einsum("pn,pck->nck", roots * np.abs(roots), scaled_planes)
    shares = (codes[: coefficients.shape[1]].T - 1.0) / _SHARE_STEPS
    page_coefficients = np.concatenate([short, shares[:, :, None]], axis=2).astype(np.float32)
    page = FIT.values(lights, page_coefficients, model)
    return float(np.sum((page - fit) ** 2)), float(np.sum((fit - model) ** 2))
