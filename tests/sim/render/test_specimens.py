"""Materials of any form, as the renderer shows them: against their own functions of both directions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scenes import camera_above, quad, scene_of
from scipy.spatial.transform import Rotation

from coupole.appearance.matter.hemisphere import albedo
from coupole.appearance.spectra import light
from coupole.errors import InputError
from coupole.exchange.of_results.material_tables import Material as ExportedMaterial
from coupole.exchange.of_results.merl import encode as encode_merl
from sim.objects.merl_file import merl_material, read_merl
from sim.objects.specimens import SPECIMENS, specimen
from sim.optics.led_light import LedModel, camera_weights
from sim.render.camera_view import Viewer
from sim.render.emitter import irradiance, square
from sim.render.lens import Lens
from sim.render.radiance import led_radiance
from sim.scene.scene import Scene
from sim.world.config import MeasuredConfig

LENS, TILTED = Lens(40, 30, 40.0), camera_above(330.0, 35.0)
WEIGHTS = camera_weights(LedModel(), light.camera())
SLOW = {"tabulated", "four-flux"}


def unit(vectors: np.ndarray) -> np.ndarray:
    found: np.ndarray = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return found


def seen_under_leds(scene: Scene) -> Iterator[tuple[np.ndarray, ...]]:
    """Of a plane under each of three LEDs, by pixel: radiance, irradiance, directions to the LED and the eye."""
    view = Viewer(scene, LENS, shading="pixel").look(TILTED)
    up = np.broadcast_to([0.0, 0.0, 1.0], view.points_mm.shape)
    for place in ((0.0, 600.0, 800.0), (500.0, 700.0, 500.0), (-900.0, -100.0, 400.0)):
        led_mm = np.array(place)
        emitter = square(led_mm, -led_mm, side_mm=7.0, flux_lm=1800.0)
        shown = led_radiance(view, scene.materials, scene.tables, emitter, "lambertian").astype(float)
        lit = irradiance(emitter, view.points_mm, up)[:, None]
        yield shown, lit, unit(led_mm - view.points_mm), unit(view.eye_mm - view.points_mm)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.full if name in SLOW else ()) for name in SPECIMENS]
)
def test_a_specimen_is_shown_as_it_reflects(name: str) -> None:
    """A plane in a view whose rays are up to 35 degrees apart, under lights near the mirror direction and off."""
    scene = scene_of(quad((0.0, 0.0, 0.0), 400.0), specimen(name))
    for shown, lit, lights, eyes in seen_under_leds(scene):
        spectral = SPECIMENS[name]()(lights, eyes)
        expected = spectral @ WEIGHTS.T * lit
        off = np.abs(shown / expected - 1.0)
        assert np.median(off) < 3e-3
        assert np.quantile(off, 0.95) < 0.02


def test_specimens_reflect_less_light_than_they_get() -> None:
    for name in set(SPECIMENS) - SLOW:
        whole = albedo(SPECIMENS[name](), np.array([0.1, 0.5, 1.0]), nodes=16)
        assert 0.02 < whole.min() < whole.max() < 1.0, name


def test_a_specimens_tint_scales_all_of_it() -> None:
    emitter = square((0.0, 600.0, 800.0), (0.0, -0.6, -0.8), side_mm=7.0, flux_lm=1800.0)
    shown = []
    for tint in (None, np.tile(np.array([0.5, 0.25, 1.0], np.float32), (2, 1))):
        scene = replace(scene_of(quad((0.0, 0.0, 0.0), 400.0), specimen("layered")), tint=tint)
        view = Viewer(scene, LENS, shading="pixel").look(TILTED)
        shown.append(led_radiance(view, scene.materials, scene.tables, emitter, "lambertian"))
    np.testing.assert_allclose(shown[1], shown[0] * np.array([0.5, 0.25, 1.0]), rtol=1e-5)


def test_an_exported_material_comes_back_as_the_material_of_an_object(tmp_path: Path) -> None:
    """Written in MERL's format by the exporter, read by the simulator, shown as GGX has it."""
    glossy = ExportedMaterial("glossy", np.array([0.2, 0.15, 0.1]), np.array([0.05, 0.04, 0.03]), 0.3)
    path = tmp_path / "glossy.binary"
    path.write_bytes(encode_merl(glossy))
    scene = scene_of(quad((0.0, 0.0, 0.0), 400.0), merl_material(path))
    for shown, lit, lights, eyes in seen_under_leds(scene):
        half = unit(lights + eyes)[:, 2]
        nl, nv, a2 = lights[:, 2], eyes[:, 2], 0.3**2
        d = a2 / (np.pi * (half**2 * (a2 - 1) + 1) ** 2)
        v = 0.5 / (nl * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(nl**2 * (1 - a2) + a2))
        f = glossy.kd + (d * v)[:, None] * glossy.ks
        off = np.abs(shown / (f * lit) - 1.0)
        assert np.median(off) < 2e-3
        assert np.quantile(off, 0.95) < 0.01


def test_a_measured_material_is_read_at_its_own_angles(tmp_path: Path) -> None:
    """A made-up one that changes with each of them, and with the colour; angles by Rusinkiewicz' definition."""

    def made_up(theta_h: np.ndarray, theta_d: np.ndarray, phi_d: np.ndarray) -> np.ndarray:
        value: np.ndarray = 1.0 + 0.5 * np.cos(theta_h) + 0.3 * np.sin(theta_d) * np.cos(2.0 * phi_d + 0.5)
        return value

    steps = [(np.arange(count) + 0.5) / count for count in (90, 90, 180)]
    middles = np.meshgrid(0.5 * np.pi * steps[0] ** 2, 0.5 * np.pi * steps[1], np.pi * steps[2], indexing="ij")
    scales = (1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0)
    planes = np.stack([(1 + channel) * made_up(*middles) / scale for channel, scale in enumerate(scales)])
    path = tmp_path / "made-up.binary"
    path.write_bytes(np.array([90, 90, 180], "<i4").tobytes() + planes.astype("<f8").tobytes())
    light, eye = unit(np.random.default_rng(3).normal((0.0, 0.0, 1.5), size=(2, 4000, 3)))
    above = (light[:, 2] > 0.1) & (eye[:, 2] > 0.1)
    light, eye = light[above], eye[above]
    middle = unit(light + eye)
    theta_h, phi_h = np.arccos(middle[:, 2]), np.arctan2(middle[:, 1], middle[:, 0])
    half = Rotation.from_euler("zy", np.stack([-phi_h, -theta_h], axis=1))
    x, y, z = half.apply(light).T
    expected = made_up(theta_h, np.arccos(z), np.arctan2(y, x))
    found = read_merl(path)(light, eye)
    np.testing.assert_allclose(found / [1, 2, 3], np.repeat(expected[:, None], 3, axis=1), rtol=5e-3)
    planes[1, 3, 4, 5] = np.nan
    path.write_bytes(np.array([90, 90, 180], "<i4").tobytes() + planes.astype("<f8").tobytes())
    with pytest.raises(InputError, match="no numbers"):
        read_merl(path)


def test_what_is_no_material_of_merls_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.binary"
    path.write_bytes(bytes(100))
    with pytest.raises(InputError, match="expected a material of the MERL database"):
        merl_material(path)
    with pytest.raises(ValidationError, match="expected an absolute path"):
        MeasuredConfig(merl=Path("other.binary"))


def test_another_specimen_is_refused() -> None:
    with pytest.raises(InputError, match="expected one of tabulated"):
        specimen("velvet")
