"""`coupole show SCENE`: gilding, makie and nashiji on the page, against other programs and closed forms."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
import tmm
import yaml
from browser import needs_chromium
from scipy.optimize import brentq
from shown_page import FIELD_DEG, HEIGHT, WIDTH, Page, opened_page

from coupole.appearance.matter import brdf, hemisphere, nashiji
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.render import rendering
from coupole.appearance.render.materials import Gilt
from coupole.appearance.render.scene_file import Scene
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.errors import InputError
from coupole.exchange.look.look_of_scenes import look_of_scene
from coupole.exchange.look.look_page import write_page
from coupole.exchange.look.scene_layers import ANGLES, COSINES, layers_of, tables

LUX = 1000.0
HALF = math.tan(math.radians(FIELD_DEG / 2))
ACROSS_DEG = 2.0 * math.degrees(math.atan(HALF * WIDTH / HEIGHT))


def scene_of(thing: dict[str, Any], *, illuminant: str = "D65", **more: Any) -> Scene:
    """One object under one distant light, seen by the page's camera of `Page.look(-70, 50, 300)`."""
    a, h = math.radians(-70.0), math.radians(50.0)
    camera = {
        "name": "main", "target_mm": [0, 0, 0], "width_px": WIDTH, "height_px": HEIGHT,
        "position_mm": [300 * math.cos(h) * math.cos(a), 300 * math.cos(h) * math.sin(a), 300 * math.sin(h)],
        "optics": {"kind": "field", "degrees": ACROSS_DEG},
    }  # fmt: skip
    lamp = {"kind": "distant", "direction": [0.4, 0.1, -0.8], "illuminance_lux": LUX}
    lamp["spectrum"] = {"kind": "illuminant", "name": illuminant}
    whole = {"schema_version": 1, "name": "case", "cameras": [camera], "objects": [thing], "lights": [lamp]}
    return Scene.model_validate(whole | more)


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with opened_page() as page:
        yield page


def opened(page: Page, scene: Scene, folder: Path, distance: float = 300.0) -> None:
    write_page(look_of_scene(scene, folder), "case", folder / "look.html")
    page.open(folder / "look.html")
    page.small()
    page.look(-70.0, 50.0, distance)


def linear(spectral: np.ndarray, illuminant: str) -> np.ndarray:
    """Linear sRGB of a reflectance [81] by colour-science, 10-degree observer, white 1."""
    import colour

    spectrum = colour.SpectralDistribution(spectral, WAVELENGTHS_NM)
    # The project's illuminant A is Planck's law at 2848 K of the scale of 1948; the shape is given, not looked up.
    power = colour.SpectralDistribution(light.illuminant(illuminant), WAVELENGTHS_NM)
    shape = colour.SpectralShape(380, 780, 5)
    cmfs = colour.MSDS_CMFS["CIE 1964 10 Degree Standard Observer"].copy().align(shape)
    xyz = colour.sd_to_XYZ(spectrum, cmfs, power, method="Integration") / 100.0
    found: np.ndarray = np.array(colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB) @ xyz
    return found


