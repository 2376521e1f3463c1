"""`coupole show`: which files it makes, what is in them, and what it refuses."""

from __future__ import annotations

import base64
import re
import zlib
from pathlib import Path

import cells
import h5py
import numpy as np
import pytest
from relight_cases import sheet, waves, write_result, write_sources

from coupole.errors import InputError, StorageError
from coupole.exchange.look.coarse_mesh import coarse_mesh
from coupole.exchange.look.look_blocks import block_of
from coupole.exchange.look.look_of_runs import Look, weld_corners
from coupole.exchange.look.look_page import write_page
from coupole.exchange.look.look_samples import samples_of_view
from coupole.reflectance.sample_uncertainty import MonteCarlo, Places, Sources


def small(numbers: int = 30) -> Look:
    values = np.random.default_rng(3).integers(0, 65536, numbers).astype(np.uint16)
    return Look({"kind": "mesh"}, (block_of("places", values),))


def test_corners_keep_their_triangle_and_move_by_less_than_half_a_step() -> None:
    corners_mm = np.random.default_rng(2).uniform(-70.0, 130.0, (600, 3))
    corners_mm[300:] = corners_mm[:300]  # every corner twice
    places, triangles, origin_mm, step_mm = weld_corners(corners_mm)
    assert len(places) == 300
    read = origin_mm + step_mm * places[triangles.reshape(-1)]
    assert np.abs(read - corners_mm).max() <= 0.5001 * step_mm
    assert step_mm == pytest.approx(200.0 / 65535, rel=0.02)


def test_a_coarse_mesh_has_the_shape_of_the_fine_one_in_few_triangles() -> None:
    places, triangles, _, _ = weld_corners(waves(120).reshape(-1, 3).astype(float))
    coarse = coarse_mesh(places, triangles, 2000)
    assert 1000 < len(coarse.triangles) <= 2000

    def across(corners: np.ndarray) -> np.ndarray:
        found: np.ndarray = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        return found

    fine_corners, corners = places[triangles].astype(float), coarse.places[coarse.triangles].astype(float)
    np.testing.assert_allclose(across(corners).sum(axis=0)[2], across(fine_corners).sum(axis=0)[2], rtol=0.1)
    cell = 65536 / np.sqrt(len(coarse.triangles) / 2)
    apart = corners.mean(axis=1) - fine_corners[coarse.stands_for].mean(axis=1)
    assert np.linalg.norm(apart, axis=1).max() < 2 * cell
    assert len(np.unique(np.sort(coarse.triangles, axis=1), axis=0)) == len(coarse.triangles)


def test_a_page_names_no_host(tmp_path: Path) -> None:
    write_page(small(), "a vase", tmp_path / "look.html")
    text = (tmp_path / "look.html").read_text()
    assert not re.search(r"(?:https?:)?//[\w-]+\.\w", text)
    assert "fetch(" not in text


def test_a_title_cannot_become_part_of_the_page(tmp_path: Path) -> None:
    write_page(small(), "</script><b>%BLOCKS%", tmp_path / "look.html")
    text = (tmp_path / "look.html").read_text()
    assert "</script><b>" not in text


def test_names_stay_what_they_are(tmp_path: Path) -> None:
    look = Look({"kind": "mesh"}, (block_of("frame-</script><i>", np.zeros(3, np.uint8)),))
    write_page(look, "x %BLOCKS% y", tmp_path / "look.html")
    text = (tmp_path / "look.html").read_text()
    assert "<h1>x %BLOCKS% y</h1>" in text
    assert '"title": "x %BLOCKS% y"' in text
    assert "</script><i>" not in text


def test_what_is_too_large_for_one_file_lies_beside_it(tmp_path: Path) -> None:
    files = write_page(small(9000), "a vase", tmp_path / "look.html", most_bytes=10_000)
    assert [file.relative_to(tmp_path).as_posix() for file in files] == ["look.html", "look.data/places.js"]
    assert '<script src="look.data/places.js">' in files[0].read_text()


def test_a_smaller_page_removes_the_data_of_a_larger_one(tmp_path: Path) -> None:
    write_page(small(9000), "a vase", tmp_path / "look.html", most_bytes=10_000)
    write_page(small(), "a vase", tmp_path / "look.html")
    assert [one.name for one in tmp_path.iterdir()] == ["look.html"]


