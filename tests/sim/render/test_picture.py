"""Frames of the photographer: lights add up, memory changes nothing, shadows fall."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import camera_above, quad

from coupole.geometry import Transform
from sim.devices.camera_body import Exposed
from sim.optics.photographer import Photographer
from sim.strangers.light_stranger import LightStranger
from sim.world.config import CameraConfig, SceneConfig, Settings

ABOVE = camera_above(335.0)
LEDS = """id,board,x_mm,y_mm,z_mm,nx,ny,nz,flux_lm
0,0,0,0,1500,0,0,-1,1800
7,0,800,0,1200,-0.5547,0,-0.83205,1800
9,1,0,-900,900,0,0.70711,-0.70711,1800
"""


def photographer(folder: Path, world: dict[str, object] | None = None, **camera: object) -> Photographer:
    """A white tile of 20 mm, 40 mm above the support; `world` is its settings besides `flat`."""
    import trimesh

    (folder / "leds.csv").write_text(LEDS)
    corners = quad((0.0, 0.0, 40.0), 10.0)
    trimesh.Trimesh(corners.reshape(-1, 3), np.arange(6).reshape(-1, 3), process=False).export(folder / "tile.ply")
    tile = {
        "path": folder / "tile.ply",
        "unit": "mm",
        "support_from_object": np.eye(4).tolist(),
        "material": {"diffuse": (0.9, 0.9, 0.9)},
    }
    scene = SceneConfig.model_validate(
        {
            "leds": folder / "leds.csv",
            "emission": "lambertian",
            "base_from_support": np.eye(4).tolist(),
            "support_diameter_mm": 400.0,
            "objects": [tile],
        }
    )
    settings = {
        "width_px": 128,
        "height_px": 96,
        "pixel_pitch_um": 176.0,
        "bit_depth": 12,
        "bayer_pattern": "GBRG",
        "black_dn": 64,
        "max_frames_per_s": 100.0,
        "exposure_gap_us": 100,
        "focal_length_mm": 35.0,
        "focus_distance_mm": 335.0,
        "flange_from_camera": np.eye(4).tolist(),
        "nominal_exposure_us": 8000,
        **camera,
    }
    return Photographer(
        scene, CameraConfig.model_validate(settings), Settings.model_validate({"shading": "flat", **(world or {})})
    )


def frame(
    by: Photographer, seconds_of_led: dict[int, float], pose: Transform = ABOVE, panels: int = 0, number: int = 1
) -> NDArray[np.uint16]:
    out = np.zeros((96, 128), np.uint16)
    by.render(out, Exposed(seconds_of_led, list(range(1, panels + 1)), 0.008, 1.0, number, pose))
    return out


def signal(picture: NDArray[np.uint16]) -> float:
    return float(picture.mean()) - 64.0


@pytest.mark.parametrize("shading", ["flat", "pixel"])
def test_lights_add_up(shading: str, tmp_path: Path) -> None:
    by = photographer(tmp_path, {"shading": shading})
    alone = [signal(frame(by, {led: 0.003})) for led in (0, 7)]
    assert signal(frame(by, {0: 0.003, 7: 0.003})) == pytest.approx(sum(alone), rel=0.02)
    assert signal(frame(by, {0: 0.003}, panels=1)) == pytest.approx(
        alone[0] + signal(frame(by, {}, panels=1)), rel=0.02
    )
    assert abs(signal(frame(by, {}))) < 1.0


def test_lamps_that_warm_give_less_light_frame_by_frame(tmp_path: Path) -> None:
    warming = {"light": {"warming": 0.2, "warming_frames": 10.0}}
    by = photographer(tmp_path, {"strangers": warming})
    first, late = (signal(frame(by, {0: 0.003}, number=number)) for number in (0, 1000))
    assert late / first == pytest.approx(0.8, rel=0.01)


def test_dies_of_unequal_lobes_light_a_place_beside_their_axis_unequally(tmp_path: Path) -> None:
    """LED 9 points beside the tile; LED 0 has the tile on its axis, where a lobe changes the light by its flux."""
    plain, strange = (
        photographer(tmp_path, {"strangers": {"light": light}}) for light in ({}, {"exponent_spread": 0.2})
    )
    lobe = LightStranger(exponent_spread=0.2)
    for led, away_mm, axis in ((0, (0, 0, -1460), (0, 0, -1)), (9, (0, 900, -860), (0, 0.70711, -0.70711))):
        cosine = float(np.dot(away_mm, axis) / np.linalg.norm(away_mm))
        own = lobe.exponent(led)
        ratio = signal(frame(strange, {led: 0.003})) / signal(frame(plain, {led: 0.003}))
        assert ratio == pytest.approx((1.0 + 0.5 * own) * cosine**own, rel=0.02)


@pytest.mark.parametrize("shading", ["flat", "pixel"])
def test_a_frame_is_the_same_whatever_was_rendered_before(shading: str, tmp_path: Path) -> None:
    fresh = {led: frame(photographer(tmp_path, {"shading": shading}), {led: 0.004}) for led in (0, 7, 9)}
    by = photographer(tmp_path, {"shading": shading})
    for pose in (ABOVE, camera_above(300.0, 40.0), ABOVE):
        for led in (9, 0, 7, 0):
            picture = frame(by, {led: 0.004}, pose)
            if pose is ABOVE:
                assert np.array_equal(picture, fresh[led])


def test_without_memory_for_radiance_and_shadows_frames_stay_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = frame(photographer(tmp_path), {7: 0.004})
    monkeypatch.setattr("sim.optics.photographer._RADIANCE_BYTES", 0)
    monkeypatch.setattr("sim.optics.photographer._SHADOW_BYTES", 0)
    by = photographer(tmp_path)
    assert np.array_equal(frame(by, {7: 0.004}), expected)
    assert np.array_equal(frame(by, {7: 0.004}), expected)


@pytest.mark.parametrize("shading", ["flat", "pixel"])
def test_the_tile_throws_its_shadow_on_the_support(shading: str, tmp_path: Path) -> None:
    by = photographer(tmp_path, {"shading": shading, "interreflection": False})
    bright = frame(by, {9: 0.5}).astype(float) - 64.0
    # LED 9 stands at 45 degrees: the shadow's centre lies 41.9 mm behind the tile's.
    focal_px = 35.0 / (1 - 35.0 / 335.0) * 1e3 / 176.0
    row = round(47.5 - 41.9 * focal_px / 335.0)
    shadow, beside = bright[row - 4 : row + 4, 60:68], bright[row - 4 : row + 4, 20:40]
    assert abs(shadow.mean()) < 5.0
    assert beside.mean() > 100.0


@pytest.mark.parametrize("camera", [{"samples_per_side": 2}, {"distortion": (0.02, 0.0, 0.0, 0.0, 0.0)}])
def test_samples_and_distortion_leave_brightness_as_it_is(tmp_path: Path, camera: dict[str, object]) -> None:
    plain, other = (signal(frame(photographer(tmp_path, **more), {0: 0.004})) for more in ({}, camera))
    assert other == pytest.approx(plain, rel=0.08)  # the tile is 15 pixels wide: its edge decides


def test_light_goes_from_surface_to_surface_where_that_is_asked_for(tmp_path: Path) -> None:
    """Into the tile's shadow: from the bright support to the tile's underside, and back."""
    by = [photographer(tmp_path, world) for world in ({}, {"interreflection": {"bounces": 3}})]
    plain, more = (frame(one, {9: 4.0})[15:23, 60:68].mean() for one in by)
    assert plain == pytest.approx(64.0, abs=2.0)
    assert more > plain + 4.0
