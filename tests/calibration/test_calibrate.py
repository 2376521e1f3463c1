"""`coupole calibrate` from beginning to end: pictures or a run in, a record and its report out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import boards
import cv2
import numpy as np
import pytest
from arms import KR10_R1100_SIXX
from photographed import BOARD_YAML, FLANGE_FROM_CAMERA, LENS, SIZE_PX, shoot, write_folder, write_run
from synthesis import Array
from typer.testing import CliRunner, Result

import coupole
from coupole.calibration.arm_errors import axis_sensitivity
from coupole.calibration.lens.board import Board
from coupole.calibration.lens.images import find_board
from coupole.calibration.poses import Convention, read_poses
from coupole.calibration.record import read_record
from coupole.calibration.rotations import between
from coupole.calibration.sources import open_sources
from coupole.commands.calibrate import calibrate_app
from coupole.errors import CalibrationRefused, CoupoleError, InputError
from coupole.kinematics import forward

CHARUCO = Board(kind="charuco", corners=(9, 6), square_mm=16.0, marker_mm=10.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("folder") / "pictures")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("run") / "runs").folder


def calibrate(*words: object) -> Result:
    return CliRunner().invoke(calibrate_app, [*map(str, words), "--json"])


def found(result: Result) -> dict[str, Any]:
    """The JSON document of a command that may have missed its limits."""
    assert result.exception is None or isinstance(result.exception, CalibrationRefused | SystemExit), result.output
    document: dict[str, Any] = json.loads(result.stdout)
    return document


def error_of(result: Result) -> CoupoleError:
    assert isinstance(result.exception, CoupoleError), result.output
    return result.exception


def refused(*words: object) -> str:
    result = calibrate(*words)
    error = error_of(result)
    assert isinstance(error, InputError)
    assert json.loads(result.stdout)["exit_code"] == 2
    return str(error)


def hand_eye_error(document: dict[str, Any]) -> tuple[Array, Array]:
    """Error of the hand-eye transform as recorded, and its standard uncertainty: mm, degrees [6]."""
    record = read_record(Path(document["record"]))
    step = between(record.transforms["flange_from_camera"].matrix(), FLANGE_FROM_CAMERA)
    names = [f"flange_from_camera.{s}" for s in ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")]
    u = {p.name: p.u for p in record.parameters}
    return np.concatenate([step[:3], np.degrees(step[3:])]), np.array([u[name] for name in names])


def test_a_folder_of_pictures_gives_the_lens(folder: Path, tmp_path: Path) -> None:
    document = found(calibrate("camera", folder, "--model", "brown4", "--out", tmp_path, "--name", "lens"))
    assert document["images"] == len(shoot().pictures)
    fx = document["parameters"]["fx_px"]
    assert abs(fx["value"] - LENS.focal_px[0]) < 4 * fx["u"]
    assert {path.name for path in tmp_path.iterdir()} == {"lens.yaml", "lens.html", "lens.png"}
    record = read_record(tmp_path / "lens.yaml")
    assert record.validity.size_px == SIZE_PX
    assert [i.name for i in record.inputs][-2:] == ["pictures/poses.yaml", "board.yaml"]


def test_pictures_of_a_plain_board_need_no_description(tmp_path: Path) -> None:
    folder = tmp_path / "photographs"
    folder.mkdir()
    for seed in range(9):
        codes = np.rint(20 + 200 * boards.picture_of(boards.CHESS, seed).pixels).astype(np.uint8)
        cv2.imwrite(str(folder / f"{seed}.png"), codes)
    document = found(
        calibrate("camera", folder, "--board", "9x6", "--square", 16, "--model", "brown4", "--out", tmp_path)
    )
    record = read_record(Path(document["record"]))
    from_python = coupole.calibrate_camera(folder, board=(9, 6), square_mm=16.0, model="brown4")
    for here, there in zip(from_python.parameters, record.parameters, strict=True):
        assert (here.name, here.value) == (there.name, pytest.approx(there.value, abs=0.01 * there.u))
    assert (from_python.inputs, from_python.is_accepted) == (record.inputs, record.is_accepted)
    values = {parameter.name: parameter for parameter in record.parameters}
    for name, true in zip(("fx_px", "fy_px"), boards.LENS.focal_px, strict=True):
        assert abs(values[name].value - true) < 3 * values[name].u + 0.5
    assert [one.name.removeprefix("photographs/") for one in record.inputs] == [
        *(f"{seed}.png" for seed in range(9)),
        "--board 9x6 --square 16",
    ]
    assert not any("wider than high" in remark for remark in record.remarks)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--board", "9x6"), "expected the side of its squares too, --square MM"),
        (("--square", 16), "--square: belongs to a plain board"),
        (("--board", "board.yaml", "--square", 16), "--square: belongs to a plain board"),
        (("--board", "2x6", "--square", 16), "expected 3 to 200 inner corners"),
    ],
)
def test_half_of_a_plain_board_is_refused(tmp_path: Path, words: tuple[object, ...], message: str) -> None:
    assert message in refused("camera", tmp_path, *words, "--out", tmp_path / "out")


def test_a_folder_of_pictures_gives_the_hand_eye(folder: Path, tmp_path: Path) -> None:
    document = found(calibrate("hand-eye", folder, "--model", "brown4", "--out", tmp_path))
    error, u = hand_eye_error(document)
    assert np.all(np.abs(error) < 4 * u)
    assert np.linalg.norm(error[:3]) < 0.3


def test_a_run_gives_the_hand_eye_and_what_its_record_holds_for(run: Path, tmp_path: Path) -> None:
    board = tmp_path / "board.yaml"
    board.write_text(BOARD_YAML)
    document = found(
        calibrate("hand-eye", run, "--board", board, "--model", "brown4", "--out", tmp_path, "--name", "he")
    )
    error, u = hand_eye_error(document)
    assert np.all(np.abs(error) < 4 * u)
    record = read_record(tmp_path / "he.yaml")
    assert record.simulated
    assert record.validity.focus_distance_mm == 335.0
    assert record.validity.temperature_c == (20.1, 30.1)
    assert len(record.inputs) == 1 + len(shoot().pictures) + 1


def test_the_record_of_a_camera_counts_as_an_observation(folder: Path, tmp_path: Path) -> None:
    others = write_folder(tmp_path / "others", shoot(seed=4))
    found(calibrate("camera", others, "--model", "brown4", "--out", tmp_path, "--name", "lens"))
    earlier = tmp_path / "lens.yaml"
    document = found(calibrate("hand-eye", folder, "--camera", earlier, "--model", "brown4", "--out", tmp_path))
    assert document["parameters"]["fx_px"]["u"] < read_record(earlier).parameters[0].u


def test_the_record_of_a_camera_from_the_same_images_would_count_twice(folder: Path, tmp_path: Path) -> None:
    found(calibrate("camera", folder, "--model", "brown4", "--out", tmp_path, "--name", "lens"))
    message = refused("hand-eye", folder, "--camera", tmp_path / "lens.yaml", "--out", tmp_path)
    assert "was made from the same images" in message


def test_a_record_that_was_not_accepted_is_built_on_by_none(folder: Path, tmp_path: Path) -> None:
    strict = ("--model", "brown4", "--out", tmp_path, "--limit", "pixel_px=0.00001")
    assert error_of(calibrate("camera", folder, *strict, "--name", "lens")).exit_code == 3
    message = refused("hand-eye", folder, "--camera", tmp_path / "lens.yaml", "--out", tmp_path)
    assert "lens.yaml: not accepted: noise of corners is" in message


def test_a_name_that_no_record_may_have_is_refused_before_the_work(folder: Path, tmp_path: Path) -> None:
    assert "--name my record: expected letters" in refused(
        "camera", folder, "--out", tmp_path, "--name", "my record"
    )


@pytest.mark.parametrize("suffix", [".csv", ".h5", ".png", ".html"])
def test_nothing_that_stands_beside_is_written_over(folder: Path, tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"dome{suffix}").write_text("precious")
    assert "exists already" in refused("camera", folder, "--out", tmp_path, "--name", "dome")
    assert (tmp_path / f"dome{suffix}").read_text() == "precious"


def test_what_misses_its_limits_is_kept_and_refused(folder: Path, tmp_path: Path) -> None:
    result = calibrate("hand-eye", folder, "--model", "brown4", "--out", tmp_path, "--repeatability-mm", 1e-4,
                       "--repeatability-deg", 1e-5, "--absolute-mm", 0, "--absolute-deg", 1e-5)  # fmt: skip
    assert error_of(result).exit_code == 3
    assert "ratio of the robot's estimated noise to its stated noise" in str(result.exception)
    assert json.loads(result.stdout)["accepted"] is False


def test_positions_in_metres_said_to_be_millimetres_are_refused_with_the_cause(tmp_path: Path) -> None:
    wrong = write_folder(tmp_path / "wrong", metres_said_mm=True)
    message = refused("hand-eye", wrong, "--model", "brown4", "--out", tmp_path)
    assert "likely cause: positions are in m, not mm" in message
    assert not list(tmp_path.glob("*.yaml"))


def test_a_record_is_never_written_over(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "lens.yaml").write_text("mine\n")
    assert "exists already" in refused("camera", folder, "--out", tmp_path, "--name", "lens")
    assert (tmp_path / "lens.yaml").read_text() == "mine\n"


def test_wrong_arguments_are_refused_clearly(folder: Path, run: Path, tmp_path: Path) -> None:
    out = ("--out", tmp_path / "out")
    assert "expected a run, or a folder" in refused(
        "camera", tmp_path / "none", "--board", folder / "board.yaml", *out
    )
    assert "board.yaml" in refused("camera", run, *out)
    assert "expected one of pinhole" in refused("camera", folder, "--model", "fisheye", *out)
    assert "give runs only" in refused("camera", run, folder, "--board", folder / "board.yaml", *out)
    other = tmp_path / "other.yaml"
    other.write_text(BOARD_YAML.replace("DICT", "DICT") + "dictionary: DICT_4X4_50\n")
    assert "in none of 9 images" in refused("camera", folder, "--board", other, *out)


def test_an_image_without_the_board_is_left_out_and_named(folder: Path, tmp_path: Path) -> None:
    import cv2

    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for number in range(5):
        (pictures / f"{number}.png").write_bytes((folder / f"{number}.png").read_bytes())
    cv2.imwrite(str(pictures / "grey.png"), np.full((SIZE_PX[1], SIZE_PX[0]), 128, np.uint8))
    seen = find_board(CHARUCO, open_sources([pictures], None))
    assert len(seen.sightings) == 5
    assert seen.left_out == ("grey.png: 0 of 54 corners seen, 8 needed",)


def test_poses_without_their_picture_are_refused(folder: Path, tmp_path: Path) -> None:
    poses = tmp_path / "poses.yaml"
    poses.write_text((folder / "poses.yaml").read_text() + "  lost.png: [0, 0, 0, 0, 0, 0]\n")
    with pytest.raises(InputError, match=r"there is no .*lost\.png"):
        open_sources([folder], poses)


def test_a_pose_file_with_too_few_numbers_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "poses.yaml"
    path.write_text("schema_version: 1\nposes:\n  a.png: [1, 2, 3, 4, 5]\n")
    with pytest.raises(InputError, match="6 numbers for each pose"):
        read_poses(path)


def test_pose_numbers_are_read_in_every_convention(tmp_path: Path) -> None:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("ZYX", [20, -30, 40], degrees=True)
    w = turn.as_quat()[[3, 0, 1, 2]]
    for rotation, unit, numbers in (
        ("abc", "deg", [20, -30, 40]),
        ("xyz", "rad", turn.as_euler("XYZ")),
        ("rotation_vector", "rad", turn.as_rotvec()),
        ("quaternion_wxyz", "deg", 2 * w),
    ):
        path = tmp_path / f"{rotation}.yaml"
        written = ", ".join(map(str, map(float, [0.1, 0.2, 0.3, *numbers])))
        path.write_text(
            f"schema_version: 1\nlength_unit: m\nangle_unit: {unit}\nrotation: {rotation}\n"
            f"gives: flange_from_base\nposes:\n  a.png: [{written}]\n"
        )
        _, poses = read_poses(path)
        inverse = np.linalg.inv(poses.base_from_flange[0])
        assert np.allclose(inverse[:3, :3], turn.as_matrix(), atol=1e-12)
        assert np.allclose(inverse[:3, 3], [100, 200, 300])
    assert Convention().gives == "base_from_flange"


def test_the_arms_sensitivity_is_that_of_its_kinematics() -> None:
    joints = np.array([[10.0, -80, 95, 20, 60, -40], [0, -90, 90, 0, 90, 0]])
    small = np.array([0.01, -0.02, 0.015, 0.01, -0.01, 0.02])
    for at, slope in zip(joints, axis_sensitivity(KR10_R1100_SIXX, joints), strict=True):
        before, after = forward(KR10_R1100_SIXX, at), forward(KR10_R1100_SIXX, at + small)
        moved = np.linalg.inv(before) @ after
        assert np.allclose(moved[:3, 3], (slope @ small)[:3], atol=2e-3)
        turned = 0.5 * (moved[:3, :3] - moved[:3, :3].T)[[2, 0, 1], [1, 2, 0]]
        assert np.allclose(turned, (slope @ small)[3:], atol=1e-6)
