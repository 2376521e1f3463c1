"""A tabulated BRDF in coordinates about the specular direction (Durikovic et al. 2002, section 3.1).

For light from wi, the polar axis is its mirror direction s'; theta is the angle between wo and s', and phi is the
angle about s' from the upper side of the plane of incidence. The peak of a metallic finish is then always at theta
= 0, and the grid of theta can be dense there and sparse elsewhere: nodes are placed so that the error of linear
interpolation is the same everywhere. The surface is isotropic: phi goes from 0 to pi only, and wi enters only by
its angle of incidence. The logarithm is interpolated, which keeps values positive. Over phi it is even and
periodic, and is interpolated by cosines, so that a few nodes are enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter.brdf import Brdf
from coupole.appearance.matter.hemisphere import directions
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

Indices = NDArray[np.intp]
_PROFILE = 2001
_FLOOR = 1e-9
"""Zeros are replaced by this share of the peak, because they have no logarithm."""
_HORIZON_Z = 0.01
"""Lower values are ignored when nodes are placed, because the bend at the horizon is an artefact of the table."""
_LOWEST_Z = 1e-3
"""Grid directions below the horizon take the value just above it, for interpolation."""


@dataclass(frozen=True)
class SpecularTable:
    """A BRDF on a grid of incidence and theta (radians, increasing), and of phi, with as many values as
    cosines."""

    incidence: Array
    theta: Array
    log_cosines: Array
    """[incidence, theta, cosines, bands]: log f (per steradian) is the sum over k of entry k times cos(k phi)."""


def tabulate(source: Brdf, incidence_deg: Array, *, theta_nodes: int = 40, phi_nodes: int = 7) -> SpecularTable:
    """The table of `source`, a BRDF or a measured BRDF, at angles of incidence (increasing, below 90)."""
    incidence = np.deg2rad(np.atleast_1d(np.asarray(incidence_deg, dtype=float)))
    if np.any(np.diff(incidence) <= 0.0) or incidence[0] < 0.0 or incidence[-1] >= 0.5 * np.pi:
        raise InputError(
            f"tabulated BRDF: expected angles of incidence from 0 to below 90 degrees, increasing; found "
            f"{np.asarray(incidence_deg).tolist()}; sort them"
        )
    phi = np.linspace(0.0, np.pi, phi_nodes)
    theta = np.linspace(0.0, 0.5 * np.pi + incidence[-1], _PROFILE)
    theta = _adapt(theta, *_sample(source, incidence, theta, phi), theta_nodes)
    values, _ = _sample(source, incidence, theta, phi)
    floor = _FLOOR * values.max(axis=(1, 2), keepdims=True) + np.finfo(float).tiny
    # log f(phi_j) = sum over k of c_k cos(k phi_j), solved for c.
    cosines = np.linalg.inv(np.cos(np.outer(phi, np.arange(phi_nodes))))
    return SpecularTable(incidence, theta, np.einsum("kj,itjb->itkb", cosines, np.log(np.maximum(values, floor))))


def tabulated_brdf(wi: Array, wo: Array, *, table: SpecularTable) -> Array:
    """Return the table's BRDF, as the mean over both orders of wi and wo, which makes it reciprocal."""
    above = ((wi[..., 2] > 0.0) & (wo[..., 2] > 0.0))[..., None]
    return (
        above
        * 0.5
        * (look_up(*specular_coordinates(wi, wo), table) + look_up(*specular_coordinates(wo, wi), table))
    )


def specular_coordinates(wi: Array, wo: Array) -> tuple[Array, Array, Array]:
    """Return the angle of incidence, theta and phi [...] of two directions; the inverse is `from_specular`."""
    mirror, upward, _ = _frame(wi)
    along, up = np.sum(wo * mirror, axis=-1), np.sum(wo * upward, axis=-1)
    across = np.linalg.norm(np.cross(mirror, wo), axis=-1)
    side = np.sqrt(np.maximum(0.0, across**2 - up**2))
    return (
        np.arctan2(np.hypot(wi[..., 0], wi[..., 1]), wi[..., 2]),
        np.arctan2(across, along),
        np.arctan2(side, up),
    )


