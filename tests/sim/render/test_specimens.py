"""Materials of any form, as the renderer shows them: against their own functions of both directions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scenes import camera_above, quad, scene_of

from coupole.appearance.matter.hemisphere import albedo
from coupole.appearance.spectra import light
from coupole.errors import InputError
from coupole.exchange.of_results.material_tables import Material as ExportedMaterial
from coupole.exchange.of_results.merl import encode as encode_merl
from sim.objects.merl_file import merl_material
from sim.objects.specimens import SPECIMENS, specimen
from sim.optics.led_light import LedModel, camera_weights
from sim.render.camera_view import Viewer
from sim.render.emitter import irradiance, square
from sim.render.lens import Lens
from sim.render.radiance import led_radiance
from sim.world.config import MeasuredConfig

LENS, TILTED = Lens(40, 30, 40.0), camera_above(330.0, 35.0)
WEIGHTS = camera_weights(LedModel(), light.camera())
SLOW = {"tabulated", "four-flux"}


def unit(vectors: np.ndarray) -> np.ndarray:
    found: np.ndarray = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return found


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.full if name in SLOW else ()) for name in SPECIMENS]
)
def test_a_specimen_is_shown_as_it_reflects(name: str) -> None:
    """A plane in a view whose rays are up to 35 degrees apart, under lights near the mirror direction and off."""
    scene = scene_of(quad((0.0, 0.0, 0.0), 400.0), specimen(name))
    view = Viewer(scene, LENS, shading="pixel").look(TILTED)
    for place in ((0.0, 600.0, 800.0), (500.0, 700.0, 500.0), (-900.0, -100.0, 400.0)):
        led_mm = np.array(place)
        emitter = square(led_mm, -led_mm, side_mm=7.0, flux_lm=1800.0)
        shown = led_radiance(view, scene.materials, scene.tables, emitter, "lambertian").astype(float)
        up = np.broadcast_to([0.0, 0.0, 1.0], view.points_mm.shape)
        lights, eyes = unit(led_mm - view.points_mm), unit(view.eye_mm - view.points_mm)
        spectral = SPECIMENS[name]()(lights, eyes)
        expected = spectral @ WEIGHTS.T * irradiance(emitter, view.points_mm, up)[:, None]
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
    view = Viewer(scene, LENS, shading="pixel").look(TILTED)
    for place in ((0.0, 600.0, 800.0), (500.0, 700.0, 500.0), (-900.0, -100.0, 400.0)):
        led_mm = np.array(place)
        emitter = square(led_mm, -led_mm, side_mm=7.0, flux_lm=1800.0)
        shown = led_radiance(view, scene.materials, scene.tables, emitter, "lambertian").astype(float)
        up = np.broadcast_to([0.0, 0.0, 1.0], view.points_mm.shape)
        lights, eyes = unit(led_mm - view.points_mm), unit(view.eye_mm - view.points_mm)
        half = unit(lights + eyes)[:, 2]
        nl, nv, a2 = lights[:, 2], eyes[:, 2], 0.3**2
        d = a2 / (np.pi * (half**2 * (a2 - 1) + 1) ** 2)
        v = 0.5 / (nl * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(nl**2 * (1 - a2) + a2))
        f = glossy.kd + (d * v)[:, None] * glossy.ks
        off = np.abs(shown / (f * irradiance(emitter, view.points_mm, up)[:, None]) - 1.0)
        assert np.median(off) < 2e-3
        assert np.quantile(off, 0.95) < 0.01


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
