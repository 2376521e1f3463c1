"""The board through the whole simulated camera: its corners are found where OpenCV projects them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from board_truth import inner_corners_mm
from numpy.typing import NDArray

from coupole.geometry import inverse
from sim.objects.charuco import Charuco, charuco_board, opencv_board
from sim.optics import blur
from sim.optics.objective import Objective, vignetting
from sim.optics.sensor import electrons, expose_electrons, mosaic_electrons
from sim.optics.sensor_model import SensorModel
from sim.render.camera_view import View, Viewer, slopes
from sim.render.lens import Lens, sight
from sim.scene.scene import build_scene

BOARD = Charuco(7, 5)
PITCH_UM = 22.0
LENS = Lens.at_focus(
    1024,
    768,
    pixel_pitch_um=PITCH_UM,
    focal_length_mm=35.0,
    focus_distance_mm=334.0,
    distortion=(-0.08, 0.02, 5e-4, -3e-4, 0.0),
)
MONO = SensorModel(bayer_pattern="MONO", seed=3)
WHITE_E = 8_000.0


@pytest.fixture(scope="module")
def falloff() -> NDArray[np.float32]:
    return vignetting(Objective(), np.hypot(*slopes(sight(LENS)))).astype(np.float32)


@pytest.fixture(scope="module")
def base_from_camera() -> NDArray[np.float64]:
    """Looks down at the board from 330 mm, tilted by 15 degrees."""
    tilt = np.radians(15.0)
    pose = np.eye(4)
    z = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    pose[:3, :3] = np.stack([np.cross([0.0, -1.0, 0.0], z), [0.0, -1.0, 0.0], z], axis=1)
    pose[:3, 3] = -330.0 * z
    return pose


def view_of_board(base_from_camera: NDArray[np.float64], samples: int) -> View:
    return Viewer(build_scene([(charuco_board(BOARD), np.eye(4))]), LENS, samples).look(base_from_camera)


def misses_px(frame: NDArray[np.uint16], base_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """[corners, 2] what OpenCV finds less where OpenCV projects the truth."""
    picture = np.clip(frame.astype(float) / 16.0, 0, 255).astype(np.uint8)
    found, ids, _, _ = cv2.aruco.CharucoDetector(opencv_board(BOARD)).detectBoard(picture)
    assert len(ids) == (BOARD.squares_x - 1) * (BOARD.squares_y - 1)
    camera_from_base = inverse(base_from_camera)
    matrix = np.diag([LENS.focal_px, LENS.focal_px, 1.0])
    matrix[:2, 2] = LENS.centre_px
    true, _ = cv2.projectPoints(
        inner_corners_mm(BOARD)[ids.ravel()],
        cv2.Rodrigues(camera_from_base[:3, :3])[0],
        camera_from_base[:3, 3],
        matrix,
        np.array(LENS.distortion),
    )
    return np.asarray(found[:, 0] - true[:, 0])


def test_corners_of_a_supersampled_frame_are_found_to_a_tenth_of_a_pixel(
    base_from_camera: NDArray[np.float64], falloff: NDArray[np.float32]
) -> None:
    view = view_of_board(base_from_camera, 4)
    frame = np.empty((768, 1024), np.uint16)
    light = (view.site, view.diffuse, falloff)
    mean_e = mosaic_electrons(*light, model=MONO, electrons_per_radiance=WHITE_E)
    expose_electrons(frame, mean_e, model=MONO, frame=1)
    misses = misses_px(frame, base_from_camera)
    assert np.sqrt(np.mean(misses**2)) < 0.14
    assert np.abs(misses.mean(axis=0)).max() < 0.06


def test_blur_leaves_the_corners_in_place(
    base_from_camera: NDArray[np.float64], falloff: NDArray[np.float32]
) -> None:
    view = view_of_board(base_from_camera, 1)
    image = electrons(view.site, view.diffuse, falloff, electrons_per_radiance=WHITE_E)
    lens = Objective(f_number=4.0)
    disk_px = blur.defocus_blur_px(lens, np.full(view.site.shape, 380.0, np.float32), PITCH_UM)
    soft = blur.through(lens, image, disk_px, MONO.channels(), pixel_pitch_um=PITCH_UM)
    misses = []
    for mean_e in (np.ascontiguousarray(image[..., 1]), soft):
        frame = np.empty((768, 1024), np.uint16)
        expose_electrons(frame, mean_e, model=MONO, frame=1)
        misses.append(misses_px(frame, base_from_camera))
    moved = misses[1] - misses[0]
    assert np.sqrt(np.mean(moved**2)) < 0.15
    assert np.abs(moved.mean(axis=0)).max() < 0.03
