"""Sphere maps of gold under ten lights: time to compute a map again when lights move, and its error.

The limit is 2 ms; the paper (Durikovic et al. 2002, section 3.3) needed a few tens of milliseconds for ten lights
in 2002.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

import sphere_map
from coupole.appearance.matter import brdf, tabulated
from coupole.appearance.optics import fresnel, indices

LIGHTS, LIMIT_MS = 10, 2.0
_HORIZON_Z = 0.1
_NORMALS = 20_000


def figures(rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    gold = fresnel.of_index(indices.gold()[[54, 34, 14]])
    maps, nodes = (1, 20) if smallest else (20 * rounds, 60)
    for roughness in (0.25,) if smallest else (0.25, 0.1, 0.05):
        source = partial(brdf.ggx, roughness=roughness, fresnel=gold)
        table = tabulated.tabulate(source, np.arange(0.0, 88.1, 2.5), theta_nodes=nodes)
        random = np.random.default_rng(1)
        eye = _unit(np.array([0.0, -0.5, 0.8]))
        took_ms = []
        for _ in range(maps + 1):
            lights, power = (
                _unit(random.normal(size=(LIGHTS, 3)) + 1.2 * eye),
                random.uniform(0.5, 2.0, (LIGHTS, 3)),
            )
            start = time.perf_counter()
            precomputed_map = sphere_map.sphere_map(table, eye, lights, power)
            took_ms.append(1e3 * (time.perf_counter() - start))
        value = statistics.median(took_ms[1:])
        normals = _unit(random.normal(size=(_NORMALS, 3)))
        up = normals @ lights.T
        normals = normals[(normals @ eye > _HORIZON_Z) & ((up > _HORIZON_Z) | (up < 0.0)).all(axis=1)]
        true = direct(source, normals, eye, lights, power)
        errors = np.abs(precomputed_map.at(normals) - true) / true.max()
        yield {
            "name": f"sphere_map_ten_lights_roughness_{roughness:g}",
            "value": value,
            "unit": "ms",
            "peer": "limit_2_ms",
            "ratio": LIMIT_MS / value,
            "vertices": precomputed_map.vertices,
            "most_missed_of_peak": round(float(errors.max()), 5),
            "missed_of_peak_on_average": round(float(errors.mean()), 6),
        }


def direct(source: brdf.Brdf, normals: np.ndarray, eye: np.ndarray, lights: np.ndarray, power: np.ndarray) -> Any:
    """Return the radiance [n, bands] by the BRDF itself."""
    first = _unit(np.cross(np.where(np.abs(normals[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), normals))
    local = np.stack([first, np.cross(normals, first), normals], axis=1)
    total = np.zeros((len(normals), power.shape[1]))
    for light, irradiance in zip(lights, power, strict=True):
        total += source(local @ light, local @ eye) * np.maximum(normals @ light, 0.0)[:, None] * irradiance
    return total


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
