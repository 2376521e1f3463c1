"""Poses of COLMAP's models, which pycolmap has written, moved, turned and scaled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lazily import lazily
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coupole.calibration.optics import Intrinsics
from coupole.calibration.posed_camera import CameraPrior
from coupole.errors import InputError
from coupole.reflectance.alignment.colmap_model import read_model
from coupole.reflectance.alignment.colmap_poses import read_poses
from coupole.reflectance.extraction.pointing import Pointing

pycolmap: Any = lazily("pycolmap")

LENS = Intrinsics(800.0, 801.0, 199.5, 149.5, -0.1, 0.02, 1e-4, -2e-4)
FREE = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
U_LENS = (0.5, 0.5, 0.3, 0.3, 1e-3, 1e-3, 1e-5, 1e-5)
U_MM, U_RAD = 0.1, 2e-4
BASE_FROM_SUPPORT = np.eye(4)
BASE_FROM_SUPPORT[:3, :3] = Rotation.from_euler("z", 30, degrees=True).as_matrix()
BASE_FROM_SUPPORT[:3, 3] = (500.0, 20.0, 300.0)
NAMES = ("top", "left", "right", "behind")


@dataclass(frozen=True)
class View:
    name: str
    base_from_camera: NDArray[np.float64]
    pointing: Pointing


@dataclass(frozen=True)
class Measured:
    """What is read of a `MeasuredRun`."""

    run: Any
    frames: Any
    views: tuple[View, ...]
    lens: Intrinsics
    camera: CameraPrior
    base_from_support: NDArray[np.float64]


def camera_at(place_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] base_from_camera, looking at the support's middle."""
    pose = np.eye(4)
    ahead = BASE_FROM_SUPPORT[:3, 3] - place_mm
    ahead /= np.linalg.norm(ahead)
    across = np.cross([0.1, 0.9, 0.2], ahead)
    across /= np.linalg.norm(across)
    pose[:3, :3] = np.stack([across, np.cross(ahead, across), ahead], axis=1)
    pose[:3, 3] = place_mm
    return pose


def measured_run(count: int, *, on_a_line: bool = False) -> Any:
    places = BASE_FROM_SUPPORT[:3, 3] + np.array([[0, 0, 900], [-500, 0, 700], [500, 80, 720], [60, 600, 640.0]])
    if on_a_line:
        places = BASE_FROM_SUPPORT[:3, 3] + np.array([[100.0 * n, 0, 900] for n in range(4)])
    covariance = np.diag([*np.square(U_LENS), *[U_MM**2] * 3, *[U_RAD**2] * 3, *[1.0] * 6])
    pointing = Pointing(FREE, covariance, np.zeros(3))
    views = tuple(
        View(name, camera_at(place), pointing) for name, place in zip(NAMES[:count], places[:count], strict=True)
    )
    prior = CameraPrior(LENS, FREE, np.eye(4), np.diag([*np.square(U_LENS), *[1e-4] * 6]))
    frames = SimpleNamespace(size_px=(400, 300))
    return Measured(SimpleNamespace(folder=Path("vase")), frames, views, LENS, prior, BASE_FROM_SUPPORT)


def model_of(measured: Any, base_from_camera: Any = None, points_mm: Any = None, **lens: float) -> Any:
    """pycolmap's, in the support's frame, with images as the export names them, which see points [n, 3]."""
    points_mm = np.zeros((3, 3)) if points_mm is None else points_mm
    values = {name: getattr(LENS, name) for name in FREE} | lens
    values["cx"] += 0.5
    values["cy"] += 0.5
    found = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="OPENCV", width=400, height=300, params=list(values.values()))
    found.add_camera_with_trivial_rig(camera)
    poses = [view.base_from_camera for view in measured.views] if base_from_camera is None else base_from_camera
    for number, (view, pose) in enumerate(zip(measured.views, poses, strict=True), start=1):
        camera_from_world = np.linalg.inv(pose) @ BASE_FROM_SUPPORT
        image = pycolmap.Image(name=f"{view.name}.png", camera_id=1, image_id=number)
        pixels = camera.img_from_cam(points_mm @ camera_from_world[:3, :3].T + camera_from_world[:3, 3])
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        found.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera_from_world[:3]))
    return found


