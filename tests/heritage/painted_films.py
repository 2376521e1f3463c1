"""Specimens of paint films by others' means: the matrix exponential, and photons that walk in a layer.

Nothing of `coupole.appearance.matter` is used here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

FACE_OUT, FACE_IN = 0.04, 0.596
"""Reflectance of a face of index 1.5 along the normal, and for diffuse light from within (published tables)."""


def two_fluxes(k: float, s: float, h: float, ground: float) -> float:
    """Diffuse reflectance of a film over a ground: the boundary condition on the propagator."""
    propagator = expm(np.array([[-(k + s), s], [-s, k + s]]) * h)
    return float((ground * propagator[0, 0] - propagator[1, 0]) / (propagator[1, 1] - ground * propagator[0, 1]))


def four_fluxes(k: float, s: float, direct: float, s_i: float, s_j: float, h: float, ground: float) -> float:
    """Diffuse reflectance for directional light, of a film over a diffusing ground."""
    mu = direct + s_i + s_j
    equations = np.array([[-mu, 0, 0, 0], [0, mu, 0, 0], [s_i, s_j, -(k + s), s], [-s_j, -s_i, -s, k + s]])
    propagator = expm(equations * h)
    at_bottom = np.array([[0.0, 1.0, 0.0, 0.0], [-ground, 0.0, -ground, 1.0]])
    return float(np.linalg.solve(at_bottom @ propagator[:, [1, 3]], -at_bottom @ propagator[:, 0])[1])


def in_air(inside: np.ndarray | float) -> np.ndarray:
    """Under a glossy face, gloss excluded, along the normal (Saunderson)."""
    r = np.asarray(inside, dtype=float)
    return (1.0 - FACE_OUT) * (1.0 - FACE_IN) * r / (1.0 - FACE_IN * r)


@dataclass(frozen=True)
class Walk:
    """Photons that left a layer through its top, after a walk in which nothing was absorbed."""

    ground_hits: np.ndarray
    path: np.ndarray
    """In units of the mean free path."""

    def reflectance(self, absorbed_per_scattering: float, ground: float) -> float:
        """Of any absorption and any Lambertian ground: both only weigh the photons."""
        left = np.exp(-absorbed_per_scattering * self.path)
        return float(np.mean(np.where(self.ground_hits == 0, 1.0, ground**self.ground_hits) * left))


def _scattered(cosine: np.ndarray, mean_cosine: float, rng: np.random.Generator) -> np.ndarray:
    """Cosines to the layer's normal after one scattering."""
    drawn = rng.random(len(cosine))
    if mean_cosine == 0.0:
        return np.asarray(2.0 * drawn - 1.0)
    g = mean_cosine
    turn = (1.0 + g * g - ((1.0 - g * g) / (1.0 - g + 2.0 * g * drawn)) ** 2) / (2.0 * g)
    across = np.sqrt(np.maximum(1.0 - cosine**2, 0.0) * np.maximum(1.0 - turn**2, 0.0))
    return np.asarray(cosine * turn + across * np.cos(2.0 * np.pi * rng.random(len(cosine))))


def walk(optical_depth: float, photons: int, seed: int, mean_cosine: float = 0.0) -> Walk:
    """Lambertian light into a layer of grains over a Lambertian ground. The grains scatter to all sides alike, or
    with a mean cosine as Henyey and Greenstein have it."""
    rng = np.random.default_rng(seed)
    cosine = np.sqrt(rng.random(photons))
    depth, path, hits = np.zeros(photons), np.zeros(photons), np.zeros(photons, int)
    done: list[tuple[np.ndarray, np.ndarray]] = []
    while len(depth):
        free = -np.log(rng.random(len(depth)))
        to_face = np.where(cosine > 0.0, optical_depth - depth, -depth) / cosine
        arrives = free >= to_face
        step = np.where(arrives, to_face, free)
        path = path + step
        top, floor = arrives & (cosine < 0.0), arrives & (cosine > 0.0)
        done.append((hits[top], path[top]))
        hits = hits + floor
        depth = np.where(floor, optical_depth, depth + cosine * step)
        scattered = _scattered(cosine, mean_cosine, rng)
        turned = np.where(floor, -np.sqrt(rng.random(len(depth))), scattered)
        depth, path, hits, cosine = depth[~top], path[~top], hits[~top], turned[~top]
    return Walk(*(np.concatenate(part) for part in zip(*done, strict=True)))
