import contextlib
import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from coupole.errors import InputError
from coupole.reflectance.light_files import read_lights, read_lp, read_rows
from coupole.reflectance.picture_set import read_pictures

DIRECTIONS = "".join(f"{x} {y} 1\n" for x in (-0.5, 0, 0.5) for y in (-0.5, 0.5))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for number in range(6):
        picture = np.full((4, 5, 3), [10, 20, 30 + number], np.uint8)
        picture[1, 2] = 200
        cv2.imwrite(str(pictures / f"{number}.png"), picture)
    (tmp_path / "lights.txt").write_text(DIRECTIONS)
    return tmp_path


def test_pictures_are_read_in_the_order_of_their_names_or_of_the_list(folder: Path) -> None:
    given = read_pictures(folder / "pictures", folder / "lights.txt")
    assert [path.name for path in given.files] == [f"{number}.png" for number in range(6)]
    assert given.full_scale == 255
    assert given.raw_values(3)[0].tolist() == [33, 20, 10]  # red first
    assert given.raw_values(3)[7].tolist() == [200] * 3
    (folder / "pictures" / "filenames.txt").write_text("5.png 4.png 3.png 2.png 1.png 0.png")
    assert read_pictures(folder / "pictures", folder / "lights.txt").raw_values(0)[0].tolist() == [35, 20, 10]


def test_an_lp_file_names_the_pictures(folder: Path) -> None:
    rows = DIRECTIONS.splitlines()
    (folder / "dome.lp").write_text("6\n" + "".join(f"C:\\rti\\{5 - k}.png {row}\n" for k, row in enumerate(rows)))
    given = read_pictures(folder / "pictures", folder / "dome.lp")
    assert given.files[0].name == "5.png"
    np.testing.assert_allclose(np.linalg.norm(given.directions, axis=1), 1)


def test_the_mask_says_what_is_fitted_and_intensities_may_be_one_number(folder: Path) -> None:
    mask = np.zeros((4, 5), np.uint8)
    mask[1, 2:4] = 255
    cv2.imwrite(str(folder / "pictures" / "mask.png"), mask)
    (folder / "intensities.txt").write_text("2\n" * 6)
    given = read_pictures(
        folder / "pictures",
        folder / "lights.txt",
        mask=folder / "pictures" / "mask.png",
        intensities=folder / "intensities.txt",
    )
    assert given.pixels == 2
    assert len(given) == 6
    assert given.intensities.tolist() == [[2.0] * 3] * 6


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("lights.txt", DIRECTIONS + "0 0\n", "lights.txt:7:1: 2 values; expected 3"),
        ("lights.txt", DIRECTIONS.replace("0.5 1", "x 1", 1), "lights.txt:1:1: '-x' is not a number"),
        ("lights.txt", DIRECTIONS.replace("0.5 1", "nan 1", 1), "lights.txt:1:1: '-nan' is not a number"),
        ("lights.txt", DIRECTIONS + "0 0 1\n", "has 7 lights"),
        (
            "lights.txt",
            DIRECTIONS.replace("-0.5 -0.5 1", "0 0 0", 1),
            "lights.txt:1:1: the direction of light number 0 \\(from 0\\), of 0.png, is 0 0 0",
        ),
        (
            "lights.lp",
            "6\n\n" + "".join(f"{k}.png 0 0 {int(k != 3)}\n" for k in range(6)),
            "lights.lp:6:1: the direction of light number 3 \\(from 0\\), of 3.png",
        ),
        (
            "lights.dome",
            json.dumps({"directions": [[0, 0, int(k != 4)] for k in range(6)]}),
            "lights.dome: the direction of light number 4 \\(from 0\\), of 4.png",
        ),
        (
            "lights.lp",
            "6\n" + "".join(f"s{k // 2}/{k % 2}.png 0 0 1\n" for k in range(6)),
            "lights.lp:4:1: two pictures are called 0.png; .*: put all into one folder",
        ),
        ("lights.lp", "9" * 5000 + "\n0.png 0 0 1\n", "lights.lp:1:1: expected the number of lights"),
        ("pictures/filenames.txt", b"0.png \xe9.png", "filenames.txt: is not text in UTF-8; save it"),
        ("lights.lp", "7\n" + DIRECTIONS, "lights.lp:2:1: expected `name x y z`"),
        ("lights.lp", "six\n", "lights.lp:1:1: expected the number of lights"),
        ("lights.lp", "1\n9.png 0 0 1\n", "at least 6 are needed"),
        ("intensities.txt", "1\n1\n", "expected 6 lines of positive intensities, got 2"),
        ("intensities.txt", "1\n" * 5 + "-1\n", "positive intensities"),
        ("mask.png", "no picture", "is not a readable picture"),
    ],
)
def test_what_is_wrong_is_refused_with_its_place(
    folder: Path, name: str, content: str | bytes, message: str
) -> None:
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    lights = folder / (name if name.startswith("lights") else "lights.txt")
    other = {name.partition(".")[0]: folder / name} if name.startswith(("intensities", "mask")) else {}
    with pytest.raises(InputError, match=message.replace("`", ".")):
        read_pictures(folder / "pictures", lights, **other)