def written(model: Any, folder: Path, kind: str = "binary") -> Path:
    folder.mkdir(exist_ok=True)
    getattr(model, f"write_{kind}")(str(folder))
    return folder


def scattered(measured: Any, mm: float, rad: float) -> NDArray[np.float64]:
    """Poses as a bundle adjustment may have changed them."""
    random = np.random.default_rng(3)
    poses = np.stack([view.base_from_camera for view in measured.views])
    poses[:, :3, 3] += random.normal(0.0, mm, (len(poses), 3))
    turns = Rotation.from_rotvec(random.normal(0.0, rad, (len(poses), 3))).as_matrix()
    poses[:, :3, :3] = poses[:, :3, :3] @ turns
    return poses


@pytest.mark.parametrize("kind", ["text", "binary"])
@pytest.mark.parametrize("count", [1, 2, 4])
def test_poses_come_back_as_they_were(kind: str, count: int, tmp_path: Path) -> None:
    measured = measured_run(count)
    (tmp_path / "sparse").mkdir()
    written(model_of(measured), tmp_path / "sparse/0", kind)
    poses = read_poses(tmp_path, measured)
    for view, recorded in zip(poses.of(measured).views, measured.views, strict=True):
        np.testing.assert_allclose(view.base_from_camera, recorded.base_from_camera, atol=1e-8)
    assert poses.scale == pytest.approx(1.0, abs=1e-11)
    assert poses.summary()["fitted"] == (count == 4)


def test_a_model_that_was_moved_turned_and_scaled_is_brought_back(tmp_path: Path) -> None:
    """With scatter, which stays: only what is common to all cameras is taken off."""
    measured = measured_run(4)
    poses = scattered(measured, mm=0.1, rad=2e-4)
    model = model_of(measured, poses)
    direct = read_poses(written(model, tmp_path / "direct"), measured)
    turn = pycolmap.Rotation3d(Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix())
    model.transform(pycolmap.Sim3d(0.037, turn, np.array([3.0, -8.0, 11.0])))
    found = read_poses(written(model, tmp_path / "moved"), measured)
    assert found.scale == pytest.approx(direct.scale / 0.037, rel=1e-9)
    np.testing.assert_allclose(found.base_from_camera, direct.base_from_camera, atol=1e-6)
    np.testing.assert_allclose(found.base_from_camera[:, :3, 3], poses[:, :3, 3], atol=0.5)
    apart_mm = np.linalg.norm(found.base_from_camera[:, :3, 3] - poses[:, :3, 3], axis=1)
    assert apart_mm.max() < 0.4  # the scatter's own share in the similarity
    recorded = np.stack([view.base_from_camera for view in measured.views])
    off_mm = found.base_from_camera[:, :3, 3] - recorded[:, :3, 3]
    np.testing.assert_allclose(off_mm.mean(axis=0), 0.0, atol=1e-9)
    assert found.summary()["median_moved_mm"] == pytest.approx(np.median(np.linalg.norm(off_mm, axis=1)), abs=1e-6)
    assert 0.3 < found.summary()["most_over_u"] < 5.0


def test_what_colmaps_own_bundle_adjustment_finds_is_taken(tmp_path: Path) -> None:
    """Cameras that were moved from where they saw 200 points are put back, in a frame and unit of COLMAP's own."""
    measured, random = measured_run(4), np.random.default_rng(4)
    points_mm = random.uniform(-100.0, 100.0, (200, 3)) * [1.0, 1.0, 0.3]
    model = model_of(measured, points_mm=points_mm)
    for number, point in enumerate(points_mm):
        track = pycolmap.Track([pycolmap.TrackElement(image, number) for image in model.images])
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    for image in model.images.values():
        push = pycolmap.Rigid3d(
            pycolmap.Rotation3d(np.array([*random.normal(0, 2e-3, 3), 1.0])), random.normal(size=3)
        )
        image.frame.set_cam_from_world(1, push * image.cam_from_world())
    with pytest.raises(InputError, match="from its place in the records"):
        read_poses(written(model, tmp_path / "pushed"), measured)
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False, refine_principal_point=False, refine_extra_params=False, print_summary=False
    )
    pycolmap.bundle_adjustment(model, options)
    poses = read_poses(written(model, tmp_path / "adjusted"), measured)
    recorded = np.stack([view.base_from_camera for view in measured.views])
    np.testing.assert_allclose(poses.base_from_camera[:, :3, 3], recorded[:, :3, 3], atol=0.01)
    np.testing.assert_allclose(poses.base_from_camera[:, :3, :3], recorded[:, :3, :3], atol=2e-5)


