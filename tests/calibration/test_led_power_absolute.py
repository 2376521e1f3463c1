"""LED power in its own unit, DN s^-1 m^2 sr: constant frames of a tile, by hand-made figures."""

from __future__ import annotations

import math

import numpy as np
import pytest
from light_runs import FOCAL_PX, FORMAT

from coupole.calibration.light.frames import LightFrame, LightFrames
from coupole.calibration.light.led_power import calibrate_led_power
from coupole.calibration.light.led_power_tile import Setting, TileReader
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_views import Positions, TileView, transfer
from coupole.calibration.optics import Intrinsics
from coupole.calibration.sources import About
from coupole.plan.base_model import Pose
from coupole.plan.shot_id import ShotId

TILE = Tile(reflectance=0.99, minnaert=1.15, support_from_tile=Pose(translation_mm=(0.0, 0.0, 0.0)))
ON_AXIS_PER_M2 = 0.318304687
"""E/Phi of a Lambertian square of 7 mm at 1 m, on axis: the reference value."""
CENTRE_MM, DOWN = np.array([[0.0, 0.0, 1000.0]]), np.array([[0.0, 0.0, -1.0]])
IDS = np.array([5])


def view_from(angle_deg: float, signal: float = 1.0) -> TileView:
    """The middle of the tile, seen from 400 mm at this angle to its normal."""
    angle = math.radians(angle_deg)
    eye = 400 * np.array([math.sin(angle), 0.0, math.cos(angle)])
    seen, u = np.full((1, 1), signal), np.full((1, 1), 1e-3 * signal)
    return TileView("v", 0, np.eye(4), np.zeros((1, 3)), eye, np.array([5]), seen, u, np.zeros(1, np.bool_))


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 60.0])
def test_a_tile_is_seen_by_minnaerts_law_with_the_cosine_of_viewing(angle_deg: float) -> None:
    h, cos_in = transfer(view_from(angle_deg), Positions(IDS, CENTRE_MM, DOWN), TILE)
    brdf = 0.99 * 2.15 / (2 * math.pi) * math.cos(math.radians(angle_deg)) ** 0.15
    assert h[0, 0] == pytest.approx(brdf * ON_AXIS_PER_M2, rel=1e-6)
    assert cos_in[0, 0] == 1.0


def test_under_a_slanted_light_both_cosines_count() -> None:
    """An LED at 30 degrees that is turned to the tile: its own cosine is 1."""
    angle = math.radians(30)
    centre = 1000 * np.array([[math.sin(angle), 0.0, math.cos(angle)]])
    h, _ = transfer(view_from(60.0), Positions(IDS, centre, -centre / 1000), TILE)
    towards = 0.318304687 * math.cos(angle)
    brdf = 0.99 * 2.15 / (2 * math.pi) * (math.cos(angle) * 0.5) ** 0.15
    assert h[0, 0] == pytest.approx(brdf * towards, rel=1e-5)


def test_a_power_is_the_signal_over_reflectance_and_irradiance() -> None:
    found = calibrate_led_power([view_from(60.0, 2e4)], Positions(np.array([5]), CENTRE_MM, DOWN), TILE)
    brdf = 0.99 * 2.15 / (2 * math.pi) * 0.5**0.15
    assert found.power[0] == pytest.approx(2e4 / (brdf * ON_AXIS_PER_M2), rel=1e-6)


@pytest.mark.parametrize("exposure_us", [10_000.0, 250_000.0])
def test_a_constant_frame_gives_dn_per_second(exposure_us: float) -> None:
    """1000 DN over black in 10 ms are 100,000 DN/s."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 335.0
    pixels = np.full((FORMAT.height_px, FORMAT.width_px), FORMAT.black_dn + 1000, np.uint16)
    shot = ShotId.parse("v/led0005/e0")
    frame = LightFrame(shot, exposure_us, 0.0, math.nan, pose, pose, lambda: pixels)
    frames = LightFrames(
        (frame,), "GBRG", FORMAT.black_dn, FORMAT.white_dn, About(is_simulated=True), FOCAL_PX, ()
    )
    positions = Positions(np.array([5]), CENTRE_MM, DOWN)
    lens = Intrinsics(FOCAL_PX, FOCAL_PX, (FORMAT.width_px - 1) / 2, (FORMAT.height_px - 1) / 2)
    read = TileReader(
        frames, Setting(tile=TILE, base_from_support=np.eye(4), positions=positions, lens=lens), pixels.shape
    )
    views = read.view([frame], lambda: None)
    assert sorted(views) == ["B", "G", "R"]
    for view in views.values():
        assert view.signal == pytest.approx(1000 / (exposure_us * 1e-6))
        power = calibrate_led_power([view], positions, TILE).power[0]
        whole = 1000 / (exposure_us * 1e-6) / (0.99 * 2.15 / (2 * math.pi) * ON_AXIS_PER_M2)
        assert power == pytest.approx(whole, rel=3e-3)  # the tile's rim is a little farther from the LED
