"""Nashiji: metal flakes at random depths in clear lacquer (Durikovic et al. 2002, section 5).

A flake is a superquadric (Barr 1981), |x/a|^(2/e2) + |y/b|^(2/e2) to the power e2/e1, plus |z/c|^(2/e1), equal to
1: a, b, c are its half axes. Flakes lie in a slab of lacquer with its surface at z = 0 and its substrate at z =
-depth; x and y go from 0 to the slab's size. The same slab with the same seed has the same flakes. Flakes may
intersect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError


@dataclass(frozen=True)
class Slab:
    """A piece of nashiji. Defaults are assumed, with the paper's order of magnitude (depth below 1 mm)."""

    size_mm: tuple[float, float] = (20.0, 20.0)
    depth_mm: float = 0.4
    flakes_per_mm2: float = 6.0
    flake_radius_mm: float = 0.12
    """Median half axis a, and b on average."""
    radius_spread: float = 0.3
    """Standard deviation of the logarithm of the radius."""
    elongation_spread: float = 0.2
    """Standard deviation of the logarithm of b/a."""
    flake_thickness_mm: float = 0.002
    """2 c: thickness of a beaten foil that is cut into flakes."""
    tilt_deg: float = 8.0
    """Root mean square slope of the flakes against the slab's plane, as an angle."""
    roundness: tuple[float, float] = (0.3, 0.8)
    """e1 and e2: 1 gives an ellipsoid; values near 0 give a box."""
    seed: int = 1
    flattens: bool = False
    """True if a flake that is too steep for the lacquer is tilted only as far as it fits; if False, it is
    refused."""


@dataclass(frozen=True)
class Flakes:
    """n flakes: rotations `slab_from_flake`, centres and half axes."""

    slab: Slab
    centres_mm: Array
    """[n, 3]."""
    slab_from_flake: Array
    """[n, 3, 3]; the third column is the flake's normal."""
    half_axes_mm: Array
    """[n, 3], a, b, c."""

    @property
    def normals(self) -> Array:
        return self.slab_from_flake[:, :, 2]


def flakes(slab: Slab) -> Flakes:
    """The slab's flakes, each entirely between surface and substrate."""
    rng = np.random.default_rng(slab.seed)
    n = rng.poisson(slab.flakes_per_mm2 * slab.size_mm[0] * slab.size_mm[1])
    radius = slab.flake_radius_mm * np.exp(slab.radius_spread * rng.standard_normal(n))
    stretch = np.exp(0.5 * slab.elongation_spread * rng.standard_normal(n))
    half_axes = np.stack([radius / stretch, radius * stretch, np.full(n, 0.5 * slab.flake_thickness_mm)], axis=1)
    turn, spin = rng.uniform(0.0, 2.0 * np.pi, n), rng.uniform(0.0, 2.0 * np.pi, n)
    # Slopes along x and y are normal and independent, so that the tilt's tangent is Rayleigh distributed.
    tilt = np.arctan(np.tan(np.radians(slab.tilt_deg)) * np.sqrt(0.5) * rng.rayleigh(1.0, n))
    if slab.flattens:
        room = np.maximum(0.5 * slab.depth_mm - half_axes[:, 2], 0.0) / np.hypot(half_axes[:, 0], half_axes[:, 1])
        tilt = np.minimum(tilt, np.arcsin(np.minimum(room, 1.0)))
    rotation = _about_z(turn) @ _about_y(tilt) @ _about_z(spin)
    # The box of the flake's half axes encloses it, so its vertical extent bounds the centre's depth.
    reach = np.einsum("nk,nk->n", np.abs(rotation[:, 2, :]), half_axes)
    room = slab.depth_mm - 2.0 * reach
    if np.any(room < 0.0):
        raise InputError(
            f"nashiji: expected flakes that fit into {slab.depth_mm} mm of lacquer; "
            f"{np.count_nonzero(room < 0.0)} of {n} need up to {2.0 * reach.max():.3f} mm; "
            "make the lacquer deeper, or the flakes flatter or smaller"
        )
    centres = np.empty((n, 3))
    centres[:, 0] = rng.uniform(0.0, slab.size_mm[0], n)
    centres[:, 1] = rng.uniform(0.0, slab.size_mm[1], n)
    centres[:, 2] = -reach - rng.uniform(0.0, 1.0, n) * room
    return Flakes(slab, centres, rotation, half_axes)


def triangulate(all_flakes: Flakes, *, around: int = 24, along: int = 6) -> tuple[Array, NDArray[np.int64]]:
    """Return corners [n * m, 3] in mm and triangles [n * k, 3] of all flakes, normals outwards, each flake closed.

    There are `around` corners about the normal on each of the `along` - 1 rings between two poles.
    """
    e1, e2 = all_flakes.slab.roundness
    eta = np.linspace(-0.5 * np.pi, 0.5 * np.pi, along + 1)[1:-1]
    omega = np.arange(around) * 2.0 * np.pi / around
    ring = np.stack([_power(np.cos(omega), e2), _power(np.sin(omega), e2), np.ones(around)], axis=-1)
    level = np.stack([_power(np.cos(eta), e1), _power(np.cos(eta), e1), _power(np.sin(eta), e1)], axis=-1)
    unit = np.concatenate([[[0.0, 0.0, -1.0]], (level[:, None] * ring).reshape(-1, 3), [[0.0, 0.0, 1.0]]])
    local = unit * all_flakes.half_axes_mm[:, None, :]
    corners = np.einsum("nij,nmj->nmi", all_flakes.slab_from_flake, local) + all_flakes.centres_mm[:, None, :]
    flake_faces = _faces(around, along)
    faces = flake_faces + (np.arange(len(corners)) * len(unit))[:, None, None]
    return corners.reshape(-1, 3), faces.reshape(-1, 3)


def settle_flakes(all_flakes: Flakes, tops_mm: Array, frames: Array) -> Flakes:
    """Return the same flakes, each with its depth and tilt, under a place [n, 3] of another surface.

    The third columns of `frames` [n, 3, 3] are the surface's outward normals at these places. A flake stays flat
    even where the surface is curved. So the flake deviates from the surface by its radius squared, divided by
    twice the surface's radius.
    """
    centres = tops_mm + all_flakes.centres_mm[:, 2:] * frames[:, :, 2]
    return replace(all_flakes, centres_mm=centres, slab_from_flake=frames @ all_flakes.slab_from_flake)


def _power(base: Array, exponent: float) -> Array:
    """Return a signed power, which the superquadric's angles need."""
    return np.sign(base) * np.abs(base) ** exponent


def _about_z(angle: Array) -> Array:
    c, s, o, i = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([c, -s, o, s, c, o, o, o, i], axis=-1).reshape(-1, 3, 3)


def _about_y(angle: Array) -> Array:
    c, s, o, i = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([c, o, s, o, i, o, -s, o, c], axis=-1).reshape(-1, 3, 3)


def _faces(around: int, along: int) -> NDArray[np.int64]:
    """Return the triangles of one flake: a fan about each pole, and two triangles for each field between rings."""
    k = np.arange(around)
    after = (k + 1) % around
    last = 1 + (along - 2) * around
    top = last + around
    fans = [
        np.stack([np.zeros_like(k), 1 + after, 1 + k], 1),
        np.stack([np.full_like(k, top), last + k, last + after], 1),
    ]
    for ring in range(along - 2):
        low, high = 1 + ring * around, 1 + (ring + 1) * around
        fans += [
            np.stack([low + k, low + after, high + after], 1),
            np.stack([low + k, high + after, high + k], 1),
        ]
    return np.concatenate(fans)