def test_pictures_that_differ_are_refused(folder: Path) -> None:
    cv2.imwrite(str(folder / "pictures" / "2.png"), np.zeros((4, 6, 3), np.uint16))
    given = read_pictures(folder / "pictures", folder / "lights.txt")
    with pytest.raises(InputError, match=r"2\.png: has 6 x 4 pixels of 16 bit; the first picture has 5 x 4 of 8"):
        given.raw_values(2)


@settings(max_examples=200)
@given(
    text=st.one_of(
        st.text(max_size=80), st.from_regex(r"[0-9²]{1,2}\n(a\.png( [-0-9.einf]{1,5}){3}\n?)*", fullmatch=True)
    )
)
@example(text="²\na.png 0 0 1")
@pytest.mark.parametrize("reader", [read_lp, lambda path: read_rows(path, (3,))])
def test_any_text_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, reader: Callable[[Path], object], text: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.lp"
    path.write_text(text, encoding="utf-8")
    with contextlib.suppress(InputError):
        reader(path)


def points(rows: np.ndarray) -> list[dict[str, float]]:
    return [dict(zip("xyz", row, strict=True)) for row in rows.tolist()]


def rows_of(text: str) -> np.ndarray:
    return np.array([line.split() for line in text.splitlines()], float)


def test_a_project_of_relight_names_pictures_places_and_strengths_of_lights(folder: Path) -> None:
    """As relight saves it: skipped pictures have no light, places hold if the configuration says so."""
    ways = rows_of(DIRECTIONS)
    images = [{"filename": f"{5 - number}.png", "skip": False, "visible": True} for number in range(6)]
    images.insert(2, {"filename": "blurred.png", "skip": True, "visible": True})
    dome = {
        "imageWidth": 200.0,
        "domeDiameter": 600.0,
        "lightConfiguration": "lights3d",
        "directions": points(-ways),
        "positionsSphere": [],
        "positions3d": points(250.0 * ways),
        "ledAdjust": [{"r": 2.0, "g": 1.0, "b": 0.5}] * 6,
    }
    project = {"application": "RelightLab", "width": 5, "height": 4, "folder": "pictures", "images": images}
    path = folder / "coin.relight"
    path.write_text(json.dumps({**project, "dome": dome, "forcedInputColorspace": "srgb"}))
    given = read_pictures(folder / "pictures", path)
    assert [file.name for file in given.files] == [f"{5 - number}.png" for number in range(6)]
    np.testing.assert_allclose(given.directions, ways / np.linalg.norm(ways, axis=1, keepdims=True))
    assert given.intensities[0].tolist() == [0.5, 1.0, 2.0]
    red = given.raw_values(0)[0][0]  # code 35 of 255
    assert given.full_scale == 65535
    assert red == pytest.approx(65535 * ((35 / 255 + 0.055) / 1.055) ** 2.4, abs=0.6)
    path.write_text(json.dumps({**project, "dome": {**dome, "lightConfiguration": "directional"}}))
    plain = read_pictures(folder / "pictures", path)
    np.testing.assert_allclose(plain.directions, -given.directions)
    assert (plain.full_scale, plain.raw_values(0)[0][0]) == (255, 35)


def test_files_as_windows_writes_them_are_read(folder: Path) -> None:
    ways = rows_of(DIRECTIONS)
    texts = {
        "a.lp": "6\r\n" + "".join(f"{k}.png {row}\r\n" for k, row in enumerate(DIRECTIONS.splitlines())),
        "a.dome": json.dumps({"label": "one\u2028two", "directions": ways.tolist()}, ensure_ascii=False),
        "a.txt": DIRECTIONS,
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8-sig", newline="")
        np.testing.assert_allclose(read_lights(folder / name).directions, ways)


def test_a_dome_file_has_lights_for_pictures_in_the_order_of_their_names(folder: Path) -> None:
    ways = rows_of(DIRECTIONS)
    path = folder / "mine.dome"
    path.write_text(json.dumps({"lightConfiguration": "spherical", "directions": ways.tolist()}))
    given = read_pictures(folder / "pictures", path)
    np.testing.assert_allclose(given.directions, ways / np.linalg.norm(ways, axis=1, keepdims=True))
    assert given.files[0].name == "0.png"


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.dome", "[1", "is no JSON"),
        ("a.dome", "{}", "directions: expected a list of lights, each with x, y and z; there is none"),
        ("a.dome", '{"directions": [{"x": 1, "y": true, "z": 1}]}', "directions, number 0: expected x, y, z"),
        ("a.dome", '{"directions": [[1, 2, 3]], "ledAdjust": [[1, 0, 1]]}', "ledAdjust: expected positive r"),
        ("a.relight", '{"dome": {}}', "expected a project of relight"),
        ("a.relight", '{"dome": {"directions": [[0, 0, 1]]}, "images": []}', "1 lights; 0 pictures are used of 0"),
        (
            "a.relight",
            '{"dome": {"directions": [[0, 0, 1], [0, 1, 1]]}, "images": [{"filename": "a/1"}, {"filename": "1"}]}',
            "images: two pictures are called 1; pictures are looked for in one folder",
        ),
        ("a.relight", '{"dome": {}, "images": [{}]}', "images: expected a `filename` in each"),
    ],
)
def test_files_of_relight_that_say_too_little_are_refused(name: str, text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=re.escape(said)):
        read_lights(tmp_path / name)
