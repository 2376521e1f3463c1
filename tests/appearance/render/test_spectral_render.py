"""Rendered spectra against closed forms and data that the renderer has not seen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from spectral_scenes import camera, constant, everywhere, illuminant, plane, rendered, scene

from coupole.appearance.matter import gilding, kubelka_munk, typical
from coupole.appearance.matter.glossy_face import InternalReflectance, face
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.render import bands, colour
from coupole.appearance.render.rendering import Spectral, degree_of_linear_polarisation
from coupole.appearance.render.spectra import luminous, scaled_power
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import WAVELENGTHS_NM

Scale = Callable[[int, int], int]
GREY = {"kind": "diffuse", "reflectance": constant(0.5)}
DOWNWARDS = {"kind": "distant", "direction": [0, 0, -1], "illuminance_lux": 500.0, "spectrum": illuminant("A")}


def test_a_diffuse_plane_sends_reflectance_times_irradiance_over_pi_in_each_of_81_bands() -> None:
    red = {"kind": "diffuse", "reflectance": {"kind": "shape", "name": "red_shape"}}
    found = rendered(scene([plane(red)], [DOWNWARDS], samples=1))
    expected = typical.reflectance("red_shape").values * scaled_power(light.illuminant("A"), 500.0) / np.pi
    assert found.wavelengths_nm == pytest.approx(WAVELENGTHS_NM)
    # 1e-4 of the paths fall on the ramps between quarters.
    assert found.radiance.mean(axis=(0, 1)) == pytest.approx(expected, rel=1e-3)


def test_bands_20_nm_apart_are_the_same_as_those_5_nm_apart() -> None:
    every, some = (
        rendered(scene([plane(GREY)], [DOWNWARDS], samples=1, bands={"step_nm": step})) for step in (5, 20)
    )
    means = bands.around_nodes(every.radiance.mean(axis=(0, 1)), 20)[bands.rendered_bands(20)]
    assert some.radiance.mean(axis=(0, 1)) == pytest.approx(means, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "observer"), [("D65", "10 deg"), ("A", "10 deg"), ("E", "10 deg"), ("D65", "2 deg")]
)
def test_a_white_diffuser_has_the_illuminants_white_point(name: str, observer: light.Observer) -> None:
    import colour as colour_science

    white = {"kind": "diffuse", "reflectance": constant(1.0)}
    one = scene([plane(white)], [{**DOWNWARDS, "spectrum": illuminant(name)}], samples=1, observer=observer)
    power = light.illuminant(name)
    xyz = colour.eye(observer, power, power, 5).tristimulus(rendered(one).radiance.mean(axis=(0, 1)))
    published = {"10 deg": "CIE 1964 10 Degree Standard Observer", "2 deg": "CIE 1931 2 Degree Standard Observer"}
    x, y = colour_science.CCS_ILLUMINANTS[published[observer]][name]
    assert xyz[:2] / xyz.sum() == pytest.approx([x, y], rel=1e-3)


def test_luminance_is_what_the_lights_photometric_amount_says() -> None:
    found = rendered(scene([plane(GREY)], [DOWNWARDS], samples=1))
    assert luminous(found.radiance.mean(axis=(0, 1))) == pytest.approx(0.5 * 500.0 / np.pi, rel=1e-3)


@pytest.mark.parametrize("elevation_deg", [90, 45])
def test_a_gold_mirror_reflects_as_fresnel_says_of_its_index(elevation_deg: float) -> None:
    gold = {"kind": "metal", "roughness": 0.01}
    one = scene(
        [plane(gold)],
        [everywhere(illuminant("E"))],
        cameras=[camera(elevation_deg)],
        samples=1024,
        bands={"step_nm": 10},
    )
    reflected = rendered(one).radiance.mean(axis=(0, 1)) / scaled_power(light.illuminant("E"), 100.0)[::2]
    cosine = np.sin(np.radians(elevation_deg))
    assert reflected == pytest.approx(fresnel.reflectance(cosine, indices.gold())[::2], abs=2e-3)  # 4 sigma


def test_paint_over_a_ground_returns_what_kubelka_munk_and_saunderson_say(scale: Scale) -> None:
    paint = {
        "kind": "paint",
        "pigment": {"kind": "shape", "name": "blue_one_peak_shape"},
        "thickness_mm": 0.05,
        "ground": constant(0.9),
        "scattering_per_mm": 8.0,
        "roughness": 0.01,
    }
    one = scene([plane(paint)], [everywhere(illuminant("E"))], samples=scale(64, 1024), bands={"step_nm": 20})
    reflected = rendered(one).radiance.mean(axis=(0, 1)) / scaled_power(light.illuminant("E"), 100.0)[::4]
    k = kubelka_munk.k_over_s(typical.reflectance("blue_one_peak_shape").values) * 8.0
    inside = kubelka_munk.over(*kubelka_munk.layer(k, 8.0, 0.05), 0.9)
    gloss = fresnel.reflectance(1.0, 1.5)
    seen = face(1.5).reflectance_in_air(InternalReflectance(inside)).values
    assert reflected == pytest.approx((gloss + seen)[::4], rel=0.02)


def test_a_measured_paint_is_shown_as_it_was_measured(scale: Scale, tmp_path: Path) -> None:
    (tmp_path / "half.csv").write_text("nm,R\n380,0.5\n580,0.5\n780,0.5\n")
    measured = {"kind": "file", "path": str(tmp_path / "half.csv")}
    paint = {"kind": "paint", "pigment": measured, "roughness": 0.01}
    one = scene([plane(paint)], [everywhere(illuminant("E"))], samples=scale(64, 1024), bands={"step_nm": 40})
    reflected = rendered(one).radiance.mean(axis=(0, 1)) / scaled_power(light.illuminant("E"), 100.0)[::8]
    assert reflected - fresnel.reflectance(1.0, 1.5) == pytest.approx(np.full(11, 0.5), rel=0.02)


@pytest.mark.parametrize("thickness_nm", [0.0, 25.0, 100.0])
def test_a_gilt_returns_mirror_and_bole_as_its_films_say(thickness_nm: float, scale: Scale) -> None:
    gilt = {"kind": "gilt", "thickness_nm": thickness_nm, "roughness": 0.01, "bole_roughness": 0.01}
    one = scene([plane(gilt)], [everywhere(illuminant("E"))], samples=scale(64, 1024), bands={"step_nm": 20})
    reflected = rendered(one).radiance.mean(axis=(0, 1)) / scaled_power(light.illuminant("E"), 100.0)[::4]
    expected = sum(gilding.reflectances(gilding.gilt(indices.gold(), thickness_nm, typical.bole())))
    assert reflected == pytest.approx(np.asarray(expected)[::4], rel=0.02, abs=2e-3)


BREWSTER = camera(90.0 - float(np.degrees(np.arctan(1.5))))


def reflected_by_glass(up: list[float]) -> Spectral:
    """Light of all directions that a dark glass of index 1.5 reflects at Brewster's angle."""
    glass = {"kind": "lacquer", "body": constant(0.0), "index": 1.5, "roughness": 0.01}
    view = {**BREWSTER, "up": up}
    lights = [everywhere(illuminant("E"))]
    return rendered(
        scene([plane(glass)], lights, cameras=[view], polarisation=True, samples=64, bands={"step_nm": 40})
    )


