"""`coupole reflectance relight` of a run's result, as its user has it."""

from __future__ import annotations

from pathlib import Path

import cells
import cv2
import numpy as np
import pytest
import relight_cases as cases
from relight_cases import Coat, waves, write_result


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("relief") / "result"
    write_result(folder, waves(), Coat(ks=(0.1, 0.1, 0.1)))
    return folder


def made(folder: Path, to: Path, *options: str | Path) -> np.ndarray:
    ended = cells.here("reflectance", "relight", folder, *options, "--to", to)
    assert ended.code == 0, ended.err
    picture: np.ndarray = np.load(to)
    return picture


def test_lights_on_the_command_line_are_summed_with_those_of_a_file(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text("lights:\n  - {kind: direction, towards: [0, 1, 1], strength: 0.5}\n")
    sun, near = ("--direction", "0,2,2"), ("--light-at", "10,20,300")
    one, other = made(folder, tmp_path / "a.npy", *sun), made(folder, tmp_path / "b.npy", *near)
    assert one.shape == (*cases.SIZE_PX[::-1], 3)
    both = made(folder, tmp_path / "c.npy", *near, "--lights", tmp_path / "scene.yaml")
    np.testing.assert_allclose(both, other + 0.5 * one, rtol=1e-5, atol=1e-6)


def test_a_camera_anywhere_has_the_size_that_is_asked(folder: Path, tmp_path: Path) -> None:
    options = (
        "--led",
        "7",
        "--from",
        "100,0,200",
        "--look-at",
        "0,0,0",
        "--size",
        "90x60",
        "--field-of-view",
        "8",
    )
    picture = made(folder, tmp_path / "a.npy", *options, "--fit", "ggx")
    assert picture.shape == (60, 90, 3)
    assert (picture > 0).mean() > 0.8


def test_a_result_of_a_camera_with_one_channel_makes_a_grey_picture(tmp_path: Path) -> None:
    write_result(tmp_path / "result", waves(), Coat(ks=(0.1, 0.1, 0.1)), channels=slice(1, 2))
    picture = made(tmp_path / "result", tmp_path / "a.npy", "--direction", "0,2,2")
    assert picture.shape == (*cases.SIZE_PX[::-1], 3)
    assert picture.max() > 0.0
    np.testing.assert_array_equal(picture, picture[..., :1].repeat(3, axis=2))


def test_a_video_turns_the_light_once_and_says_what_it_is(folder: Path, tmp_path: Path) -> None:
    to = tmp_path / "turn.mp4"
    options = ("--direction", "1,0,1", "--turn", "8", "--white", "2", "--to", to, "--json")
    ended = cells.here("reflectance", "relight", folder, *options)
    assert ended.code == 0, ended.err
    assert ended.document["white"] == 2.0
    assert ended.document["frames"] == 8
    import av

    with av.open(str(to)) as video:
        assert "simulated object" in video.metadata["comment"]
        assert "white 2" in video.metadata["comment"]
    reader = cv2.VideoCapture(str(to))
    frames = []
    while (read := reader.read())[0]:
        frames.append(read[1][..., ::-1].astype(float) / 255)
    assert len(frames) == 8
    third = made(folder, tmp_path / "third.npy", "--direction", "-1,0,1")[..., 1] / 2  # half a turn later
    shown = frames[4][..., 1]
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    assert np.abs(linear - np.clip(third, 0, 1)).mean() < 0.01
    assert np.abs(frames[0] - frames[4]).mean() > 0.05


def test_white_of_a_video_is_its_brightest_thousandth_without_a_number(folder: Path, tmp_path: Path) -> None:
    options = ("--direction", "0,0,1", "--turn", "2", "--to", tmp_path / "turn.mp4", "--json")
    ended = cells.here("reflectance", "relight", folder, *options)
    assert ended.code == 0, ended.err
    picture = made(folder, tmp_path / "a.npy", "--direction", "0,0,1")
    assert ended.document["white"] == pytest.approx(np.quantile(picture[picture.any(axis=2)], 0.999), rel=1e-3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "expected a light"),
        (["--direction", "0,0,0"], "--direction: expected X,Y,Z, not all 0"),
        (["--light-at", "1,2"], "--light-at: expected X,Y,Z in mm"),
        (["--light-at", "1,2,1e9"], "--light-at: expected X,Y,Z in mm"),
        (["--area", "0,0,9,0,0,0,5"], "--area: expected"),
        (["--area", "0,0,9,0,0,1,-5"], "--area: expected"),
        (["--led", "8"], "the result has no LED 8, only 1 from 7 to 7"),
        (["--environment", "sky.png"], "sky.png: expected an environment"),
        (["--direction", "0,0,1", "--view", "side"], "--view: expected one of top"),
        (["--direction", "0,0,1", "--fit", "best"], "--fit: expected one of ggx"),
        (["--direction", "0,0,1", "--fit", "sh"], "has no fit sh"),
        (["--direction", "0,0,1", "--from", "0,0,300", "--view", "top"], "--view: a free camera"),
        (["--direction", "0,0,1", "--from", "0,0,300", "--fit", "rbf"], "rbf holds for the view"),
        (
            ["--direction", "0,0,1", "--from", "0,0,300", "--look-at", "0,0,400", "--field-of-view", "9"],
            "no pixel of this camera",
        ),
        (["--direction", "0,0,1", "--from", "0,0,300", "--look-at", "0,0,300"], "another place than --from"),
        (["--direction", "0,0,1", "--from", "0,0,1"], "give --field-of-view"),
        (["--direction", "0,0,1", "--from", "0,0,-300"], "no pixel of this camera"),  # from behind
        (["--direction", "0,0,1", "--look-at", "0,0,0"], "--look-at: belongs to a camera anywhere"),
        (["--direction", "0,0,1", "--from", "0,0,300", "--size", "9"], "--size: expected WIDTHxHEIGHT"),
        (["--direction", "0,0,1", "--turn", "5"], "ends in .mp4"),
        (["--direction", "0,0,1", "--white", "5"], "--white: belongs to a video"),
    ],
)
def test_what_cannot_be_relit_is_refused_with_the_reason(
    folder: Path, tmp_path: Path, options: list[str], words: str
) -> None:
    ended = cells.here("reflectance", "relight", folder, *options, "--to", tmp_path / "a.npy")
    assert ended.code == 2
    assert words in " ".join(ended.err.split())
    assert not list(tmp_path.iterdir())


def test_an_led_does_not_turn(folder: Path, tmp_path: Path) -> None:
    ended = cells.here("reflectance", "relight", folder, "--led", "7", "--turn", "5", "--to", tmp_path / "a.mp4")
    assert ended.code == 2
    assert "an LED stays where it is" in ended.err


def test_a_disk_that_takes_no_video_is_told_with_six(folder: Path) -> None:
    options = ("--direction", "0,0,1", "--turn", "2", "--white", "1", "--to", "/proc/turn.mp4")
    ended = cells.here("reflectance", "relight", folder, *options)
    assert ended.code == 6
    assert "/proc/turn.mp4" in ended.err
