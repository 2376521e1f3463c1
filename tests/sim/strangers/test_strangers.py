"""Each stranger is what it says, by another library or a closed form."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from lazily import lazily
from pydantic import ValidationError

from sim.devices.kuka_axes import Axes
from sim.devices.kuka_kinematics import PoseErrors, flange_pose
from sim.devices.kuka_settings import Settings as KukaSettings
from sim.optics.objective import Objective, vignetting
from sim.render.camera_view import Viewer
from sim.render.emitter import irradiance, square
from sim.render.lens import Lens, distorted_points, sight
from sim.scene.scene import build_scene
from sim.scene.surface import Material, Surface
from sim.scene.things import CharucoBoard, Sample
from sim.strangers import Strangers
from sim.strangers.arm_stranger import ArmStranger
from sim.strangers.lens_stranger import LensStranger
from sim.strangers.light_stranger import LightStranger
from sim.strangers.sensor_stranger import SensorStranger
from sim.strangers.target_stranger import TargetStranger
from sim.world.config import Settings

stats: Any = lazily("scipy.stats")
BROWN = (-0.03, 0.02, 5e-4, -3e-4, 0.0)
ODD = LensStranger(rational=(0.3, -0.1, 0.05), prism=(2e-3, -4e-3, -1e-3, 3e-3))
PLAIN = Lens(160, 120, 200.0, BROWN)
OVER_MM = 300.0


def opencv_pixels(points_mm: np.ndarray, lens: Lens) -> np.ndarray:
    """OpenCV's image of points of the camera frame."""
    matrix = np.array(
        [[lens.focal_px, 0.0, lens.centre_px[0]], [0.0, lens.focal_px, lens.centre_px[1]], [0, 0, 1]]
    )
    return cv2.projectPoints(points_mm, np.zeros(3), np.zeros(3), matrix, np.array(lens.distortion))[0][:, 0]