def test_a_folder_of_other_things_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "result").mkdir()
    (tmp_path / "look.data").mkdir()
    (tmp_path / "look.data/notes.txt").write_text("mine")
    with pytest.raises(InputError, match="something else than a page's data"):
        write_page(small(), "a vase", tmp_path / "look.html")
    assert (tmp_path / "look.data/notes.txt").read_text() == "mine"


def test_scripts_of_others_are_not_touched(tmp_path: Path) -> None:
    write_page(small(9000), "a vase", tmp_path / "look.html", most_bytes=10_000)
    (tmp_path / "look.data/mine.js").write_text("let mine = 1;")
    before = (tmp_path / "look.html").read_text()
    with pytest.raises(InputError, match="something else than a page's data"):
        write_page(small(), "a vase", tmp_path / "look.html")
    assert sorted(one.name for one in (tmp_path / "look.data").iterdir()) == ["mine.js", "places.js"]
    assert (tmp_path / "look.html").read_text() == before


def test_a_page_that_cannot_be_written_leaves_the_data_of_the_earlier_one(tmp_path: Path) -> None:
    write_page(small(9000), "a vase", tmp_path / "look.html", most_bytes=10_000)
    before = (tmp_path / "look.data/places.js").read_text()
    (tmp_path / "look.html").unlink()
    (tmp_path / "look.html").mkdir()
    for look in (small(), small(9001)):
        with pytest.raises(StorageError, match=r"look\.html"):
            write_page(look, "a vase", tmp_path / "look.html", most_bytes=10_000)
        assert (tmp_path / "look.data/places.js").read_text() == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["look.data", "look.html"]


def test_data_beside_the_page_take_the_place_of_earlier_ones(tmp_path: Path) -> None:
    for numbers in (9000, 9001):
        write_page(small(numbers), "a vase", tmp_path / "look.html", most_bytes=10_000)
    assert '"shape": [9001]' in (tmp_path / "look.data/places.js").read_text()
    assert sorted(one.name for one in tmp_path.iterdir()) == ["look.data", "look.html"]


def test_the_address_of_data_may_have_any_letters(tmp_path: Path) -> None:
    page, *_ = write_page(small(9000), "a vase", tmp_path / "50% of vase #3.html", most_bytes=10_000)
    assert '<script src="50%25%20of%20vase%20%233.data/places.js">' in page.read_text()


def test_what_is_no_result_is_refused_with_the_remedy(tmp_path: Path) -> None:
    ended = cells.here("show", tmp_path / "none", "--out", tmp_path / "look.html")
    assert ended.code == 2
    assert "coupole reflectance RUN --out FOLDER" in " ".join(ended.err.split())
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("waves") / "a <wavy> sheet"
    write_result(folder, waves(20))
    return folder


def test_the_command_tells_what_it_made(result: Path, tmp_path: Path) -> None:
    ended = cells.here("show", result, "--out", tmp_path / "look.html", "--json")
    assert ended.code == 0, ended.err
    assert ended.document["bytes"] == (tmp_path / "look.html").stat().st_size
    assert ended.document["about"]["triangles"] == 2 * 19**2
    assert ended.document["about"]["simulated"] is True


@pytest.mark.parametrize("option", [("--view", "top"), ("--environment", "none.exr")])
def test_an_option_that_does_not_fit_is_refused(result: Path, tmp_path: Path, option: tuple[str, str]) -> None:
    ended = cells.here("show", result, *option, "--out", tmp_path / "look.html")
    assert ended.code == 2
    assert option[0] in ended.err or option[1] in ended.err
    assert not list(tmp_path.iterdir())


