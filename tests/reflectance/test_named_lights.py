"""Lights in files: lists of them, and pictures of all directions."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from relight_cases import write_exr

from coupole.errors import InputError
from coupole.reflectance.new_light.beams import lighting_of
from coupole.reflectance.new_light.environment import OF_RUNS, Environment, read_environment
from coupole.reflectance.new_light.light_kinds import AreaLight, EnvironmentLight, read_lights, turn_light

LIGHTS = """\
lights:
  - {kind: direction, towards: [0, 0, 1], strength: [1, 2, 3]}
  - {kind: led, number: 7}
  - {kind: point, at_mm: [0, 0, 300]}
  - {kind: area, at_mm: [0, 0, 300], normal: [0, 0, -1], width_mm: 100}
  - {kind: environment, file: sky.exr, turn_deg: 90, strength: 0.5}
"""


def test_a_file_names_lights_of_all_kinds(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(LIGHTS)
    lights = read_lights(tmp_path / "scene.yaml")
    assert [light.kind for light in lights] == ["direction", "led", "point", "area", "environment"]
    assert lights[0].rgb.tolist() == [1, 2, 3]
    assert isinstance(lights[4], EnvironmentLight)
    assert lights[4].file == tmp_path / "sky.exr"


@pytest.mark.parametrize(
    ("wrong", "place", "words"),
    [
        (("towards: [0, 0, 1]", "towards: [0, 0, 0]"), "2:", "not all 0"),
        (("number: 7", "nummer: 7"), "3:", "nummer"),
        (("kind: point", "kind: candle"), "4:", "candle"),
        (("strength: 0.5", "strength: -1"), "6:", "strength"),
    ],
)
def test_a_wrong_file_of_lights_is_refused_with_its_place(
    wrong: tuple[str, str], place: str, words: str, tmp_path: Path
) -> None:
    (tmp_path / "scene.yaml").write_text(LIGHTS.replace(*wrong))
    with pytest.raises(InputError) as refused:
        read_lights(tmp_path / "scene.yaml")
    assert f"scene.yaml:{place}" in str(refused.value)
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("radiance", "words"),
    [
        (np.ones((8, 12, 3)), "twice as wide as high"),
        (np.full((8, 16, 3), -1.0), "none below 0"),
        (np.zeros((8, 16, 3)), "some above"),
        (np.full((8, 16, 3), np.nan), "finite"),
    ],
)
def test_what_is_no_environment_is_refused(radiance: np.ndarray, words: str, tmp_path: Path) -> None:
    path = write_exr(tmp_path / "sky.exr", radiance)
    with pytest.raises(InputError, match=words):
        read_environment(path, OF_RUNS, np.ones(3))


@pytest.mark.parametrize("name", ["none.exr", "none.hdr", "text.exr", "sky.jpg"])
def test_an_environment_that_cannot_be_read_is_refused_by_name(name: str, tmp_path: Path) -> None:
    if name == "text.exr":
        (tmp_path / name).write_text("no picture")
    with pytest.raises(InputError, match=name):
        read_environment(tmp_path / name, OF_RUNS, np.ones(3))


def test_an_environment_of_radiance_format_is_read(tmp_path: Path) -> None:
    radiance = np.random.default_rng(4).uniform(0.5, 1.0, (8, 16, 3)).astype(np.float32)
    cv2.imwrite(str(tmp_path / "sky.hdr"), radiance[..., ::-1])
    found = read_environment(tmp_path / "sky.hdr", OF_RUNS, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(found.radiance, radiance * (1, 2, 3), rtol=0.01)


def test_directions_are_drawn_as_often_as_light_comes_from_them() -> None:
    radiance = np.random.default_rng(2).uniform(0, 1, (12, 24, 3)).astype(np.float32) ** 4
    environment = Environment(radiance, OF_RUNS)
    ways, radiances, densities = environment.sample(20_000)
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 1.0)
    row = np.floor(np.arccos(ways[:, 2]) / np.pi * 12).astype(int)
    column = np.floor((0.5 - np.arctan2(ways[:, 1], ways[:, 0]) / (2 * np.pi)) * 24).astype(int)
    np.testing.assert_allclose(radiance[row, column], radiances)
    # integrals of x, y and z over the sphere by the midpoints of a fine grid
    theta = (np.arange(1200) + 0.5) / 1200 * np.pi
    phi = (0.5 - (np.arange(2400) + 0.5) / 2400) * 2 * np.pi
    fine = np.repeat(np.repeat(radiance, 100, 0), 100, 1).mean(axis=2) * np.sin(theta)[:, None]
    fine *= np.pi / 1200 * 2 * np.pi / 2400
    wanted = [
        np.sum(fine * np.sin(theta)[:, None] * np.cos(phi)),
        np.sum(fine * np.sin(theta)[:, None] * np.sin(phi)),
        np.sum(fine * np.cos(theta)[:, None]),
        fine.sum(),
    ]
    sums = (ways * (radiances.mean(axis=1) / densities)[:, None]).sum(axis=0)
    np.testing.assert_allclose([*sums, environment.total()], wanted, atol=0.01)


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.0, 0.6, -0.8)])
def test_an_area_turns_with_its_width(normal: tuple[float, float, float]) -> None:
    light = AreaLight(at_mm=(100, 0, 500), normal=normal, width_mm=300, height_mm=50)
    beams = [
        np.stack([beam.place for beam in lighting_of([one], (), np.eye(4), 3, 16, paper=False).beams])
        for one in (light, turn_light(light, 90.0))
    ]
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(beams[1], beams[0] @ quarter.T, atol=1e-9)


def test_an_environment_without_light_of_the_sensors_colours_is_dark(tmp_path: Path) -> None:
    path = write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))
    for strength in (0.0, (1.0, 0.0, 0.0)):
        light = EnvironmentLight(file=path, strength=strength)
        assert lighting_of([light], (), np.eye(4), 1, 16, paper=False).beams == ()
