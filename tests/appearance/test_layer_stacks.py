"""Stacks of layers against the matrix exponential with faces, photons in a layer, and energy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from coupole.appearance.matter import layered
from coupole.appearance.matter.four_flux import Layer
from coupole.appearance.matter.hemisphere import albedo
from coupole.appearance.matter.layer_stack import Binder, Ground, stack, stack_brdf
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.optics.thin_film import Film

GLAZE = Layer(2.0, 12.0, 1.5, 9.0, 3.0, 0.08)
BINDER = Binder(1.5)
ROW = 40
"""Of an angle of light in `layered.COSINES`."""


def matrix(layer: Layer, cosine: float) -> np.ndarray:
    """Derivatives of l+, l-, L+, L- with z; directed light is slanted."""
    k, s = float(layer.absorption), float(layer.scattering)
    direct, s_i, s_j = (float(v) / cosine for v in (layer.direct_absorption, layer.forward, layer.backward))
    mu = direct + s_i + s_j
    return np.array([[-mu, 0, 0, 0], [0, mu, 0, 0], [s_i, s_j, -(k + s), s], [-s_j, -s_i, -s, k + s]])


def by_exponentials(
    layers: list[Layer], ground: tuple[float, float, float], cosine_in_air: float
) -> tuple[float, float]:
    """Mirror image and diffuse light in air, over light from an angle, of layers from the top under a smooth face:
    four fluxes at the top are unknown, two boundary conditions are the face's, two the ground's."""
    n = 1.5
    cosine = np.sqrt(1.0 - (1.0 - cosine_in_air**2) / n**2)
    propagator = np.eye(4)
    for layer in layers:
        propagator = expm(matrix(layer, cosine) * float(layer.thickness_mm)) @ propagator
    face, inner = float(fresnel.reflectance(cosine_in_air, n)), float(fresnel.diffuse_internal(n))
    diffuse, directed, mirror = ground
    conditions = np.array(
        [
            [1.0, -face, 0.0, 0.0],
            [0.0, 0.0, 1.0, -inner],
            np.array([-mirror, 1.0, 0.0, 0.0]) @ propagator,
            np.array([-directed, 0.0, -diffuse, 1.0]) @ propagator,
        ]
    )
    fluxes = np.linalg.solve(conditions, [1.0 - face, 0.0, 0.0, 0.0])
    return (1.0 - face) * float(fluxes[1]), (1.0 - inner) * float(fluxes[3])


def ground(diffuse: float, directed: float, mirror: float) -> Ground:
    whole = np.ones((len(layered.COSINES), 81))
    return Ground(np.full(81, diffuse), directed * whole, mirror * whole)


def made(layers: list[Layer], below: Ground, roughness: float = 0.01) -> object:
    for layer in reversed(layers):
        below = BINDER.four_flux(below, layer)
    return stack(BINDER, below, roughness)


@pytest.mark.parametrize("row", [20, ROW, 64])
def test_two_glazes_over_a_glossy_ground_are_the_exponentials_at_any_angle(row: int) -> None:
    layers = [GLAZE, Layer(6.0, 2.0, 4.0, 1.0, 0.5, 0.03)]
    found = made(layers, ground(0.6, 0.1, 0.2), 1e-3)

    mirror, body = by_exponentials(layers, (0.6, 0.1, 0.2), float(layered.COSINES[row]))

    assert found.mirror[row, 0] == pytest.approx(mirror, rel=1e-6)
    assert found.body[row, 0] == pytest.approx(body, rel=2e-3)  # GGX of roughness 0.001 for the smooth face


def test_one_layer_is_the_same_in_two_parts() -> None:
    whole = BINDER.four_flux(ground(0.6, 0.1, 0.2), GLAZE)
    half = Layer(2.0, 12.0, 1.5, 9.0, 3.0, 0.04)
    parts = BINDER.four_flux(BINDER.four_flux(ground(0.6, 0.1, 0.2), half), half)
    paint = BINDER.two_flux(BINDER.matt(0.3), 3.0, 15.0, 0.1)
    paints = BINDER.two_flux(BINDER.two_flux(BINDER.matt(0.3), 3.0, 15.0, 0.06), 3.0, 15.0, 0.04)

    for name in ("diffuse", "directional", "mirror"):
        assert getattr(parts, name) == pytest.approx(getattr(whole, name), abs=1e-9)
    assert paints.diffuse == pytest.approx(paint.diffuse, abs=1e-12)


def test_a_stack_sends_back_what_its_tables_say_and_exchange_changes_nothing() -> None:
    found = made([GLAZE], ground(0.6, 0.1, 0.2), 0.2)
    random = np.random.default_rng(3).normal(size=(2, 50, 3))
    random[..., 2] = np.abs(random[..., 2]) + 0.05
    wi, wo = random / np.linalg.norm(random, axis=-1, keepdims=True)
    cosine = layered.COSINES[ROW]

    one_way, other_way = (stack_brdf(*pair, stack=found) for pair in ((wi, wo), (wo, wi)))
    body = stack_brdf(wi, wo, stack=found) - stack_brdf(wi, wo, stack=made([GLAZE], ground(0.0, 0.0, 0.0), 0.2))

    assert one_way == pytest.approx(other_way, rel=1e-9)
    assert body.min() > 0.0
    whole = albedo(lambda a, b: stack_brdf(a, b, stack=found)[..., :1], np.array([cosine]))[0, 0]
    gloss = 1.0 - found.coat.entering[ROW, 0] / np.mean(found.coat.sheet.transmittance[ROW, 0]) * (
        1.0 - found.coat.sheet.reflectance[ROW, 0]
    )
    assert whole == pytest.approx(gloss + found.body[ROW, 0] + found.mirror[ROW, 0], abs=0.015)


@pytest.mark.parametrize("cosine", [1.0, 0.5, 0.15])
def test_what_absorbs_nothing_over_a_white_ground_sends_all_light_back(cosine: float) -> None:
    white = made([Layer(0.0, 12.0, 0.0, 9.0, 3.0, 0.08)], ground(1.0, 1.0, 0.0), 0.1)

    whole = albedo(lambda a, b: stack_brdf(a, b, stack=white)[..., :1], np.array([cosine]))[0, 0]

    assert whole == pytest.approx(1.0, abs=6e-3)


def walked(cosine: float, scattered: float, absorbed: float, thickness: float, photons: int) -> float:
    """Share of photons from one direction that leave a layer over black upwards; all directions after scattering
    alike, no faces."""
    random = np.random.default_rng(2)
    depth, way = np.zeros(photons), np.full(photons, cosine)
    weight, left = np.ones(photons), 0.0
    while len(depth):
        depth = depth - np.log(random.random(len(depth))) / scattered * way
        left += float(weight[depth < 0.0].sum())
        inside = (depth >= 0.0) & (depth <= thickness) & (weight > 1e-6)
        depth, weight = depth[inside], weight[inside] * scattered / (scattered + absorbed)
        way = 2.0 * random.random(len(depth)) - 1.0
    return left / photons


def test_a_thin_layer_grows_brighter_towards_grazing_light_as_photons_say() -> None:
    # Isotropic scattering 5 per mm: half of it goes forwards; S of two fluxes is 3/4 of it (Mudgett 1971).
    layer = Layer(0.0, 0.75 * 5.0, 0.0, 2.5, 2.5, 0.1)
    found = BINDER.four_flux(BINDER.matt(0.0), layer)
    cosines = BINDER.cosines[[64, 0], 0]

    by_photons = [walked(float(c), 5.0, 1e-9, 0.1, 60_000) for c in cosines]

    assert found.directional[[64, 0], 0] == pytest.approx(by_photons, rel=0.12)
    assert by_photons[1] > 1.2 * by_photons[0]


def test_a_leaf_under_the_face_alone_is_the_leaf_of_thin_films() -> None:
    import tmm

    gold = indices.gold()
    found = BINDER.leaf(BINDER.matt(0.0), [Film(gold, 40.0)], 0.1)
    angle = float(np.arccos(BINDER.cosines[ROW, 0]))
    expected = [
        tmm.coh_tmm(polarisation, [1.5, gold[32], 1.5], [np.inf, 40.0, np.inf], angle, 540.0)["R"]
        for polarisation in "sp"
    ]

    assert found.mirror[ROW, 32] == pytest.approx(np.mean(expected), rel=1e-6)
    assert found.directional.max() == 0.0


def test_facets_under_a_face_look_as_much_steeper_as_refraction_makes_them() -> None:
    # Snell's law for rays along the normal through a rough face to rough facets and back.
    random = np.random.default_rng(1)
    face, facets = 0.02, 0.03
    slopes = [random.normal(scale=np.sqrt(0.5) * a, size=200_000) for a in (face, facets, face)]
    ray = slopes[0] - np.arcsin(np.sin(slopes[0]) / 1.5)
    ray = 2.0 * slopes[1] - ray
    leaving = slopes[2] + np.arcsin(1.5 * np.sin(ray - slopes[2]))
    seen = stack(BINDER, BINDER.mirroring(BINDER.matt(0.0), 0.5, facets), face).mirror_roughness

    assert seen == pytest.approx(np.std(0.5 * leaving) / np.sqrt(0.5), rel=0.02)