def from_specular(incidence: Array, theta: Array, phi: Array) -> tuple[Array, Array]:
    """Return wi, in the plane y = 0, and wo [..., 3]."""
    wi = directions(np.cos(incidence), np.zeros_like(incidence))
    mirror, upward, side = _frame(wi)
    sine = np.sin(theta)[..., None]
    wo = np.cos(theta)[..., None] * mirror + sine * (
        np.cos(phi)[..., None] * upward + np.sin(phi)[..., None] * side
    )
    return np.broadcast_to(wi, wo.shape), wo


def _frame(wi: Array) -> tuple[Array, Array, Array]:
    """Return the mirror direction, the perpendicular to it in the plane of incidence on the upper side, and their
    cross product."""
    mirror = wi * np.array([-1.0, -1.0, 1.0])
    sine = np.hypot(wi[..., 0], wi[..., 1])
    # At normal incidence the azimuth is arbitrary, and f does not depend on it.
    flat = np.where(
        sine[..., None] > 1e-12,
        wi * np.array([1.0, 1.0, 0.0]) / np.maximum(sine, 1e-12)[..., None],
        [1.0, 0.0, 0.0],
    )
    upward = flat * wi[..., 2:] + sine[..., None] * np.array([0.0, 0.0, 1.0])
    return mirror, upward, np.cross(mirror, upward)


def _sample(source: Brdf, incidence: Array, theta: Array, phi: Array) -> tuple[Array, Array]:
    """Values [incidence, theta, phi, bands], and the cosines [incidence, theta, phi] of wo to the normal."""
    wi, wo = from_specular(incidence[:, None, None], theta[None, :, None], phi[None, None, :])
    z = np.maximum(wo[..., 2], _LOWEST_Z)
    flat = np.hypot(wo[..., 0], wo[..., 1])
    shrink = np.sqrt(1.0 - z**2) / np.maximum(flat, 1e-12)
    lifted_way = np.stack([wo[..., 0] * shrink, wo[..., 1] * shrink, z], axis=-1)
    return source(wi, np.where((wo[..., 2] < _LOWEST_Z)[..., None], lifted_way, wo)), wo[..., 2]


def _adapt(theta: Array, profiles: Array, cosines: Array, nodes: int) -> Array:
    """Return `nodes` values of `theta`, which are dense where the logarithm of the profiles [i, theta, phi, bands]
    has high curvature.

    Linear interpolation of log f over a step h has the error h^2 f (log f)''/8 in f: equal errors need steps
    proportional to the inverse square root of f (log f)''. A tenth of the nodes is spread evenly.
    """
    peak = np.maximum(profiles.max(axis=(1, 2), keepdims=True), np.finfo(float).tiny)
    relative = np.maximum(profiles / peak, _FLOOR)
    bend = np.abs(np.gradient(np.gradient(np.log(relative), theta, axis=1), theta, axis=1))
    is_visible = (cosines > _HORIZON_Z)[..., None]
    curvature = (is_visible * relative * bend).max(axis=(0, 2, 3))
    density = np.sqrt(curvature)
    density += 0.1 * np.trapezoid(density, theta) / (theta[-1] - theta[0]) + 1e-12
    cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(theta))])
    return np.interp(np.linspace(0.0, cumulative[-1], nodes), cumulative, theta)


def look_up(incidence: Array, theta: Array, phi: Array, table: SpecularTable) -> Array:
    """The table [..., bands] at coordinates [...], for one order of the directions. It is not reciprocal between
    its nodes."""
    cosines = np.cos(phi[..., None] * np.arange(table.log_cosines.shape[2]))
    first, second = _place(table.incidence, incidence), _place(table.theta, theta)
    total: Array = np.zeros(1)
    for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = (first[2] if a else 1.0 - first[2]) * (second[2] if b else 1.0 - second[2])
        total = total + np.einsum("...,...k,...kb->...b", weight, cosines, table.log_cosines[first[a], second[b]])
    return np.exp(total)


def _place(nodes: Array, at: Array) -> tuple[Indices, Indices, Array]:
    """Return the nodes below and above, and the weight of the latter. Beyond the last node, its value is used."""
    last = len(nodes) - 1
    high = np.clip(np.searchsorted(nodes, at), min(1, last), last)
    low = np.maximum(high - 1, 0)
    width = np.where(high > low, nodes[high] - nodes[low], 1.0)
    return low, high, np.clip((at - nodes[low]) / width, 0.0, 1.0)
