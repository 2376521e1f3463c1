"""napari opens a run and a result without a screen: npe2 finds the reader, a viewer's model takes its layers."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from cells import CellFolder
from neighbour_programs import needs_neighbours
from relight_cases import Coat, waves, write_result

import coupole
from coupole.neighbours.napari import get_reader, layers_of_result, layers_of_view

LEDS = [420, 0, 20]
EXPOSURES_US = [2000, 8000]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> coupole.Run:
    """A view under three LEDs, at two exposures."""
    cell = CellFolder(tmp_path_factory.mktemp("cell"))
    exposure = {"kind": "bracket", "exposures_us": EXPOSURES_US}
    cell.write(lights={"kind": "ids", "ids": LEDS}, exposure=exposure)
    assert cell.acquire().code == 0
    return coupole.open_run(cell.run_folder)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> coupole.Result:
    folder = tmp_path_factory.mktemp("relief") / "result"
    write_result(folder, waves(), Coat(ks=(0.1, 0.1, 0.1)))
    opened = coupole.open_result(folder)
    assert isinstance(opened, coupole.Result)
    return opened


def test_a_view_is_an_image_by_light_and_exposure_read_as_it_is_looked_at(run: coupole.Run) -> None:
    pixels, attributes, kind = layers_of_view(run["top"])
    assert (kind, attributes["name"]) == ("image", "top")
    assert attributes["axis_labels"] == ("light", "exposure", "y", "x")
    assert pixels.shape == (3, 2, 96, 128)
    assert not isinstance(pixels, np.ndarray)
    for number, shot in enumerate(attributes["metadata"]["shots"]):
        light, exposure = divmod(number, len(EXPOSURES_US))
        frame = run["top"][shot.partition("/")[2]]
        np.testing.assert_array_equal(np.asarray(pixels[light, exposure]), frame.pixels)
        assert frame.exposure_us == EXPOSURES_US[exposure]
        assert frame.led == attributes["metadata"]["leds"][number]
    assert sorted(set(attributes["metadata"]["leds"])) == sorted(LEDS)


def test_its_scale_is_the_size_of_a_pixel_in_the_plane_in_focus(run: coupole.Run) -> None:
    _, attributes, _ = layers_of_view(run["top"])
    image_mm = 1.0 / (1.0 / 35.0 - 1.0 / 335.0)
    assert attributes["scale"][2:] == pytest.approx([0.176 * 335.0 / image_mm] * 2)
    assert attributes["scale"][:2] == (1.0, 1.0)
    assert attributes["contrast_limits"] == (run["top"].black_dn, run["top"].white_dn)


def test_a_result_is_surfaces_with_albedo_normals_and_uncertainty(result: coupole.Result) -> None:
    layers = {attributes["name"]: data for data, attributes, kind in layers_of_result(result) if kind == "surface"}
    assert list(layers) == ["albedo", "normals", "alpha", "uncertainty of normals"]
    points_mm, faces, albedo = layers["albedo"]
    assert albedo == pytest.approx(np.pi * 0.15, rel=1e-4)
    assert len(points_mm) == 3 * len(faces) == 3 * result.is_seen.sum()
    support_from_base = np.linalg.inv(result.base_from_support)
    corner_mm = result.vertices_mm[result.faces[result.is_seen]][5, 1]
    expected_mm = support_from_base[:3, :3] @ corner_mm + support_from_base[:3, 3]
    assert points_mm[faces[5, 1]] == pytest.approx(expected_mm[::-1], abs=1e-3)
    _, _, towards_z = layers["normals"]
    expected = result.normals()[result.is_seen] @ support_from_base[2, :3]
    assert towards_z[::3] == pytest.approx(expected, abs=1e-5)


def test_whatever_is_no_run_and_no_result_is_left_to_others(tmp_path: Path, run: coupole.Run) -> None:
    (tmp_path / "picture.tif").write_bytes(b"II")
    assert get_reader(str(tmp_path)) is None
    assert get_reader(str(tmp_path / "picture.tif")) is None
    assert get_reader([str(run.folder), str(run.folder)]) is None
    assert get_reader(str(run.folder / "run.json")) is not None


@needs_neighbours
def test_npe2_finds_the_reader_and_a_viewer_takes_the_layers(run: coupole.Run, result: coupole.Result) -> None:
    command = [sys.executable, Path(__file__).with_name("look_in_napari.py"), run.folder, result.folder]
    ended = subprocess.run(command, cwd=cells.REPO, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    found: dict[str, Any] = json.loads(ended.stdout.splitlines()[-1])
    assert found["plugin"] == "Coupole"
    (image,) = found["0"]
    first = run["top"][image["metadata"]["shots"][0].partition("/")[2]]
    assert (image["shape"], image["is_lazy"], image["sum"]) == ([3, 2, 96, 128], True, int(first.pixels.sum()))
    assert [layer["name"] for layer in found["1"]] == ["albedo", "normals", "alpha", "uncertainty of normals"]
    names = ["albedo", "normals", "alpha", "uncertainty of normals"]
    assert found["viewer"] == [["top", "Image"], *([name, "Surface"] for name in names)]
    assert "refused the file" in found["other"]