@pytest.mark.parametrize("illuminant", ["D65", "A"])
def test_a_thin_leaf_has_the_colour_of_an_independent_transfer_matrix(tmp_path: Path, illuminant: str) -> None:
    layers = layers_of(Gilt(kind="gilt", thickness_nm=40.0), tmp_path)
    powers = {name: light.illuminant(name) for name in ("D65", "A")}
    made = tables([(layers, False)], powers, "10 deg")[list(powers).index(illuminant), 0, 0]
    gold = indices.gold()
    for place in (0, ANGLES // 2, ANGLES - 1):
        angle = math.acos(COSINES[place])
        reflected = np.array([
            tmm.unpolarized_RT([1.0, index, indices.EGG_WHITE], [math.inf, 40.0, math.inf], angle, nm)["R"]
            for index, nm in zip(gold, WAVELENGTHS_NM, strict=True)
        ])  # fmt: skip
        np.testing.assert_allclose(made[place, :3], linear(reflected, illuminant), atol=2e-3)


@needs_chromium
@pytest.mark.parametrize(
    "material",
    [
        pytest.param({"kind": "gilt", "thickness_nm": 40, "uncovered": 0.1, "roughness": 0.3}, id="thin gilt"),
        pytest.param({"kind": "metal", "roughness": 0.3}, id="gold", marks=pytest.mark.full),
        pytest.param({"kind": "gilt", "roughness": 0.12}, id="gilt", marks=pytest.mark.full),
        pytest.param({"kind": "lacquer", "roughness": 0.2}, id="lacquer", marks=pytest.mark.full),
    ],
)
def test_gilding_looks_as_in_the_spectral_path_tracer(
    page: Page, tmp_path: Path, material: dict[str, Any]
) -> None:
    import colour

    thing = {"kind": "sculpted_relief", "size_mm": 80, "triangles": 3000, "material": material}
    scene = scene_of(thing, illuminant="A", samples=32, depth=1, bands={"step_nm": 20}, observer="2 deg")
    opened(page, scene, tmp_path)
    mine = page.picture(16)
    with rendering.open_renderer(scene, tmp_path) as renderer:
        radiance = renderer.render(scene.cameras[0]).radiance
    functions, power = light.observer("2 deg")[:, ::4], light.illuminant("A")[::4]
    theirs = colour.XYZ_to_sRGB(
        radiance @ functions.T / (LUX / np.pi / 683.0 / 20.0), apply_cctf_encoding=False
    )  # the renderer scales its light by 81 bands
    theirs *= (light.illuminant("A") @ light.observer("2 deg")[1]) / 4.0 / (power @ functions[1])
    whole = mine[..., 3] > 0.999
    assert whole.mean() > 0.2
    white = float(np.quantile(theirs[whole], 0.999))
    lab = [
        colour.XYZ_to_Lab(colour.RGB_to_XYZ(np.clip(one / white, 0.0, 1.0)[whole], "sRGB"), [0.3127, 0.329])
        for one in (mine[..., :3], theirs)
    ]
    off = colour.delta_E(*lab, method="CIE 2000")
    print(f"dE00: mean {off.mean():.2f}, median {np.median(off):.2f}, 95 % {np.quantile(off, 0.95):.2f}")
    assert off.mean() < 1.0
    assert np.median(off) < 0.6


@needs_chromium
def test_metal_covers_lacquer_by_its_share_under_lamp_and_sky(page: Page, tmp_path: Path) -> None:
    opened(page, scene_of({"kind": "makie_tile", "triangles": 2000}), tmp_path, distance=150.0)
    camera = "{target: [0, 0, 6], azimuth: -90, height: 60, distance: 2000, field: 0.5}"
    page.run(f"coupole.state = {{...coupole.state, camera: {camera}}}")
    page.run("coupole.setLight(0.3, 0.2, 0.9)")
    wi = np.array([0.3, 0.2, 0.9]) / np.linalg.norm([0.3, 0.2, 0.9])
    wo = np.array([0.0, -0.5, math.sqrt(0.75)])
    inside = 0.006 / (indices.URUSHI**2 * (1.0 - float(fresnel.diffuse_internal(indices.URUSHI)) * 0.006))

    def drawn(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        gold = brdf.ggx(wi, wo, roughness=0.25, fresnel=fresnel.of_index(indices.gold()))
        gloss = brdf.ggx(wi, wo, roughness=0.04, fresnel=fresnel.of_index(np.full(81, indices.URUSHI)))
        passing = [1.0 - fresnel.reflectance(np.maximum(w[..., 2], 1e-9), indices.URUSHI) for w in (wi, wo)]
        body = (passing[0] * passing[1] * inside / np.pi)[..., None]
        return np.asarray(0.95 * gold + 0.05 * (gloss + body))

    expected = linear(drawn(wi, wo) * np.pi * wi[2], "D65")
    np.testing.assert_allclose(page.picture(1)[HEIGHT // 2, WIDTH // 2, :3], expected, rtol=0.02)
    page.run("coupole.state = {...coupole.state, lights: [{...coupole.state.lights[0], strength: 0}], sky: 1}")
    expected = linear(hemisphere.albedo(drawn, np.array([wo[2]]))[0], "D65")
    np.testing.assert_allclose(page.picture(64)[HEIGHT // 2, WIDTH // 2, :3], expected, rtol=0.02)


@needs_chromium
def test_a_flake_stands_where_refraction_shows_it(page: Page, tmp_path: Path) -> None:
    slab = {
        "size_mm": (1.0, 1.0),
        "depth_mm": 0.8,
        "flakes_per_mm2": 1.0,
        "flake_radius_mm": 0.04,
        "tilt_deg": 1.0,
    }
    seed = next(seed for seed in range(100) if alone(nashiji.flakes(nashiji.Slab(**slab, seed=seed))))
    x, y, depth = nashiji.flakes(nashiji.Slab(**slab, seed=seed)).centres_mm[0] * [1, 1, -1]
    opened(page, scene_of({"kind": "nashiji_slab", "seed": seed, **slab}), tmp_path)
    top = 6.8
    for azimuth, height in ((-90.0, 40.0), (30.0, 55.0)):
        a, h = math.radians(azimuth), math.radians(height)
        back = np.array([math.cos(h) * math.cos(a), math.cos(h) * math.sin(a), math.sin(h)])
        target = np.array([x, y, top])
        camera = {"target": target.tolist(), "azimuth": azimuth, "height": height, "distance": 6.0}
        page.run(f"coupole.state = {{...coupole.state, mode: 'roughness', camera: {camera}}}")
        rows, columns = np.nonzero(np.isclose(page.picture(1)[..., 0], 0.08, atol=1e-3))
        assert len(rows) > 5
        eye = target + 6.0 * back
        apart, up = math.hypot(*(eye[:2] - target[:2])), eye[2] - top

        def miss(gone: float, depth: float = depth, apart: float = apart, up: float = up) -> float:
            return indices.URUSHI * gone / math.hypot(gone, depth) - (apart - gone) / math.hypot(apart - gone, up)

        gone = brentq(miss, 0.0, apart)
        way = target + gone * np.array([math.cos(a), math.sin(a), 0.0]) - eye
        right, upward = (
            np.array([-math.sin(a), math.cos(a), 0.0]),
            np.cross(back, [-math.sin(a), math.cos(a), 0.0]),
        )
        scale = HEIGHT / 2 / HALF / -(way @ back)
        wanted = (WIDTH / 2 + way @ right * scale, HEIGHT / 2 - way @ upward * scale)
        unrefracted = depth * np.array([0.0, 0.0, -1.0]) + target - eye
        assert abs(unrefracted @ upward - way @ upward) * scale > 5.0  # what a page without refraction misses by
        assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx(wanted, abs=1.0)


def alone(found: nashiji.Flakes) -> bool:
    """One flake, deep and away from the rim."""
    if len(found.centres_mm) != 1:
        return False
    x, y, z = found.centres_mm[0]
    return bool(0.3 < x < 0.7 and 0.3 < y < 0.7 and -0.7 < z < -0.5)


@needs_chromium
@pytest.mark.full
def test_nashiji_under_the_sky_looks_as_rays_through_a_closed_body_of_lacquer(page: Page, tmp_path: Path) -> None:
    """Also the renderer's flakes lie in the lacquer, but it takes the face's loss along the normal once more."""
    sky = {"kind": "environment", "luminance_cd_m2": 100, "spectrum": {"kind": "illuminant", "name": "D65"}}
    slab = {"kind": "nashiji_slab", "size_mm": [4, 4], "translation_mm": [-2, -2, -6.4]}
    more = {"lights": [sky], "samples": 32, "depth": 8, "bands": {"step_nm": 40}, "observer": "2 deg"}
    scene = scene_of(slab, **more, display={"white_cd_m2": 100})
    near = [one.model_copy(update={"position_mm": np.multiply(0.04, one.position_mm)}) for one in scene.cameras]
    scene = scene.model_copy(update={"cameras": tuple(near)})
    opened(page, scene, tmp_path, distance=12.0)
    page.run("coupole.state = {...coupole.state, sky: 1}")
    mine = page.picture(64)
    with rendering.open_renderer(scene, tmp_path) as renderer:
        red = renderer.render(scene.cameras[0]).radiance[..., 6]  # 620 nm
    whole = mine[..., 3] > 0.999
    assert whole.mean() > 0.2
    alike = np.corrcoef(mine[whole][:, 0], red[whole])[0, 1]
    print(f"correlation {alike:.3f}, ratio of means {mine[whole][:, 0].mean() / red[whole].mean():.4g}")
    assert alike > 0.93


@needs_chromium
def test_the_command_makes_a_page_that_says_it_is_a_hypothesis_and_knows_the_illuminant(
    page: Page, tmp_path: Path
) -> None:
    ended = cells.here("show", "configs/scenes/gilt-step-wedge-a.yaml", "--out", tmp_path / "look.html", "--json")
    assert ended.code == 0, ended.err
    assert ended.document["about"]["simulated"] is True
    page.open(tmp_path / "look.html")
    page.small()
    assert "Hypothesis" in page.browser.text("#banner")
    assert "spectra under A" in page.browser.text("#banner")
    before = page.picture(1)[HEIGHT // 2, WIDTH // 2]
    page.run("""coupole.state = {...coupole.state, skyIlluminant: 'D65',
        lights: [{...coupole.state.lights[0], illuminant: 'D65'}]}""")
    after = page.picture(1)[HEIGHT // 2, WIDTH // 2]
    assert before[0] / before[2] > 3.0 * after[0] / after[2]  # tungsten's red against daylight's
    assert page.browser.troubles() == []


def test_a_scene_that_a_page_cannot_show_is_refused_with_what_it_can(tmp_path: Path) -> None:
    thing = {"kind": "sphere", "radius_mm": 10, "material": {"kind": "glass"}}
    scene = scene_of(thing)
    with pytest.raises(InputError, match="does not refract; it shows gilding"):
        look_of_scene(scene, tmp_path)
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(scene.model_dump(mode="json")))
    ended = cells.here("show", tmp_path / "scene.yaml", "--view", "x", "--out", tmp_path / "look.html")
    assert ended.code == 2
    assert "--view" in ended.err


@needs_chromium
def test_a_ball_on_a_wide_sheet_throws_a_shadow_where_it_belongs(page: Page, tmp_path: Path) -> None:
    grey = {"kind": "diffuse", "reflectance": {"kind": "constant", "value": 0.5}}
    objects = [
        {"kind": "sphere", "radius_mm": 5, "translation_mm": [0, 0, 20], "material": grey},
        {"kind": "plane", "width_mm": 2000, "depth_mm": 2000, "material": grey},
    ]
    opened(page, scene_of({}, objects=objects), tmp_path)
    page.run("coupole.setLight(1, 0, 1)")  # the ball's middle, 25 mm high, is thrown to x = -25

    def lit(x: float, y: float) -> float:
        camera = {"target": [x, y, 0], "azimuth": -90, "height": 20, "distance": 500, "field": 0.5}
        page.run(f"coupole.state = {{...coupole.state, camera: {camera}}}")
        return float(page.picture(1)[HEIGHT // 2, WIDTH // 2, 1])

    places = [
        (-25, 0),
        (-31.5, 0),
        (-18.5, 0),
        (-25, 4.6),
        (-33, 0),
        (-17, 0),
        (-25, 5.4),
        (-25, -900),
        (700, 0),
        (-700, 0),
    ]
    found = [lit(x, y) for x, y in places]
    np.testing.assert_allclose(found, [0.0] * 4 + [0.5 / math.sqrt(2)] * 6, atol=2e-3)
