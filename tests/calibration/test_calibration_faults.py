"""What goes wrong in a cell, seen through the commands: each fault is named, and the exit code says so."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cells
import numpy as np
import pytest
from cells import CellFolder, Ended
from photographed import BOARD_YAML, Shoot, shoot, write_folder, write_run
from raw_runs import led_frames, sticker_frames, write_hand_eye, write_raw_run, write_rig
from scipy.spatial.transform import Rotation
from sticker_scenes import Scene, scene, write_scan
from synthesis import frame

from coupole.calibration.record import Record, read_record, seal_record, write_record
from coupole.geometry import transform
from coupole.plan.led_table import read_led_table


def calibrate(kind: str, *words: object) -> Ended:
    """The command, with its JSON document."""
    return cells.here("calibrate", kind, *map(str, words), "--json")


def said(ended: Ended) -> str:
    """All that an operator reads: what went wrong, and the record's remarks."""
    return " ".join([ended.err, *ended.document.get("remarks", ())])


def resealed(record: Record, **validity: object) -> Record:
    """A record that holds elsewhere."""
    content = {name: getattr(record, name) for name in Record.model_fields}
    del content["schema_version"], content["sha256"]
    return seal_record(**content | {"validity": record.validity.model_copy(update=validity)})


# -- camera and hand-eye --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without a fault."""
    return write_run(tmp_path_factory.mktemp("sound") / "run").folder


def of_board(kind: str, run: Path, tmp_path: Path, *words: object, described: str = BOARD_YAML) -> Ended:
    board = tmp_path / "board.yaml"
    board.write_text(described)
    return calibrate(kind, run, "--board", board, "--model", "brown4", "--out", tmp_path / "out", *words)


def test_a_sound_run_is_calibrated(sound: Path, tmp_path: Path) -> None:
    """So that the faults below are what is refused."""
    ended = of_board("hand-eye", sound, tmp_path)
    missed = [limit["name"] for limit in ended.document["limits"] if not limit["passed"]]
    assert missed in ([], ["turn_deg"]), "nine small frames may turn too freely"
    assert "contradict" not in said(ended)


def test_a_board_that_was_moved_in_mid_run_is_named_with_the_views_between_which(tmp_path: Path) -> None:
    made = shoot()
    step = frame(np.array([3.0, -2.0, 0.0]), np.array([0.0, 0.0, 1.5]))
    poses = tuple(pose if n < 5 else step @ pose for n, pose in enumerate(made.base_from_flange))
    run = write_run(tmp_path / "run", Shoot(made.pictures, poses)).folder
    ended = of_board("hand-eye", run, tmp_path)
    assert ended.code == 2
    assert "likely cause: the board was moved between v4 and v5" in ended.err


def test_an_arm_that_reports_metres_is_named(tmp_path: Path) -> None:
    made = shoot()
    poses = tuple(transform(pose[:3, 3] / 1e3, (0, 0, 0)) @ turned(pose) for pose in made.base_from_flange)
    run = write_run(tmp_path / "run", Shoot(made.pictures, poses)).folder
    ended = of_board("hand-eye", run, tmp_path)
    assert ended.code == 2
    assert "likely cause: positions are in m, not mm" in ended.err


def test_radians_in_a_file_that_says_degrees_are_named(tmp_path: Path) -> None:
    ended = calibrate("hand-eye", write_folder(tmp_path / "pictures", radians_said_deg=True), "--model", "brown4",
                      "--out", tmp_path / "out")  # fmt: skip
    assert ended.code == 2
    assert "likely cause: angles are in radians, not degrees" in ended.err


def test_an_arm_whose_a_and_c_are_swapped_is_named(tmp_path: Path) -> None:
    made = shoot()
    poses = []
    for pose in made.base_from_flange:
        a, b, c = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX", degrees=True)
        poses.append(transform(pose[:3, 3], (c, b, a)))
    run = write_run(tmp_path / "run", Shoot(made.pictures, tuple(poses))).folder
    ended = of_board("hand-eye", run, tmp_path)
    assert ended.code == 2
    assert "likely cause: rotations are" in ended.err
    assert "with the numbers in the order (2, 1, 0)" in ended.err


def test_a_board_that_is_described_in_metres_is_named(sound: Path, tmp_path: Path) -> None:
    described = BOARD_YAML.replace("square_mm: 16.0", "square_mm: 0.016").replace(
        "marker_mm: 10.0", "marker_mm: 0.01"
    )
    ended = of_board("hand-eye", sound, tmp_path, described=described)
    assert ended.code == 2
    assert "likely cause: the board's squares are given in m, not mm" in ended.err


def test_clipped_images_are_left_out_by_name_and_too_many_are_not_accepted(tmp_path: Path) -> None:
    light = [0.8] * 6 + [3.0] * 3
    ended = of_board("camera", write_run(tmp_path / "run", light=light).folder, tmp_path)
    assert ended.code == 3
    assert "v6: clipped" in said(ended)
    assert "images that are too clipped to find corners is 0.333" in ended.err


def test_a_lens_of_another_focus_is_not_taken_for_an_observation(sound: Path, tmp_path: Path) -> None:
    made = of_board("camera", sound, tmp_path, "--name", "lens")
    lens = read_record(Path(made.document["record"]))
    write_record(tmp_path / "far.yaml", resealed(lens, focus_distance_mm=400.0))
    ended = of_board("hand-eye", sound, tmp_path, "--camera", tmp_path / "far.yaml")
    assert ended.code == 2
    assert "far.yaml: is valid for a focus of 400 mm" in ended.err


