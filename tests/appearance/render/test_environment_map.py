"""Surroundings from an HDR picture against sums over its pixels, and colour-science."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from spectral_scenes import camera, constant, illuminant, plane, rendered, scene

from coupole.appearance.render.environment_map import level_irradiance
from coupole.appearance.render.spectra import luminous
from coupole.appearance.spectra import light
from coupole.errors import InputError

WHITE = {"kind": "diffuse", "reflectance": constant(1.0)}
HEIGHT = 32
SRGB_WHITE = 1000.0


def written(pixels: NDArray[np.float64], path: Path) -> str:
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    mi.Bitmap(pixels.astype(np.float32)).write(str(path))
    return str(path)


def around(path: str, **others: Any) -> dict[str, Any]:
    return {"kind": "environment_map", "path": path, "white_cd_m2": SRGB_WHITE, **others}


def coloured() -> NDArray[np.float64]:
    """A dim blue sky, a brown ground, an orange lamp in the picture's left half above the horizon."""
    pixels = np.empty((HEIGHT, 2 * HEIGHT, 3))
    pixels[: HEIGHT // 2], pixels[HEIGHT // 2 :] = [0.2, 0.3, 0.6], [0.15, 0.1, 0.05]
    pixels[8:14, 12:24] = [5.0, 3.0, 1.0]
    return pixels


def sum_over_pixels(pixels: NDArray[np.float64], normal: list[float], centre_azimuth_deg: float) -> Any:
    """Irradiance [3] of a plane, by each pixel's direction, each split 8 x 8, in the frame of the scene."""
    fine = np.repeat(np.repeat(pixels, 8, axis=0), 8, axis=1)
    rows, columns = fine.shape[:2]
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    # Columns go clockwise as one looks down, like a compass; the middle one is at the azimuth.
    azimuth = ((np.arange(columns) + 0.5) / columns - 0.5) * 2.0 * np.pi + np.radians(centre_azimuth_deg)
    x, y = np.sin(polar)[:, None] * np.sin(azimuth), np.sin(polar)[:, None] * np.cos(azimuth)
    z = np.broadcast_to(np.cos(polar)[:, None], x.shape)
    facing = np.maximum(0.0, np.stack([x, y, z], axis=-1) @ normal)
    solid_angle = np.sin(polar)[:, None] * (np.pi / rows) * (2.0 * np.pi / columns)
    return np.einsum("rc,rcn->n", facing * solid_angle, fine)


@pytest.mark.parametrize(
    ("normal", "abc_deg", "centre_azimuth_deg"),
    [([0, 0, 1], [0, 0, 0], 0), ([-1, 0, 0], [0, -90, 0], 0), ([0, 1, 0], [0, 0, -90], 30)],
)
def test_a_white_plane_has_the_map_summed_over_its_pixels_and_its_colour(
    normal: list[int], abc_deg: list[int], centre_azimuth_deg: float, tmp_path: Path
) -> None:
    import colour as colour_science

    pixels = coloured()
    view = {
        **camera(90),
        "position_mm": [500 * n for n in normal],
        "up": [0, 0, 1] if normal[2] == 0 else [0, 1, 0],
    }
    sheet = {**plane(WHITE, 100.0), "abc_deg": abc_deg}
    lamp = around(written(pixels, tmp_path / "map.exr"), centre_azimuth_deg=centre_azimuth_deg)
    found = rendered(scene([sheet], [lamp], cameras=[view], samples=300)).radiance.mean(axis=(0, 1))
    xyz = 683.0 * 5.0 * light.observer("2 deg") @ found
    rgb = sum_over_pixels(pixels, [float(n) for n in normal], centre_azimuth_deg) / np.pi
    expected = SRGB_WHITE * colour_science.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ @ rgb
    assert xyz == pytest.approx(expected, rel=0.015)
    assert xyz[:2] / xyz.sum() == pytest.approx(expected[:2] / expected.sum(), abs=0.002)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_mirror_shows_the_pixel_of_the_direction_that_it_reflects(side: int, tmp_path: Path) -> None:
    """From above +-x at 60 degrees: the mirror shows what is 60 degrees high towards the other side."""
    pixels = np.full((HEIGHT, 2 * HEIGHT, 3), 0.1)
    # 60 degrees high is in row 5; azimuth 90 (+x) is the edge between columns 47 and 48.
    columns = slice(46, 50) if side < 0 else slice(14, 18)
    pixels[3:8, columns] = 1.0
    elevation = np.radians(60.0)
    view = {**camera(60), "position_mm": [side * 500 * np.cos(elevation), 0, 500 * np.sin(elevation)]}
    mirror = {"kind": "metal", "gold": 0.0, "roughness": 0.01}
    one = scene(
        [plane(mirror)],
        [around(written(pixels, tmp_path / "map.hdr"))],
        cameras=[view],
        samples=64,
        bands={"step_nm": 20},
    )
    # Silver at 60 degrees from the face's edge reflects 0.97 or so.
    assert luminous_20(rendered(one)) == pytest.approx(0.965 * SRGB_WHITE, rel=0.03)


def luminous_20(found: Any) -> float:
    return float(683.0 * 20.0 * found.radiance.mean(axis=(0, 1)) @ light.observer("2 deg")[1][::4])


def test_a_map_in_another_white_leaves_other_lights_as_they_are(tmp_path: Path) -> None:
    """Grey surroundings under A are what `environment` gives under A; with a lamp under D65 both add up."""
    grey = written(np.full((HEIGHT, 2 * HEIGHT, 3), 0.25), tmp_path / "grey.exr")
    lamp = {"kind": "distant", "direction": [0, 0, -1], "illuminance_lux": 500.0, "spectrum": illuminant("D65")}
    uniform = {"kind": "environment", "luminance_cd_m2": 250.0, "spectrum": illuminant("A")}
    mapped = around(grey, spectrum=illuminant("A"))
    one, other = (
        rendered(scene([plane(WHITE)], [lit, lamp], samples=128, bands={"step_nm": 5})).radiance.mean(axis=(0, 1))
        for lit in (mapped, uniform)
    )
    assert one == pytest.approx(other, rel=0.01)


def test_a_level_plane_has_the_illuminance_that_was_asked_for(tmp_path: Path) -> None:
    lamp = around(written(coloured(), tmp_path / "map.exr"), white_cd_m2=None, illuminance_lux=300.0)
    found = rendered(scene([plane(WHITE)], [lamp], samples=400)).radiance.mean(axis=(0, 1))
    assert luminous(found) * np.pi == pytest.approx(300.0, rel=0.015)


def test_uniform_radiance_gives_pi_times_it() -> None:
    assert level_irradiance(np.ones((9, 18))) == pytest.approx(np.pi)
    assert level_irradiance(np.ones((10, 20))) == pytest.approx(np.pi)


@pytest.mark.parametrize(
    ("shape", "value", "told"),
    [((8, 8), 1.0, "twice as wide"), ((8, 16), np.nan, "finite"), ((8, 16), -1.0, "sRGB")],
)
def test_a_map_of_no_use_is_refused(shape: tuple[int, int], value: float, told: str, tmp_path: Path) -> None:
    path = written(np.full((*shape, 3), value), tmp_path / "map.exr")
    with pytest.raises(InputError, match=told):
        rendered(scene([plane(WHITE)], [around(path)]))


def test_two_surroundings_are_refused(tmp_path: Path) -> None:
    both = [around("map.exr"), {"kind": "environment", "luminance_cd_m2": 1.0, "spectrum": illuminant("E")}]
    with pytest.raises(InputError, match="sky: false"):
        rendered(scene([plane(WHITE)], both))
