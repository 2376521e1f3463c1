"""Photons in a gilded niche: the nephroid, and the books of light."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from spectral_scenes import HERE, constant, everywhere, illuminant, rendered, scene

from coupole.appearance.matter import layered
from coupole.appearance.optics import indices
from coupole.appearance.optics.thin_film import Film
from coupole.appearance.render import by_gold
from coupole.appearance.render.arcature import arcature
from coupole.appearance.render.caustic import Niche, Sun, irradiance, photons
from coupole.appearance.render.scene_file import Gathered, with_plain_lights
from coupole.appearance.render.spectra import scaled_power
from coupole.appearance.shapes.triangles import flat_normals
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import BANDS, Array
from coupole.errors import InputError

Scale = Callable[[int, int], int]
RADIUS_MM, HEIGHT_MM, DEPTH_MM = 400.0, 600.0, 300.0
OPENING_MM = (-RADIUS_MM, RADIUS_MM, HEIGHT_MM + RADIUS_MM)


def niche(reflectance: float = 1.0, roughness: float = 0.0) -> Niche:
    parts = arcature(RADIUS_MM, HEIGHT_MM, DEPTH_MM)

    def grey(cosines: Array) -> Array:
        return np.full((len(cosines), BANDS), reflectance)

    return Niche(parts.gilded_mm, parts.stone_mm, grey, roughness)


def sun(across: float, width_deg: float = 0.0) -> Sun:
    """Level light that goes `across` to the right for each unit into the niche."""
    direction = np.array([across, 1.0, 0.0])
    return Sun(direction / np.linalg.norm(direction), width_deg, np.ones(BANDS))


def test_triangles_of_the_niche_face_its_inside_and_the_viewer() -> None:
    parts = arcature(RADIUS_MM, HEIGHT_MM, DEPTH_MM)
    inside = np.array([0.0, 0.5 * DEPTH_MM, 0.5 * HEIGHT_MM])
    for corners in (parts.gilded_mm, parts.stone_mm):
        middles, normals = corners.mean(axis=1), flat_normals(corners)
        in_front = np.abs(middles[:, 1]) < 1e-6
        towards = np.where(in_front[:, None] & (np.abs(normals[:, 1:2]) > 0.5), [0.0, -1.0, 0.0], inside - middles)
        assert np.all(np.sum(normals * towards, axis=1) > 0.0)


def nephroid(angles: Array) -> Array:
    """Points [n, 2] where parallel light along +x that the inside of a unit circle reflects once is densest.

    A ray that meets the circle at (cos t, sin t) turns to (-cos 2t, -sin 2t) and touches its neighbour
    (cos t)/2 later; the cusp, t = 0, lies halfway between centre and circle (Huygens 1690).
    """
    x = np.cos(angles) * (1.0 - 0.5 * np.cos(2.0 * angles))
    y = np.sin(angles) - 0.5 * np.cos(angles) * np.sin(2.0 * angles)
    return np.stack([x, y], axis=-1)


def test_light_reflected_once_by_the_arch_stays_on_its_side_of_the_nephroid(scale: Scale) -> None:
    found = photons(niche(), sun(2.0), OPENING_MM, scale(200_000, 2_000_000), seed=1)
    x, z = ((found.places_mm[:, [0, 2]] - [0.0, HEIGHT_MM]) / RADIUS_MM).T
    at_back = (np.abs(found.places_mm[:, 1] - DEPTH_MM) < 0.5) & (found.bounces == 1) & (z > 0.0)
    # Of each height, the nephroid's branch through the cusp is the farthest that reflected light piles up.
    angles = np.linspace(0.0, np.pi / 2, 400)
    curve = nephroid(angles)
    for low, high in ((0.02, 0.06), (0.10, 0.14), (0.20, 0.24)):
        band = at_back & (z > low) & (z < high)
        density, edges = np.histogram(x[band], bins=60, range=(-0.2, 1.0))
        brightest = 0.5 * (edges[:-1] + edges[1:])[np.argmax(density)]
        assert brightest == pytest.approx(np.interp(0.5 * (low + high), *curve[:300, ::-1].T), abs=0.03)


def test_light_is_neither_made_nor_lost_by_a_perfect_mirror() -> None:
    found = photons(niche(), sun(1.5, 0.53), OPENING_MM, 20_000, seed=2)
    assert found.power.sum(axis=0, dtype=float) + found.escaped_power == pytest.approx(
        found.started_power, rel=1e-5
    )


def test_gold_that_reflects_half_leaves_half_of_each_bounce() -> None:
    whole, half = (photons(niche(share), sun(1.5), OPENING_MM, 20_000, seed=2) for share in (1.0, 0.5))
    np.testing.assert_allclose(half.power, whole.power * 0.5 ** whole.bounces[:, None], rtol=1e-5)


def test_where_the_sun_shines_directly_the_wall_has_its_irradiance_times_the_cosine() -> None:
    found = photons(niche(0.0), sun(0.5), OPENING_MM, 200_000, seed=3)
    lit = irradiance(found, (0.0, 200.0), 400.0, 100.0, DEPTH_MM)
    assert lit.shape == (4, 2, BANDS)
    assert lit == pytest.approx(1.0 / np.hypot(1.0, 0.5), rel=0.1)
    assert lit.mean() == pytest.approx(1.0 / np.hypot(1.0, 0.5), rel=0.02)


def test_rough_gold_spreads_light_but_does_not_make_any() -> None:
    found = photons(niche(roughness=0.2), sun(1.5), OPENING_MM, 20_000, seed=4)
    returned = found.power.sum(axis=0, dtype=float) + found.escaped_power
    assert np.all(returned <= found.started_power * (1.0 + 1e-6))
    assert np.all(returned > 0.9 * found.started_power)  # what facets hide from each other is lost


@pytest.mark.full
def test_photons_and_the_path_tracer_see_the_same_light_on_the_wall(scale: Scale) -> None:
    width_deg, lux, grey = 20.0, 1000.0, 1e-4
    way = np.array([0.9, 0.43, -0.03])
    black = {"kind": "diffuse", "reflectance": constant(grey)}
    gold = {"kind": "gilt", "roughness": 0.2}
    thing = {"kind": "arcature", "height_mm": 300, "depth_mm": 350, "gilt": gold, "stone": black}
    sunlight = {
        "kind": "distant",
        "direction": way.tolist(),
        "illuminance_lux": lux,
        "width_deg": width_deg,
        "spectrum": illuminant("E"),
    }
    x, z, side_mm = 100.0, 250.0, 100.0
    inside = {
        "name": "main",
        "position_mm": [x, 5.0, z],
        "target_mm": [x, 350.0, z],
        "optics": {"kind": "field", "degrees": float(2 * np.degrees(np.arctan(0.5 * side_mm / 345.0)))},
        "width_px": 8,
        "height_px": 8,
    }
    samples = scale(2048, 16384)
    one = scene([thing], [sunlight], cameras=[inside], samples=samples, depth=6, bands={"step_nm": 40})
    traced = rendered(one).radiance.mean(axis=(0, 1)) * np.pi / grey
    leaf = layered.sheet([Film(indices.gold(), 100.0)], indices.EGG_WHITE).reflectance
    parts = arcature(400.0, 300.0, 350.0)
    lined = Niche(parts.gilded_mm, parts.stone_mm, lambda cosines: layered.at_cosine(leaf, cosines), 0.2)
    source = Sun(way / np.linalg.norm(way), width_deg, scaled_power(light.illuminant("E"), lux))
    found = photons(lined, source, (-400.0, 400.0, 700.0), scale(300_000, 4_000_000), seed=5)
    lit = irradiance(found, (x - side_mm / 2, x + side_mm / 2), 300.0, side_mm, 350.0)[0, 0, ::8]
    assert lit == pytest.approx(traced, rel=0.06)  # 0.015 with four times the samples


def test_photons_gathered_by_the_eye_and_paths_alone_make_the_same_picture(scale: Scale) -> None:
    """Of a niche of stone that reflects, with wide sun and rough gold, which paths find too."""
    stone = {"kind": "diffuse", "reflectance": constant(0.5)}
    thing = {"kind": "arcature", "height_mm": 300, "depth_mm": 350, "gilt": {"kind": "gilt", "roughness": 0.4}}
    sunlight = {"kind": "distant", "direction": [0.9, 0.43, -0.03], "illuminance_lux": 1000.0, "width_deg": 45.0}
    outside = {
        "name": "main",
        "position_mm": [-100, -1200, 420],
        "target_mm": [0, 100, 380],
        "optics": {"kind": "field", "degrees": 34},
        "width_px": 16,
        "height_px": 16,
    }
    one = scene(
        [{**thing, "stone": stone}],
        [{**sunlight, "spectrum": illuminant("E")}, everywhere(illuminant("D65"), 2.0)],
        cameras=[outside],
        samples=scale(256, 8000),
        depth=10,
        bands={"step_nm": 40},
    )
    plain = with_plain_lights(one, HERE)
    wanted = Gathered(photons=scale(60_000, 2_000_000), radius_mm=8.0)
    gathered = by_gold.render(plain, wanted, plain.cameras[0], HERE, lambda done, total: None).radiance
    traced = rendered(one).radiance
    inside = (slice(2, 15), slice(4, 12))  # where the niche is seen
    assert gathered[inside].sum(axis=(0, 1)) == pytest.approx(
        traced[inside].sum(axis=(0, 1)), rel=scale(6, 2) / 100
    )
    without = by_gold.render(
        plain, Gathered(photons=1000, radius_mm=0.01), plain.cameras[0], HERE, lambda done, total: None
    ).radiance
    assert without[inside].sum() < 0.97 * traced[inside].sum()  # what photons add can be seen


def test_what_photons_do_not_know_is_refused() -> None:
    wanted = with_plain_lights(
        scene(
            [{"kind": "sphere", "radius_mm": 20, "material": {"kind": "lacquer"}}],
            [{"kind": "distant", "direction": [0, 0, -1], "illuminance_lux": 10.0, "spectrum": illuminant("E")}],
            gathered={},
        ),
        HERE,
    )
    assert wanted.gathered is not None
    with pytest.raises(
        InputError, match="`gathered` expected materials `diffuse`, `gilt` and bare `metal`, found `lac"
    ):
        by_gold.render(wanted, wanted.gathered, wanted.cameras[0], HERE, lambda done, total: None)