def rendered_pixels(places_mm: np.ndarray, lens: Lens) -> np.ndarray:
    """Where the rasteriser shows small squares at `places_mm` [n, 3]: the means of their pixels."""
    half, turns = 4.0, np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    corners = [place + half * turns for place in places_mm]
    triangles = np.array([[c[0], c[1], c[2]] for c in corners] + [[c[0], c[2], c[3]] for c in corners])
    surface = Surface(triangles, (Material("white", (1, 1, 1)),), np.zeros(len(triangles), np.int32))
    view = Viewer(build_scene([(surface, np.eye(4))]), lens, samples=4).look(np.eye(4))
    square_of = np.append(view.sides // 2 % len(places_mm), -1)[view.site]
    rows, columns = np.indices(view.site.shape)
    shown = [(columns[square_of == n].mean(), rows[square_of == n].mean()) for n in range(len(places_mm))]
    return (np.array(shown) + 0.5) / 4.0 - 0.5


@pytest.mark.parametrize("strange", [ODD, LensStranger(stop_shift_mm=(6.0, -4.0)), LensStranger()])
def test_points_are_seen_where_opencv_projects_them(strange: LensStranger) -> None:
    plain = PLAIN if strange != LensStranger(stop_shift_mm=(6.0, -4.0)) else Lens(160, 120, 200.0)
    lens = strange.disturbed_lens(plain, OVER_MM)
    x, y = np.meshgrid([-95.0, -40.0, 50.0, 90.0], [-70.0, 10.0, 65.0])
    places = np.stack([x.ravel(), y.ravel(), np.full(x.size, OVER_MM)], axis=1)
    assert rendered_pixels(places, lens) == pytest.approx(opencv_pixels(places, lens), abs=0.06)
    xy = places[:, :2] / OVER_MM
    if not any(lens.off_axis):
        seen = distorted_points(xy, lens.distortion) * lens.focal_px + lens.centre_px
        assert seen == pytest.approx(opencv_pixels(places, lens), abs=1e-9)
    assert lens.centre_px[0] - 79.5 == pytest.approx(strange.stop_shift_mm[0] / OVER_MM * 200.0)


def test_distortion_stays_on_the_lens_s_axis_when_the_stop_is_off_it() -> None:
    lens = LensStranger(stop_shift_mm=(6.0, 0.0)).disturbed_lens(
        Lens(160, 120, 200.0, (-0.1, 0, 0, 0, 0)), OVER_MM
    )
    middle = np.array([[-lens.off_axis[0], 0.0]])
    assert distorted_points(middle, lens.terms) == pytest.approx(middle)
    at = middle + np.array([0.2, 0.1])
    assert distorted_points(at, lens.terms) - middle == pytest.approx(np.array([[0.2, 0.1]]) * (1 - 0.1 * 0.05))
    seen = sight(lens)
    assert seen.shift is not None
    ray = (np.array([130, 20]) - lens.centre_px) / lens.focal_px + seen.shift[:, 20, 130]
    assert distorted_points(ray, lens.terms) * 200.0 + lens.centre_px == pytest.approx([130, 20], abs=1e-4)


def test_a_decentred_stop_moves_the_rim_s_shadow() -> None:
    objective = Objective(rim_radius=1.5)
    pupil_mm = 0.5 * 35.0 / 8.0
    tangents, shift_mm = np.array([0.2, 0.3]), 0.4
    moved = vignetting(objective, tangents, (np.full(2, shift_mm), shift_mm))
    same = vignetting(objective, tangents - shift_mm / pupil_mm / objective.rim_shift)
    fourth = [(1 + t * t) ** -2 for t in (tangents, tangents - shift_mm / pupil_mm / objective.rim_shift)]
    assert moved / fourth[0] == pytest.approx(same / fourth[1])
    assert (moved > vignetting(objective, tangents)).all()


def test_a_focus_group_slides_with_the_camera_s_tilt() -> None:
    breathes = LensStranger(breathing=2e-3)
    assert breathes.with_breathing(PLAIN, 1.0).focal_px == 200.0
    assert breathes.with_breathing(PLAIN, 0.0).focal_px == pytest.approx(200.4)


def test_coma_spreads_to_one_side_and_keeps_the_light() -> None:
    image = np.zeros((81, 101, 1), np.float32)
    image[20, 80] = 1.0
    strange = LensStranger(coma_px=20.0, coma_deg=90.0)
    out = strange.with_coma(image)[..., 0]
    rows, columns = np.indices(out.shape)
    length = 20.0 * (30**2 + 20**2) / (50**2 + 40**2)
    assert np.average(columns, weights=out) == pytest.approx(80.0, abs=0.05)
    assert np.average(rows, weights=out) == pytest.approx(20.0 + length / 3, rel=0.03)
    assert out[:18].sum() < 0.005
    assert out.sum() == pytest.approx(1.0, rel=0.1)


# -- light ----------------------------------------------------------------------------------------------------


def test_an_led_with_a_lobe_gives_its_flux_by_its_lobe() -> None:
    light = LightStranger(lobe=((0, 2.0), (40, 1.6), (70, 0.4), (80, 0.0)))
    led = square((0, 0, 0), (0, 0, 1.0), side_mm=7.0, flux_lm=10.0)
    angle = np.radians(np.linspace(0.05, 89.95, 900))
    ways = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    lux = irradiance(led, 1000.0 * ways, -ways) * light.over_cosine(led, (1000.0 * ways).astype(np.float32), 1)
    assert 2 * np.pi * np.trapezoid(lux * np.sin(angle), angle) == pytest.approx(10.0, rel=2e-3)
    assert np.interp(np.radians(40), angle, lux) / lux[0] == pytest.approx(0.8, rel=2e-3)
    assert lux[angle > np.radians(81)].max() == 0.0


def test_a_lobe_that_does_not_begin_at_the_normal_is_refused() -> None:
    with pytest.raises(ValidationError, match="rise from 0"):
        LightStranger(lobe=((10, 1.0), (90, 0.0)))


def test_dies_are_tilted_by_as_much_as_said_and_stay_where_they_are() -> None:
    normals = np.tile([0.6, 0.0, 0.8], (2000, 1))
    tilted = LightStranger(die_tilt_deg=2.0).tilted_normals(normals, np.arange(2000))
    off_deg = np.degrees(np.arccos(np.sum(tilted * normals, axis=1)))
    assert np.sqrt(np.mean(off_deg**2)) == pytest.approx(2.0 * np.sqrt(2.0), rel=0.05)


def test_dies_of_unequal_lobes_give_their_flux_by_powers_of_the_cosine() -> None:
    light = LightStranger(exponent_spread=0.2)
    exponents = np.array([light.exponent(led) for led in range(2000)])
    assert np.std(exponents) == pytest.approx(0.2, rel=0.05)
    led = square((0, 0, 0), (0, 0, 1.0), side_mm=7.0, flux_lm=10.0)
    angle = np.radians(np.linspace(0.05, 89.0, 900))
    ways = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    lux = irradiance(led, 1000.0 * ways, -ways) * light.over_cosine(led, (1000.0 * ways).astype(np.float32), 7)
    assert 2 * np.pi * np.trapezoid(lux * np.sin(angle), angle) == pytest.approx(10.0, rel=3e-3)
    at_60 = float(np.interp(np.radians(60), angle, lux)) / lux[0]
    assert at_60 == pytest.approx(0.5 ** (1.0 + light.exponent(7)), rel=2e-3)


def test_lamps_that_warm_lose_their_share() -> None:
    lamps = LightStranger(warming=0.02, warming_frames=100.0)
    assert lamps.warmth(0) == 1.0
    assert 1.0 - lamps.warmth(100) == pytest.approx(0.02 * 0.632, rel=1e-3)
    assert 1.0 - lamps.warmth(5000) == pytest.approx(0.02)


def test_a_primary_lens_shows_the_die_nearer_to_whoever_looks() -> None:
    led = square((10, 0, 0), (0, 0, 1.0), side_mm=7.0, flux_lm=1.0)
    eye = np.array([10.0 + 300.0, 0.0, 400.0])
    seen = LightStranger(primary_lens_mm=0.5).seen_from(led, eye)
    assert seen.centre_mm == pytest.approx([10.0 + 0.5 * 0.6, 0.0, 0.0])


# -- targets --------------------------------------------------------------------------------------------------


def test_a_bent_board_is_a_cylinder() -> None:
    board = CharucoBoard(kind="charuco_board")
    flat, bent = (
        board.surface(),
        TargetStranger(board_bend_um=50.0, board_bend_deg=90.0).disturbed_surface(
            "charuco_board", board.surface()
        ),
    )
    rise = (bent.corners_mm - flat.corners_mm)[..., 2]
    top = flat.corners_mm[..., 2] > 2.0
    y = flat.corners_mm[..., 1]
    assert rise[top] == pytest.approx(0.05 * (1 - (y[top] / np.abs(y).max()) ** 2))
    assert not rise[~top].any()


def test_a_stained_tile_is_dark_at_the_stain_and_glossy_by_its_lobe() -> None:
    strange = TargetStranger(tile_lobe=0.03, tile_stain=0.04)
    made = strange.disturbed_surface("spectralon_tile", Sample(kind="spectralon_tile").surface())
    assert made.tint is not None
    middle = made.corners_mm.mean(axis=1)
    darkest = middle[np.argmin(made.tint[:, 0])]
    assert darkest[:2] == pytest.approx([8.0, 0.0], abs=2.0)
    assert made.tint.min() == pytest.approx(0.96, abs=0.002)
    assert made.materials[0].f0 == (0.03, 0.03, 0.03)


# -- the arm --------------------------------------------------------------------------------------------------

STRETCHED = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""The arm points along x, all of it at the height of A2 or 35 mm above."""


def errors(**strange: object) -> PoseErrors:
    return PoseErrors(1, 0.0, 0.0, 0.0, 0.0, ArmStranger.model_validate(strange))


def test_a_stretched_arm_sags_by_its_weight_times_its_reach() -> None:
    """The tool's 2.5 kg alone are 1155 mm from A2: a torque by hand, for a sag of A2 only."""
    compliance = 1e-4
    true = errors(sag_deg_per_nm=(0, compliance, 0, 0, 0, 0), down=(0, 0, -1.0)).true_flange_pose(STRETCHED, 0)
    masses, reaches_mm = [6.0, 4.0, 2.0, 1.5, 2.5], [560.0, 560.0, 1075.0, 1155.0, 1155.0]
    torque_nm = sum(m * 9.81e-3 * r for m, r in zip(masses, reaches_mm, strict=True))
    fall_mm = np.radians(compliance * torque_nm) * 1155.0
    assert flange_pose(STRETCHED)[2, 3] - true[2, 3] == pytest.approx(fall_mm, rel=1e-3)


def test_an_axis_with_play_stops_short_on_the_side_from_which_it_came() -> None:
    play = errors(backlash_deg=(0.02, 0, 0, 0, 0, 0))
    rising = play.true_flange_pose(STRETCHED, 0, (-5.0, 0, 0, 0, 0, 0))
    falling = play.true_flange_pose(STRETCHED, 0, (5.0, 0, 0, 0, 0, 0))
    assert rising == pytest.approx(flange_pose((-0.01, 0, 0, 0, 0, 0)))
    assert falling == pytest.approx(flange_pose((0.01, 0, 0, 0, 0, 0)))
    assert play.true_flange_pose(STRETCHED, 0) == pytest.approx(flange_pose(STRETCHED))


def test_the_controller_knows_from_where_its_axes_came() -> None:
    axes = Axes(KukaSettings(sends_to="127.0.0.1:1"), 0)
    start = axes.commanded_deg
    for step, angle in enumerate((0.1, 0.2, 0.2, 0.3, 0.3)):
        assert not axes.follow((angle, *start[1:]), 4_000_000 * step)
    assert (axes.commanded_deg[0], axes.came_from_deg[0]) == (0.3, 0.2)


def test_a_gear_s_ripple_has_its_period() -> None:
    strange = ArmStranger(ripple_deg=(0.01, 0, 0, 0, 0, 0), ripple_phase_deg=(30.0, 0, 0, 0, 0, 0))
    nowhere = np.zeros((7, 3)), np.tile([0, 0, 1.0], (6, 1))
    at = np.linspace(0.0, 9.0, 37)
    found = [strange.errors_deg((angle, 0, 0, 0, 0, 0), (angle, 0, 0, 0, 0, 0), *nowhere)[0] for angle in at]
    assert found == pytest.approx(0.01 * np.sin(2 * np.pi * 80 * at / 360 + np.pi / 6))


# -- the sensor -----------------------------------------------------------------------------------------------


def test_noise_has_the_tails_of_student_s_distribution() -> None:
    frame = np.full((400, 500), 1000, np.uint16)
    SensorStranger(tails_dn=10.0).add_tails(frame, 7, 4095)
    off = (frame.astype(float) - 1000.0) / 10.0
    for limit in (1.0, 5.0, 20.0):
        assert np.mean(np.abs(off) > limit + 0.05) == pytest.approx(2 * stats.t(2.5).sf(limit + 0.05), rel=0.15)
    again = np.full((400, 500), 1000, np.uint16)
    SensorStranger(tails_dn=10.0).add_tails(again, 8, 4095)
    assert (again != frame).mean() > 0.9


def test_the_gain_drifts_slowly_by_its_amplitude() -> None:
    gains = np.array([SensorStranger(gain_drift=0.02, gain_period_frames=100.0).gain(n) for n in range(200)])
    assert (gains.max(), gains.min()) == pytest.approx((1.02, 0.98), abs=1e-4)
    assert np.abs(np.diff(gains)).max() < 0.02 * 2 * np.pi / 100
    assert gains[:100] == pytest.approx(gains[100:])


def test_a_cell_without_strangers_has_none_and_a_ur_has_no_gears() -> None:
    assert Settings().strangers == Strangers()
    with pytest.raises(ValidationError, match="for a KUKA"):
        Settings.model_validate({"robot": {"kind": "ur"}, "strangers": {"arm": {"backlash_deg": [1e-3] * 6}}})