def test_bars_of_samples_are_the_95_percent_of_all_that_is_uncertain(tmp_path: Path) -> None:
    """Against draws of power, signal, vertices and LEDs, by numbers that do not come from the file."""
    result = write_result(tmp_path / "sheet", sheet(np.zeros((4, 4)), 60.0), camera_mm=(0.0, 0.0, 330.0))
    u = {"u_own": 0.02, "u_response": 0.015, "led_u_own": 0.01, "led_u_shared": 0.03, "led_u_mm": 4.0}
    with h5py.File(result.views[0].path, "a") as file:
        file["f"][...] = 0.1 * np.array([1.0, 0.8, 0.6])
        write_sources(file, u)
    scan_noise_um, (view,) = 400.0, result.views
    _, blocks = samples_of_view(result, view, np.eye(4), scan_noise_um, lambda *_: None)
    packed = zlib.decompress(base64.b64decode(blocks[2].text))
    value, below, above = 1e-4 * 1e5 ** ((np.frombuffer(packed, np.uint8).reshape(blocks[2].shape) - 1.0) / 254)
    count = len(view.triangles)
    assert value.shape == (count, 1)

    def each(number: float) -> np.ndarray:
        return np.full(count, number)

    corners = result.corners_mm[view.triangles].astype(float)
    places = Places(corners, np.tile(view.led_mm, (count, 1)), np.tile(view.led_normals, (count, 1)))
    none = each(0.0)
    of_signal = each(u["u_own"]), each(u["u_response"]), none, none
    sources = Sources(
        *of_signal, each(u["led_u_own"]), each(u["led_u_shared"]), each(scan_noise_um), each(u["led_u_mm"]), none
    )
    ratios = MonteCarlo(places, 20_000, np.random.default_rng(1)).ratios(sources)
    low, high = np.quantile(ratios, [0.025, 0.975], axis=1)
    np.testing.assert_allclose(below[:, 0], 1 - low, rtol=0.06)
    np.testing.assert_allclose(above[:, 0], high - 1, rtol=0.06)


@pytest.mark.parametrize(
    "source", ["u_own", "u_response", "led_u_own", "led_u_shared", "led_u_mm", "lateral_u_mm"]
)
def test_each_source_makes_bars_longer(tmp_path: Path, source: str) -> None:
    result = write_result(tmp_path / "waves", waves(8))
    ends = []
    for u in (0.0, 0.05 if source.endswith(("own", "response", "shared")) else 5.0):
        with h5py.File(result.views[0].path, "a") as file:
            file["f"][...] = 0.1
            write_sources(file, {source: u})
        _, blocks = samples_of_view(result, result.views[0], np.eye(4), 30.0, lambda *_: None)
        packed = zlib.decompress(base64.b64decode(blocks[2].text))
        ends.append(np.frombuffer(packed, np.uint8).reshape(blocks[2].shape)[1:].astype(int))
    assert np.median(ends[1] - ends[0]) > 3


def test_samples_of_an_earlier_version_are_refused(tmp_path: Path) -> None:
    result = write_result(tmp_path / "old", waves(8))
    with h5py.File(result.views[0].path, "a") as file:
        del file.attrs["lateral_u_mm"]
    ended = cells.here("show", tmp_path / "old", "--samples", "--out", tmp_path / "look.html")
    assert ended.code == 2
    assert "make the result again" in " ".join(ended.err.split())


def test_a_page_of_another_name_is_refused(result: Path, tmp_path: Path) -> None:
    ended = cells.here("show", result, "--out", tmp_path / "look.pdf")
    assert ended.code == 2
    assert "ends in .html" in ended.err


def test_a_disk_that_takes_no_page_is_told_with_six(result: Path) -> None:
    ended = cells.here("show", result, "--out", "/proc/look.html")
    assert ended.code == 6
    assert "/proc/look.html" in ended.err


def test_a_damaged_result_is_refused_with_the_remedy(tmp_path: Path) -> None:
    write_result(tmp_path / "cut", waves(8))
    fit = tmp_path / "cut/fits/ggx.h5"
    fit.write_bytes(fit.read_bytes()[:600])
    ended = cells.here("show", tmp_path / "cut", "--out", tmp_path / "look.html")
    assert ended.code == 2
    assert "make the result again" in " ".join(ended.err.split())


def test_a_result_that_does_not_say_enough_is_refused_with_what_it_lacks(tmp_path: Path) -> None:
    write_result(tmp_path / "bare", waves(8))
    (tmp_path / "bare/result.json").write_text(
        '{"schema": "coupole-reflectance-run/1", "runs": {}, "mae": [], "software": {}}'
    )
    ended = cells.here("show", tmp_path / "bare", "--out", tmp_path / "look.html")
    assert ended.code == 2
    assert [name in ended.err for name in ("mae", "software: coupole", "simulated", "runs:")] == [
        True,
        True,
        True,
        False,
    ]


def test_a_result_without_uncertainty_is_refused(tmp_path: Path) -> None:
    write_result(tmp_path / "old", waves(8))
    with h5py.File(tmp_path / "old/fits/ggx.h5", "a") as file:
        del file["covariance"]
    ended = cells.here("show", tmp_path / "old", "--out", tmp_path / "look.html")
    assert ended.code == 2
    assert "make the result again" in " ".join(ended.err.split())
