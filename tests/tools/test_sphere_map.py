"""The sphere map against the BRDF itself."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from coupole.appearance.matter import brdf, tabulated
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

import sphere_map

EYE = np.array([0.0, -0.6, 0.8])
LIGHTS = np.array([[0.3, -0.9, 0.4], [-0.8, -0.2, 0.6], [0.1, 0.7, 0.7], [0.0, -0.6, 0.8]])
LIGHTS /= np.linalg.norm(LIGHTS, axis=1, keepdims=True)
POWER = np.array([[1.0, 0.8, 0.6], [0.5, 1.0, 2.0], [2.0, 1.5, 1.0], [0.2, 0.2, 0.3]])
GOLD = partial(brdf.ggx, roughness=0.15, fresnel=fresnel.of_index(indices.gold()[[54, 34, 14]]))


@pytest.fixture(scope="module")
def table() -> tabulated.SpecularTable:
    return tabulated.tabulate(GOLD, np.arange(0.0, 88.1, 2.5), theta_nodes=60)


def normals_seen() -> Array:
    made = np.random.default_rng(4).normal(size=(8000, 3))
    made /= np.linalg.norm(made, axis=1, keepdims=True)
    up = made @ LIGHTS.T
    return np.asarray(made[(made @ EYE > 0.1) & ((up > 0.1) | (up < 0.0)).all(axis=1)])


def direct(normals: Array) -> Array:
    total = np.zeros((len(normals), 3))
    for number, n in enumerate(normals):
        # A frame of the surface by QR, whose third column is the normal.
        frame = np.linalg.qr(np.stack([n, [0.3, 0.5, 0.7], [0.9, -0.2, 0.1]], axis=1))[0][:, [1, 2, 0]]
        frame[:, 2] = n
        for to_light, power in zip(LIGHTS, POWER, strict=True):
            if n @ to_light > 0.0:
                total[number] += GOLD(frame.T @ to_light, frame.T @ EYE) * (n @ to_light) * power
    return total


def test_the_map_has_the_radiance_of_each_normal(table: tabulated.SpecularTable) -> None:
    normals = normals_seen()[:1500]
    true = direct(normals)

    found = sphere_map.sphere_map(table, EYE, LIGHTS, POWER)

    missed = np.abs(found.at(normals) - true) / true.max()
    assert found.vertices == 4 * 60 * sphere_map.PHI_NODES
    assert missed.max() < 0.01
    assert missed.mean() < 1e-3


def test_a_map_of_several_lights_is_the_sum_of_theirs(table: tabulated.SpecularTable) -> None:
    normals = normals_seen()
    each = [
        sphere_map.sphere_map(table, EYE, light, power).at(normals)
        for light, power in zip(LIGHTS, POWER, strict=True)
    ]
    assert sphere_map.sphere_map(table, EYE, LIGHTS, POWER).at(normals) == pytest.approx(np.sum(each, axis=0))


def test_the_picture_is_a_sphere_whose_highlight_is_halfway_to_the_light(table: tabulated.SpecularTable) -> None:
    light = np.array([0.0, 0.6, 0.8])  # above the eye, which looks up from -y: halfway is +z
    made = sphere_map.sphere_map(table, EYE, light, np.ones(3)).picture(101)
    row, column = np.unravel_index(np.argmax(made[..., 0]), made.shape[:2])
    assert column == 50
    assert row == pytest.approx(50 - 50.5 * 0.6, abs=1.5)
    assert not made[0, 0].any()


def test_lights_without_irradiance_are_refused(table: tabulated.SpecularTable) -> None:
    with pytest.raises(InputError, match="irradiances"):
        sphere_map.sphere_map(table, EYE, LIGHTS, np.ones(3))