def test_with_one_or_two_views_nothing_fixes_another_frame(tmp_path: Path) -> None:
    measured = measured_run(2)
    model = model_of(measured)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([3.0, 0.0, 0.0])))
    with pytest.raises(InputError, match=r"camera of \w+ is 3 mm .* with one or two views .* 30.0 times"):
        read_poses(written(model, tmp_path / "moved"), measured)


def test_poses_that_the_records_do_not_allow_are_refused(tmp_path: Path) -> None:
    measured = measured_run(4)
    shifted = np.stack([view.base_from_camera for view in measured.views])
    shifted[2, :3, 3] += [0.0, 0.0, 4.0]
    with pytest.raises(
        InputError, match=r"the camera of right is .* from its place in the records, after a similarity to the 4"
    ):
        read_poses(written(model_of(measured, shifted), tmp_path / "shifted"), measured)
    turned = np.stack([view.base_from_camera for view in measured.views])
    turned[1, :3, :3] = turned[1, :3, :3] @ Rotation.from_rotvec([0.0, 0.0, 11 * U_RAD]).as_matrix()
    with pytest.raises(
        InputError, match=r"the camera of left is 0.126 degrees .* 11.0 times .* expected 5 at most"
    ):
        read_poses(written(model_of(measured, turned), tmp_path / "turned"), measured)
    line = measured_run(4, on_a_line=True)
    with pytest.raises(InputError, match="the run's cameras stand on a line"):
        read_poses(written(model_of(line), tmp_path / "line"), line)


def test_another_lens_is_refused(tmp_path: Path) -> None:
    measured = measured_run(4)
    near = model_of(measured, fx=801.0, cx=LENS.cx + 1.2)  # twice and four times its uncertainty
    read_poses(written(near, tmp_path / "near"), measured)
    with pytest.raises(
        InputError, match=r"cameras.bin: camera 1: another lens .* fx is 804 there, 800 by the record"
    ):
        read_poses(written(model_of(measured, fx=804.0), tmp_path / "far"), measured)
    model = model_of(measured)
    model.cameras[1].width = 800
    with pytest.raises(InputError, match=r"expected pictures of \(400, 300\) px; found \(800, 300\)"):
        read_poses(written(model, tmp_path / "size"), measured)


def test_views_without_an_image_and_damaged_files_are_refused(tmp_path: Path) -> None:
    measured = measured_run(4)
    model = model_of(measured)
    model.images[2].name = "sinister.png"
    with pytest.raises(InputError, match=r"has 0 images of the view left; expected left.png, .* found behind.png"):
        read_poses(written(model, tmp_path / "names"), measured)
    model.images[2].name = "more/top.jpg"
    with pytest.raises(InputError, match="has 2 images of the view top"):
        read_poses(written(model, tmp_path / "twice"), measured)
    with pytest.raises(InputError, match="expected a model of COLMAP"):
        read_poses(tmp_path, measured)
    cut = written(model, tmp_path / "cut")
    (cut / "images.bin").write_bytes((cut / "images.bin").read_bytes()[:150])
    with pytest.raises(InputError, match=r"images.bin: expected COLMAP's binary; it is damaged or cut short"):
        read_model(cut)
    text = written(model, tmp_path / "text", "text")
    images = (text / "images.txt").read_text().replace("left.png", "").replace(" more/top.jpg", "")
    (text / "images.txt").write_text(images)
    with pytest.raises(
        InputError, match=r"images.txt:\d+:1: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    ):
        read_model(text)
    (text / "cameras.txt").write_text("1 OPENCV_FISHEYE 400 300 1 2 3 4 5 6 7 8\n")
    with pytest.raises(InputError, match="camera OPENCV_FISHEYE of 8 parameters: expected one of SIMPLE_PINHOLE"):
        read_model(text)
