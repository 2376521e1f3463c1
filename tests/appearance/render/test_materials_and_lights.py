"""What scene files' materials and lights come to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from places import REPO
from spectral_scenes import constant, everywhere, illuminant, plane, rendered, scene

from coupole.appearance.optics import fresnel, indices
from coupole.appearance.optics.thin_film import Film, stack_power
from coupole.appearance.render.equivalent import equivalent_index
from coupole.appearance.render.led_squares import read_leds
from coupole.appearance.render.spectra import LowSun, Measured, air_mass, luminous, power, scaled_power
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.errors import InputError
from sim.render.emitter import irradiance, square

DOME = REPO / "configs" / "domes" / "coupole.csv"
COSINES = np.cos(np.radians([0.0, 30.0, 60.0, 75.0]))


@pytest.mark.parametrize(("thickness_nm", "off"), [(100.0, 0.003), (25.0, 0.02)])
def test_a_gold_leaf_has_an_index_of_bulk_that_reflects_as_it_does_at_all_angles(
    thickness_nm: float, off: float
) -> None:
    leaf = [Film(indices.gold(), thickness_nm)]
    found = equivalent_index(lambda c: stack_power(c, WAVELENGTHS_NM, leaf, substrate=indices.EGG_WHITE)[0])
    expected, _ = stack_power(COSINES, WAVELENGTHS_NM, leaf, substrate=indices.EGG_WHITE)
    assert np.stack([fresnel.reflectance(c, found) for c in COSINES]) == pytest.approx(expected, abs=off)


def test_a_bare_metal_is_its_own_equivalent() -> None:
    gold = indices.gold()
    found = equivalent_index(lambda c: fresnel.reflectance(c[:, None], gold))
    one, other = (np.stack([fresnel.reflectance(c, index) for c in COSINES]) for index in (found, gold))
    assert one == pytest.approx(other, abs=1e-3)


def test_a_film_whose_hues_turn_with_the_angle_is_refused() -> None:
    thick = [Film(indices.constant(1.5), 600.0)]
    with pytest.raises(InputError, match="thinner films"):
        equivalent_index(lambda c: stack_power(c, WAVELENGTHS_NM, thick, substrate=indices.gold())[0])


def test_a_face_that_the_scene_has_is_not_counted_again_by_the_metal_under_it() -> None:
    """Gold under a smooth face of urushi, in light from everywhere, by the sum of all ways between the two."""
    gold = {"kind": "metal", "roughness": 0.01, "depth_mm": 0.0, "face": False}
    face = {"kind": "glass", "index": indices.URUSHI}
    planes = [plane(gold), {**plane(face), "translation_mm": [0.0, 0.0, 0.5]}]
    one = scene(planes, [everywhere(illuminant("E"))], samples=64, bands={"step_nm": 20}, depth=16)
    reflected = rendered(one).radiance.mean(axis=(0, 1)) / scaled_power(light.illuminant("E"), 100.0)[::4]
    above = float(fresnel.reflectance(1.0, indices.URUSHI))
    below = np.ravel(fresnel.reflectance(1.0, indices.gold() / indices.URUSHI))[::4]
    assert reflected == pytest.approx(above + (1 - above) ** 2 * below / (1 - above * below), abs=0.005)


def test_an_antireflective_film_on_glass_dims_it_as_its_stack_does() -> None:
    coated = {
        "kind": "films",
        "films": [{"index": 1.38, "thickness_nm": 100.0}],
        "gold": None,
        "index": 1.5,
        "roughness": 0.01,
    }
    one = scene([plane(coated)], [everywhere(illuminant("E"))], samples=64, bands={"step_nm": 20})
    reflected = rendered(one).radiance.mean(axis=(0, 1)) / scaled_power(light.illuminant("E"), 100.0)[::4]
    expected, _ = stack_power(1.0, WAVELENGTHS_NM, [Film(indices.constant(1.38), 100.0)], substrate=1.5)
    assert reflected == pytest.approx(np.ravel(expected)[::4], abs=1e-3)


@pytest.mark.parametrize("led", [3, 700])
def test_an_led_of_the_dome_lights_a_plane_as_the_simulated_cell_says(led: int) -> None:
    lamp = {"kind": "leds", "dome": str(DOME), "ids": [led]}
    table = read_leds(DOME)
    # Below what the LED looks at; the table's frame is that of the robot's base.
    x, y, _ = table.positions_mm[led] + 1000.0 * table.normals[led]
    patch = {**plane({"kind": "diffuse", "reflectance": constant(1.0)}, 20.0), "translation_mm": [x, y, 0.0]}
    seen = {
        "name": "main",
        "position_mm": [x, y, 300.0],
        "target_mm": [x, y, 0.0],
        "up": [0, 1, 0],
        "optics": {"kind": "field", "degrees": 0.5},
        "width_px": 4,
        "height_px": 4,
    }
    found = rendered(scene([patch], [lamp], cameras=[seen], samples=64))
    emitter = square(table.positions_mm[led], table.normals[led], side_mm=7.0, flux_lm=float(table.flux_lm[led]))
    lux = irradiance(emitter, [[x, y, 0.0]], [[0.0, 0.0, 1.0]])[0]
    assert luminous(found.radiance.mean(axis=(0, 1))) == pytest.approx(lux / np.pi, rel=2e-3)


def test_a_sun_with_width_has_the_illuminance_that_was_asked_for() -> None:
    sun = {
        "kind": "distant",
        "direction": [0.3, 0.1, -1.0],
        "illuminance_lux": 1000.0,
        "width_deg": 0.53,
        "spectrum": {"kind": "black_body", "kelvin": 5000},
    }
    found = rendered(scene([plane({"kind": "diffuse", "reflectance": constant(1.0)})], [sun]))
    expected = 1000.0 / np.sqrt(0.3**2 + 0.1**2 + 1.0) / np.pi
    assert luminous(found.radiance.mean(axis=(0, 1))) == pytest.approx(expected, rel=2e-3)


def test_air_mass_is_1_overhead_and_38_at_the_horizon() -> None:
    assert air_mass(90.0) == pytest.approx(1.0, abs=1e-3)
    assert air_mass(0.0) == pytest.approx(37.9, abs=0.2)  # Kasten and Young's table


def test_the_sun_reddens_as_it_sinks() -> None:
    high, low = (power(LowSun(kind="low_sun", elevation_deg=e), Path()) for e in (60.0, 3.0))
    assert np.all(np.diff(np.log(low / high)) > 0.0)


def test_a_measured_light_is_read_from_its_file(tmp_path: Path) -> None:
    rows = "\n".join(f"{nm} {nm - 300}" for nm in range(380, 781, 10))
    (tmp_path / "sunset.csv").write_text("# sunset, relative power\n" + rows + "\n")
    found = power(Measured(kind="file", path=Path("sunset.csv")), tmp_path)
    assert found / found[0] == pytest.approx((WAVELENGTHS_NM - 300.0) / 80.0, rel=1e-3)
