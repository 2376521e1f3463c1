"""Materials of any form, as the renderer shows them: against their own functions of both directions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scenes import camera_above, quad, scene_of
from scipy.spatial.transform import Rotation

from coupole.appearance.matter.hemisphere import albedo
from coupole.appearance.matter.merl_table import read_merl
from coupole.appearance.matter.rgl_writing import tensors
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.errors import InputError
from coupole.exchange.of_results.bsdf import encode as encode_bsdf
from coupole.exchange.of_results.material_tables import Material as ExportedMaterial
from coupole.exchange.of_results.merl import encode as encode_merl
from sim.objects.measured_files import alta_material, bsdf_material, merl_material
from sim.objects.specimens import SPECIMENS, specimen
from sim.optics.led_light import LedModel, camera_weights
from sim.render.camera_view import Viewer
from sim.render.emitter import irradiance, square
from sim.render.lens import Lens
from sim.render.radiance import led_radiance
from sim.scene.scene import Scene
from sim.scene.surface import Material
from sim.world.config import MeasuredConfig

LENS, TILTED = Lens(40, 30, 40.0), camera_above(330.0, 35.0)
SLOW = {"tabulated", "four-flux"}
GLOSSY = ExportedMaterial("glossy", np.array([0.2, 0.15, 0.1]), np.array([0.05, 0.04, 0.03]), 0.3)


@cache
def weights() -> np.ndarray:
    """Of the simulated camera under a white LED."""
    return camera_weights(LedModel(), light.camera())


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
        expected = spectral @ weights().T * lit
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


def ggx(light: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """[n, 3] of `GLOSSY`, by Heitz' form."""
    half = unit(light + eye)[..., 2]
    nl, nv, a2 = light[..., 2], eye[..., 2], GLOSSY.alpha**2
    d = a2 / (np.pi * (half**2 * (a2 - 1) + 1) ** 2)
    v = 0.5 / (nl * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(nl**2 * (1 - a2) + a2))
    found: np.ndarray = GLOSSY.kd + (d * v)[..., None] * GLOSSY.ks
    return found


def assert_shown_as_ggx(material: Material, median: float, high: float) -> None:
    scene = scene_of(quad((0.0, 0.0, 0.0), 400.0), material)
    for shown, lit, lights, eyes in seen_under_leds(scene):
        off = np.abs(shown / (ggx(lights, eyes) * lit) - 1.0)
        assert np.median(off) < median
        assert np.quantile(off, 0.95) < high


@pytest.mark.parametrize(("encode", "read"), [(encode_merl, merl_material), (encode_bsdf, bsdf_material)])
def test_an_exported_material_comes_back_as_the_material_of_an_object(
    encode: Callable[[ExportedMaterial], bytes], read: Callable[[Path], Material], tmp_path: Path
) -> None:
    """Written by the exporter, read by the simulator, shown as GGX has it."""
    path = tmp_path / "glossy"
    path.write_bytes(encode(GLOSSY))
    assert_shown_as_ggx(read(path), 2e-3, 0.01)


def test_samples_come_back_as_the_material_of_an_object(tmp_path: Path) -> None:
    """6,000 pairs of directions as ALTA's text, a file for each channel."""
    light, eye = unit(np.random.default_rng(7).normal((0.0, 0.0, 1.0), size=(2, 6000, 3)))
    above = (light[:, 2] > 0.02) & (eye[:, 2] > 0.02)
    light, eye = light[above], eye[above]
    paths = tuple(tmp_path / f"{name}.alta" for name in ("red", "green", "blue"))
    for path, values in zip(paths, ggx(light, eye).T, strict=True):
        rows = "\n".join(
            " ".join(f"{value:.9g}" for value in row) for row in np.column_stack([eye, light, values])
        )
        path.write_text(f"#DIM 6 1\n#PARAM_IN CARTESIAN\n{rows}\n")
    assert_shown_as_ggx(alta_material(paths), 0.01, 0.05)
    grey = alta_material(paths[:1])
    assert grey.diffuse[0] == grey.diffuse[2]
    with pytest.raises(InputError, match="expected one or three values in each sample; found 2"):
        alta_material(paths[:2])


def test_spectra_are_seen_by_the_camera_and_threads_from_all_sides(tmp_path: Path) -> None:
    """A material that reflects red light alone, and twice as much of it from one side as from all in the mean."""
    nm = np.arange(380, 785, 10, dtype=np.float32)
    azimuths = np.linspace(-np.pi, np.pi, 9, dtype=np.float32)
    lit = 1.0 + np.cos(azimuths)
    spectra = np.zeros((9, 2, len(nm), 4, 4), np.float32)
    spectra[:, :, nm > 600] = lit[:, None, None, None, None]
    ones = np.ones((9, 2, 2, 2), np.float32)
    fields = {"theta_i": np.array([0, 1.6], np.float32), "phi_i": azimuths, "ndf": ones[0, 0], "sigma": ones[0, 0]}
    fields |= {"vndf": ones, "spectra": spectra, "wavelengths": nm, "jacobian": np.zeros(1, np.uint8)}
    path = tmp_path / "red.bsdf"
    path.write_bytes(tensors(fields))
    table = bsdf_material(path).table
    assert table is not None
    cosine = np.cos(0.25 * np.pi)  # light and eye at theta_h 0, theta_d 45 degrees; the table is f cos
    theta_d = np.linspace(0, 0.5 * np.pi, table.shape[1])
    found = np.array([np.interp(0.25 * np.pi, theta_d, table[0, :, 3, channel]) for channel in range(3)])
    red = weights() @ np.interp(WAVELENGTHS_NM, nm, nm > 600)
    np.testing.assert_allclose(found, red / cosine, rtol=1e-3)
    assert found[0] > 5 * found[2]


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
    with pytest.raises(InputError, match="not numbers"):
        read_merl(path)


def test_what_is_no_material_of_merls_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.binary"
    path.write_bytes(bytes(100))
    with pytest.raises(InputError, match="expected a material of the MERL database"):
        merl_material(path)
    for relative in ({"merl": Path("other.binary")}, {"alta": [Path("/a"), Path("b"), Path("/c")]}):
        with pytest.raises(ValidationError, match="expected an absolute path"):
            MeasuredConfig.model_validate(relative)
    for given in ({}, {"merl": Path("/a"), "bsdf": Path("/a")}):
        with pytest.raises(ValidationError, match="expected one of `merl`, `bsdf` and `alta`"):
            MeasuredConfig.model_validate(given)


def test_another_specimen_is_refused() -> None:
    with pytest.raises(InputError, match="expected one of tabulated"):
        specimen("velvet")
