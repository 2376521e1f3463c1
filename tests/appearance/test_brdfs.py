"""White furnace, reciprocity and bounds of every BRDF, and the books of the layered one."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from coupole.appearance.matter import brdf, hemisphere, layered, makie, tabulated
from coupole.appearance.matter.brdf import Brdf
from coupole.appearance.matter.glossy_face import InternalReflectance, face
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.spectra.grid import BANDS, Array

WHITE = InternalReflectance(np.ones(BANDS))
COSINES = np.array([0.05, 0.2, 0.5, 0.8, 1.0])


def mirror_all(cosines: Array) -> Array:
    """Facets that reflect everything."""
    return np.ones((*np.shape(cosines), 1))


def of_gold(cosines: Array) -> Array:
    """The share that gold reflects, in five bands."""
    reflected: Array = fresnel.of_index(indices.gold()[::20])(cosines)
    return reflected


def table_of_gold() -> Brdf:
    source = partial(brdf.ggx, roughness=0.2, fresnel=mirror_all)
    return partial(tabulated.tabulated_brdf, table=tabulated.tabulate(source, np.arange(0.0, 90.0, 5.0)))


BRDFS: dict[str, Brdf] = {
    "lambert": partial(brdf.lambert, reflectance=1.0),
    "oren-nayar": partial(brdf.oren_nayar, reflectance=1.0, roughness=0.7),
    "smooth ggx": partial(brdf.ggx, roughness=0.05, fresnel=mirror_all),
    "rough ggx": partial(brdf.ggx, roughness=0.8, fresnel=mirror_all),
    "golden ggx": partial(brdf.ggx, roughness=0.2, fresnel=of_gold),
    "smooth cook-torrance": partial(brdf.cook_torrance, slope=0.1, fresnel=mirror_all),
    "rough cook-torrance": partial(brdf.cook_torrance, slope=0.6, fresnel=mirror_all),
    "lacquered white": partial(
        layered.layered_brdf, coat=layered.coat(layered.sheet([], indices.URUSHI), 0.1), body=WHITE
    ),
    "tabulated": table_of_gold(),
    "makie": partial(
        makie.makie_brdf,
        alpha=0.4,
        residual=np.array([0.5]),
        metallic=partial(brdf.ggx, roughness=0.2, fresnel=mirror_all),
    ),
}
EVERY_BRDF = pytest.mark.parametrize("f", BRDFS.values(), ids=BRDFS.keys())


@EVERY_BRDF
def test_no_surface_reflects_more_than_it_gets(f: Brdf) -> None:
    assert np.all(hemisphere.albedo(f, COSINES) <= 1.0 + 2e-3)


@EVERY_BRDF
def test_light_takes_the_same_path_both_ways(f: Brdf) -> None:
    rng = np.random.default_rng(1)
    one, other = (hemisphere.directions(rng.uniform(0.02, 1.0, 200), rng.uniform(0.0, 6.3, 200)) for _ in range(2))

    there, back = f(one, other), f(other, one)

    assert np.all(there >= 0.0)
    assert there == pytest.approx(back, rel=1e-9, abs=1e-12)


@EVERY_BRDF
def test_nothing_is_seen_from_below_the_horizon(f: Brdf) -> None:
    up, down = np.array([[0.6, 0.0, 0.8]]), np.array([[0.6, 0.0, -0.8]])

    assert np.all(f(up, down) == 0.0)
    assert np.all(f(down, up) == 0.0)


def test_lambert_reflects_its_reflectance() -> None:
    f = partial(brdf.lambert, reflectance=[0.2, 0.7])

    assert hemisphere.albedo(f, COSINES) == pytest.approx(np.tile([0.2, 0.7], (5, 1)), abs=1e-3)


def test_a_smooth_oren_nayar_surface_is_lambertian() -> None:
    wi, wo = np.array([[0.6, 0.0, 0.8]]), np.array([[0.0, 0.28, 0.96]])

    assert brdf.oren_nayar(wi, wo, reflectance=0.5, roughness=0.0) == pytest.approx(0.5 / np.pi)


def test_rough_diffuse_surfaces_are_brighter_towards_the_light() -> None:
    towards, away = np.array([[0.8, 0.0, 0.6]]), np.array([[-0.8, 0.0, 0.6]])
    f = partial(brdf.oren_nayar, reflectance=0.5, roughness=0.8)

    assert f(towards, towards) > 2.0 * f(towards, away)


def test_ggx_of_roughness_one_has_a_closed_form_along_the_normal() -> None:
    # f = 1/(2 pi (1 + cos)): its albedo is 1 - ln 2.
    f = partial(brdf.ggx, roughness=1.0, fresnel=mirror_all)

    assert hemisphere.albedo(f, np.array([1.0]))[0, 0] == pytest.approx(1.0 - np.log(2.0), abs=1e-4)


def test_a_smooth_metals_lobe_holds_its_fresnel_reflectance() -> None:
    f = partial(brdf.ggx, roughness=0.02, fresnel=fresnel.of_index(indices.gold()))

    reflected = hemisphere.albedo(f, np.array([0.7]))[0]

    assert reflected == pytest.approx(fresnel.reflectance(0.7, indices.gold()), abs=5e-3)


def test_cook_torrance_in_the_papers_norm_would_create_light() -> None:
    f = partial(brdf.cook_torrance, slope=0.1, fresnel=mirror_all)

    assert hemisphere.albedo(f, np.array([1.0]))[0, 0] == pytest.approx(1.0, abs=5e-3)
    assert 4.0 * hemisphere.albedo(f, np.array([1.0]))[0, 0] > 3.9


@pytest.mark.parametrize("roughness", [0.05, 0.2, 0.6])
def test_a_white_body_under_clear_lacquer_returns_all_light(roughness: float) -> None:
    coat = layered.coat(layered.sheet([], 1.53), roughness)

    reflected = hemisphere.albedo(partial(layered.layered_brdf, coat=coat, body=WHITE), COSINES)

    assert reflected == pytest.approx(1.0, abs=2.5e-3)


def test_the_facets_table_agrees_with_the_brdf_it_stands_for() -> None:
    sheet = layered.sheet([], 1.5)
    gloss = partial(brdf.ggx, roughness=0.3, fresnel=lambda c: fresnel.reflectance(c[..., None], 1.5))

    entering = layered.at_cosine(layered.coat(sheet, 0.3).entering, COSINES)[:, :1]

    assert 1.0 - entering == pytest.approx(hemisphere.albedo(gloss, COSINES), abs=1e-3)


def test_paint_under_smooth_lacquer_is_what_saunderson_says() -> None:
    body = InternalReflectance(np.linspace(0.05, 0.95, BANDS))
    coat = layered.coat(layered.sheet([], 1.5), 0.002)

    gloss = partial(brdf.ggx, roughness=0.002, fresnel=fresnel.of_index(1.5))

    def diffuse(wi: Array, wo: Array) -> Array:
        return layered.layered_brdf(wi, wo, coat=coat, body=body) - gloss(wi, wo)

    assert hemisphere.albedo(diffuse, np.array([1.0]))[0] == pytest.approx(
        face(1.5).reflectance_in_air(body).values, abs=1e-3
    )