# -- LEDs -----------------------------------------------------------------------------------------------------

DEAD, SWAPPED = 4, (7, 15)


@pytest.fixture(scope="module")
def lit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of three boards, its rig and the camera's record; an LED is dead, two are swapped."""
    folder = tmp_path_factory.mktemp("lit")
    dome, frames = led_frames()
    write_rig(folder, dome)
    write_hand_eye(folder / "hand-eye.yaml", scene(1, stickers=1, views=1).prior)
    names = {f"led{one:04d}": f"led{other:04d}" for one, other in (SWAPPED, SWAPPED[::-1])}
    dark = next(one.pixels for one in frames if one.pixels.max() < 500)
    wired = [replace(one, light=names.get(one.light, one.light)) for one in frames]
    wired = [replace(one, pixels=dark) if one.light == f"led{DEAD:04d}" else one for one in wired]
    write_raw_run(folder / "run", wired)
    return folder


def leds(folder: Path, out: Path, hand_eye: Path | None = None, *options: str) -> Ended:
    (run,) = (path.parent for path in (folder / "run").glob("*/run.json"))
    words = ("--hand-eye", hand_eye or folder / "hand-eye.yaml", "--rig", folder / "rig.yaml", "--out", out)
    return calibrate("leds", run, *words, *options)


def test_a_dead_led_and_two_swapped_ones_are_named(lit: Path, tmp_path: Path) -> None:
    ended = leds(lit, tmp_path)
    assert ended.code == 3, ended.err
    assert "LEDs not found" in ended.err
    assert "faults of LEDs and wires" in ended.err
    assert {"dead", "swapped"} <= {fault["kind"] for fault in ended.document["faults"]}
    assert any("dead" in remark and str(DEAD) in remark for remark in ended.document["remarks"])
    assert any(
        "swapped" in remark and all(str(led) in remark for led in SWAPPED) for remark in ended.document["remarks"]
    )


def test_accepted_faults_leave_the_table_with_swapped_leds_at_each_others_place(lit: Path, tmp_path: Path) -> None:
    few_views = ("--limit", "missing=0.1", "--limit", "centre_mm=1.0")
    ended = leds(lit, tmp_path, None, "--accept-faults", *few_views)
    assert ended.code == 0, ended.err
    (written,) = tmp_path.glob("*.csv")
    new, old = read_led_table(written), read_led_table(lit / "dome.csv")
    off_mm = np.linalg.norm(new.positions_mm[list(SWAPPED)] - old.positions_mm[list(SWAPPED[::-1])], axis=1)
    assert (off_mm < 5.0).all()
    assert len(ended.document["faults"]) >= 2


def test_a_camera_warmer_than_its_record_holds_for_is_named(lit: Path, tmp_path: Path) -> None:
    record = write_hand_eye(
        tmp_path / "cool.yaml", scene(1, stickers=1, views=1).prior, temperature_c=(15.0, 20.0)
    )
    ended = leds(lit, tmp_path, record)
    assert ended.code == 2
    assert "cool.yaml: is valid from 15 to 20 C; the coolest LED board of these images had 25 C" in ended.err


def test_a_focus_ring_that_was_turned_is_named(lit: Path, tmp_path: Path) -> None:
    record = write_hand_eye(tmp_path / "far.yaml", scene(1, stickers=1, views=1).prior, focus_distance_mm=400.0)
    ended = leds(lit, tmp_path, record)
    assert ended.code == 2
    assert "far.yaml: is valid for a focus of 400 mm" in ended.err


def test_an_expired_record_stops_an_acquisition_before_it_begins(cell: CellFolder) -> None:
    path = write_hand_eye(cell.folder / "hand-eye.yaml", scene(1, stickers=1, views=1).prior)
    old = read_record(path)
    hour_ago = datetime.now(UTC) - timedelta(hours=1)
    write_record(path, resealed(old, expires=hour_ago))
    cell.write(calibrations=["hand-eye.yaml"])
    ended = cell.acquire()
    assert ended.code == 3
    assert "hand-eye.yaml: expired on" in ended.err
    assert not list((cell.folder / "storage").glob("2*"))


# -- stickers -------------------------------------------------------------------------------------------------


def test_stickers_of_which_a_third_is_gone_and_as_many_are_false_are_named(tmp_path: Path) -> None:
    """Of twenty, the table has the last fifteen and the object the first fifteen."""
    made = scene(5, stickers=20, missing=5)
    table: Scene = replace(made, names=made.names[5:], targets_mm=made.targets_mm[5:])
    run = write_raw_run(tmp_path / "run", sticker_frames(made), pattern="MONO")
    record = write_hand_eye(tmp_path / "hand-eye.yaml", made.prior)
    ended = calibrate("mesh", run, "--scan", write_scan(tmp_path / "scan", table), "--hand-eye", record,
                      "--out", tmp_path / "out")  # fmt: skip
    assert ended.code in (0, 3), ended.err
    text = said(ended)
    assert "5 stickers of the table were not found: T15, T16, T17, T18, T19" in text
    assert "5 detected points are not in the table" in text
    found = ended.document["transforms"]["base_from_mesh"]
    place = transform(found["translation_mm"], found["abc_deg"])
    off = (place - made.base_from_mesh) @ np.append(made.targets_mm.mean(axis=0), 1.0)
    assert np.linalg.norm(off) < 0.1


def turned(
    pose: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """The rotation of a pose alone."""
    alone = pose.copy()
    alone[:3, 3] = 0.0
    return alone