def test_glass_at_brewsters_angle_polarises_what_it_reflects_across_the_plane_of_incidence() -> None:
    found = reflected_by_glass([0, 0, 1])
    s0, s1, s2, s3 = found.stokes.mean(axis=(1, 2, 3))
    assert np.median(degree_of_linear_polarisation(found.stokes)) > 0.99
    assert [s1 / s0, s2 / s0, s3 / s0] == pytest.approx([1.0, 0.0, 0.0], abs=0.01)


def test_a_camera_rolled_by_45_degrees_sees_that_light_as_s2() -> None:
    elevation = np.arctan2(BREWSTER["position_mm"][2], BREWSTER["position_mm"][0])
    # To the right of this camera is +y; upright is across the view, in the plane of x and z.
    upright, right = np.array([-np.sin(elevation), 0.0, np.cos(elevation)]), np.array([0.0, 1.0, 0.0])
    s0, s1, s2, _ = reflected_by_glass((upright + right).tolist()).stokes.mean(axis=(1, 2, 3))
    assert [s1 / s0, s2 / s0] == pytest.approx([0.0, 1.0], abs=0.01)


def test_the_same_seed_gives_the_same_bits_and_another_seed_others() -> None:
    one = scene([plane(GREY)], [everywhere(illuminant("D65"))], bands={"step_nm": 40})
    first, again, other = (rendered(one.model_copy(update={"seed": seed})).radiance for seed in (7, 7, 8))
    assert first.tobytes() == again.tobytes()
    assert first.tobytes() != other.tobytes()


def test_light_that_misses_everything_leaves_bands_equally_noisy_but_not_coloured() -> None:
    one = scene([plane(GREY)], [everywhere(illuminant("E"))], samples=4, bands={"step_nm": 20})
    radiance = rendered(one).radiance
    ratio = radiance / radiance[..., :1]
    assert radiance.std() > 0.0
    assert ratio == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("transform", ["CAT16", "Bradford"])
def test_adaptation_agrees_with_colour_science(transform: str) -> None:
    import colour as colour_science

    white, stimulus = np.array([1.1, 1.0, 0.35]), np.array([0.3, 0.25, 0.1])
    d65 = np.array([0.95047, 1.0, 1.08883])
    matrix = colour_science.adaptation.matrix_chromatic_adaptation_VonKries(white, d65, transform=transform)
    assert colour.adapted_xyz(stimulus, white, transform) == pytest.approx(matrix @ stimulus, rel=1e-4)
    assert colour.adapted_xyz(white, white, transform) == pytest.approx(d65)
