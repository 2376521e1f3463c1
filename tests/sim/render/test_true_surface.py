"""Frames show the true surface of a scanned object: sharper than the scan, to the stated width of a stroke."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from places import REPO
from pydantic import ValidationError
from scenes import camera_above

from sim.devices.camera_body import Exposed
from sim.objects import plaque_relief as relief
from sim.objects.lettering import text_width
from sim.optics.photographer import Photographer
from sim.world.config import CameraConfig, SceneConfig, Settings

PIXELS = (160, 120)
WHITE_US = 8000
FOUR_LEDS = """id,board,x_mm,y_mm,z_mm,nx,ny,nz,flux_lm
0,0,900,0,1000,-0.67,0,-0.74,1800
1,0,-900,0,1000,0.67,0,-0.74,1800
2,0,0,900,1000,0,-0.67,-0.74,1800
3,0,0,-900,1000,0,0.67,-0.74,1800
"""


@pytest.fixture(scope="module")
def electrons(tmp_path_factory: pytest.TempPathFactory) -> NDArray[np.float64]:
    """[h, w] signal, DN, of the first letter under four LEDs, by the showpiece's lens on a grey sensor."""
    folder = tmp_path_factory.mktemp("true")
    (folder / "leds.csv").write_text(FOUR_LEDS)
    stem = -0.5 * text_width(relief.INSCRIPTION) * relief.LETTER_MM
    placed = np.eye(4)
    placed[:3, 3] = -stem, -(relief.BASELINE_MM + 0.5 * relief.LETTER_MM), 0.0
    scene = SceneConfig.model_validate(
        {
            "leds": folder / "leds.csv",
            "emission": "lambertian",
            "base_from_support": np.eye(4).tolist(),
            "support_diameter_mm": 400.0,
            "objects": [
                {
                    "path": REPO / "configs/objects/plaque.ply",
                    "unit": "mm",
                    "support_from_object": placed.tolist(),
                }
            ],
        }
    )
    camera = CameraConfig.model_validate(
        {
            "width_px": PIXELS[0],
            "height_px": PIXELS[1],
            "pixel_pitch_um": 22.0,
            "bit_depth": 12,
            "bayer_pattern": "MONO",
            "black_dn": 64,
            "max_frames_per_s": 100.0,
            "exposure_gap_us": 100,
            "focal_length_mm": 50.0,
            "focus_distance_mm": 335.0,
            "f_number": 16.0,
            "blur": True,
            "samples_per_side": 4,  # one ray each would round the width to whole pixels of 0.125 mm
            "flange_from_camera": np.eye(4).tolist(),
            "nominal_exposure_us": WHITE_US,
        }
    )
    settings = Settings.model_validate({"true_surface": "plaque", "interreflection": False})
    photographer = Photographer(scene, camera, settings)
    total = np.zeros(PIXELS[::-1])
    for number, led in enumerate((0, 1, 2, 3)):
        out = np.zeros(PIXELS[::-1], np.uint16)
        photographer.render(out, Exposed({led: 8e-3}, [], 8e-3, 1.0, number, camera_above(335.0 + 9.3)))
        total += out - 64.0
    return total


def test_a_stroke_is_0_3_mm_wide_in_the_frame(electrons: NDArray[np.float64]) -> None:
    """By the width at half depth. The stem of the L lies in the middle of the picture, along its columns."""
    middle = PIXELS[0] // 2
    profile = electrons[PIXELS[1] // 2 - 10 : PIXELS[1] // 2 + 10, middle - 12 : middle + 12].mean(axis=0)
    lowest = int(profile.argmin())
    assert lowest in range(10, 15)
    half = 0.5 * (np.median(profile) + profile[lowest])
    fine = np.linspace(0.0, 23.0, 2301)
    width_px = 0.01 * np.sum((np.interp(fine, np.arange(24), profile) < half) & (np.abs(fine - lowest) < 4.0))
    pixel_mm = 335.0 * 0.022 / 50.0 * (1.0 - 50.0 / 335.0)
    assert width_px * pixel_mm == pytest.approx(0.3, abs=0.07)


def test_a_true_surface_has_its_own_materials() -> None:
    for other in ({"material": {"diffuse": (0.5, 0.5, 0.5)}}, {"detail": [{"period_mm": 1.0, "texture": 0.1}]}):
        with pytest.raises(ValidationError, match="its own materials"):
            Settings.model_validate({"true_surface": "plaque", **other})


def test_an_unknown_true_surface_is_refused() -> None:
    with pytest.raises(ValidationError, match="true_surface"):
        Settings.model_validate({"true_surface": str(Path("plaque.ply"))})
