"""Intervals and cones of results of pictures: what `--interval`, `--uncertainty` and `normals_95_deg.npy` say."""

from __future__ import annotations

import signal
from pathlib import Path

import cells
import cv2
import numpy as np
import OpenEXR
import pytest
from picture_cases import LEFT_OUT, Made, interval_of

from coupole.acquisition.signals import SignalReceived
from coupole.exchange import picture_files


def test_intervals_hold_what_left_out_lights_show(made: Made, tmp_path: Path) -> None:
    case, out, _ = made
    inside, dark = [], []
    for light in LEFT_OUT:
        _, low, high = interval_of(out, case.directions[light], tmp_path)
        measured = cv2.imread(str(case.folder / f"{light:03}.png"), cv2.IMREAD_UNCHANGED)[..., ::-1] / 65535
        inside.append((low <= measured) & (measured <= high))
        dark.append(measured < 0.05)
        assert (high - low).mean() < 0.2
    assert 0.9 < np.mean(inside) < 0.995
    assert np.mean(np.stack(inside)[np.stack(dark)]) > 0.85


def test_an_interval_is_wider_than_the_standard_uncertainty(made: Made, tmp_path: Path) -> None:
    case, out, _ = made
    direction = case.directions[LEFT_OUT[0]]
    picture, low, high = interval_of(out, direction, tmp_path, "--uncertainty", tmp_path / "u.npy")
    uncertainty = np.load(tmp_path / "u.npy")
    measured = cv2.imread(str(case.folder / f"{LEFT_OUT[0]:03}.png"), cv2.IMREAD_UNCHANGED)[..., ::-1] / 65535
    assert (low >= 0).all()
    assert ((low <= picture) & (picture <= high)).all()
    assert np.median((high - picture) / uncertainty) > 1.3
    assert 0.5 < np.mean(np.abs(measured - picture) <= uncertainty) < 0.85


def test_an_interval_is_written_as_exr(made: Made, tmp_path: Path) -> None:
    case, out, _ = made
    _, low, _ = interval_of(out, case.directions[3], tmp_path)
    way = ",".join(map(str, case.directions[3]))
    bounds = f"{tmp_path / 'low.exr'},{tmp_path / 'high.exr'}"
    ended = cells.here(
        "reflectance",
        "relight",
        out,
        f"--direction={way}",
        "--to",
        tmp_path / "a.png",
        "--interval",
        bounds,
        "--json",
    )
    assert ended.code == 0, ended.err
    assert ended.document["interval"] == bounds.split(",")
    with OpenEXR.File(str(tmp_path / "low.exr")) as file:
        np.testing.assert_array_equal(file.channels()["RGB"].pixels, low)


def test_half_widths_of_lights_together_are_added(made: Made, tmp_path: Path) -> None:
    out = made[1]
    for name, directions in (("a", ["0,0,1"]), ("b", ["1,0,2"]), ("c", ["0,0,1", "1,0,2"])):
        lights = [f"--direction={direction}" for direction in directions]
        to = ("--to", tmp_path / f"{name}.npy", "--interval", f"{tmp_path}/{name}l.npy,{tmp_path}/{name}h.npy")
        ended = cells.here("reflectance", "relight", out, *lights, *to)
        assert ended.code == 0, ended.err
    one, other, both = (np.load(tmp_path / f"{name}h.npy") - np.load(tmp_path / f"{name}.npy") for name in "abc")
    np.testing.assert_allclose(both, one + other, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("written", [0, 1, 2, 3])
def test_an_interrupted_call_leaves_no_bounds_of_another_light_beside_its_picture(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    names = [tmp_path / f"{name}.npy" for name in ("picture", "u", "low", "high")]
    to = ("--to", names[0], "--uncertainty", names[1], "--interval", f"{names[2]},{names[3]}")

    def relit(light: str) -> int:
        (tmp_path / "lights.yaml").write_text(f"lights:\n  - {{kind: direction, towards: [{light}]}}\n")
        return cells.here("reflectance", "relight", made[1], "--lights", tmp_path / "lights.yaml", *to).code

    assert relit("0, 0, 1") == 0
    earlier = {name: name.read_bytes() for name in names}
    left = written

    def interrupted(path: Path, picture: np.ndarray) -> None:
        nonlocal left
        if left == 0:
            raise SignalReceived(signal.SIGINT)
        left -= 1
        write_picture(path, picture)

    write_picture = picture_files.write_picture
    monkeypatch.setattr(picture_files, "write_picture", interrupted)
    assert relit("1, 0, 2") == 130
    standing = [name for name in names if name.exists()]
    assert len(standing) == max(written, 1)
    assert all((name.read_bytes() == earlier[name]) == (written == 0) for name in standing)


def test_one_file_for_two_pictures_is_refused(made: Made, tmp_path: Path) -> None:
    same = tmp_path / "a.npy"
    ended = cells.here(
        "reflectance", "relight", made[1], "--direction", "0,0,1", "--to", same, "--uncertainty", same
    )
    assert ended.code == 2
    assert "expected different files" in ended.err
    assert not same.exists()


def test_nothing_is_known_far_from_all_lights(made: Made, tmp_path: Path) -> None:
    picture, low, high = interval_of(made[1], np.array([1.0, 0.0, -0.5]), tmp_path)
    assert np.isfinite(picture).all()
    assert np.isnan(low).all()
    assert np.isnan(high).all()


@pytest.mark.parametrize(
    ("interval", "message"),
    [
        ("low.npy", "expected LOW,HIGH"),
        ("low.npy,high.png", "expected LOW,HIGH"),
        ("low.npy,low.npy", "low.npy twice"),
    ],
)
def test_bounds_that_are_not_two_files_are_refused(made: Made, interval: str, message: str) -> None:
    ended = cells.here(
        "reflectance", "relight", made[1], "--direction", "0,0,1", "--to", "a.npy", "--interval", interval
    )
    assert ended.code == 2
    assert message in ended.err


def test_a_video_has_no_interval(made: Made) -> None:
    options = ("--direction", "1,0,1", "--turn", "8", "--to", "a.mp4", "--interval", "low.npy,high.npy")
    ended = cells.here("reflectance", "relight", made[1], *options)
    assert ended.code == 2
    assert "--interval: belongs to a picture" in ended.err


def test_cones_hold_the_normals_of_a_ball(made: Made) -> None:
    case, out, _ = made
    cones_deg, normals = np.load(out / "normals_95_deg.npy"), np.load(out / "normals.npy")
    assert cones_deg.dtype == np.float32
    assert cones_deg.shape == case.normals.shape[:2]
    ball = (case.normals[..., 2] < 0.999) & (case.normals[..., 2] > 0.5)
    off_deg = np.degrees(np.arccos(np.clip(np.sum(normals * case.normals, axis=-1)[ball], -1, 1)))
    assert np.mean(off_deg <= cones_deg[ball]) > 0.93
