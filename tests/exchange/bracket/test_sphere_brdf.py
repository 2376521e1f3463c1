"""A finish from photographs of a sphere of it, read back from MERL's layout."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from typer.testing import CliRunner

from coupole.appearance.matter import brdf
from coupole.appearance.optics import fresnel, indices
from coupole.commands.cli import app

SIDE_PX, RADIUS_PX = 121, 55.0
WHITE = np.array([2.0, 1.5, 1.0])
_GOLD = partial(brdf.ggx, roughness=0.25, fresnel=fresnel.of_index(indices.gold()[[54, 34, 14]]))


def finish(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    return _GOLD(wi, wo) + 0.01


def photographed(to_light: np.ndarray) -> np.ndarray:
    """The sphere, orthographic, by the BRDF in frames of 3 x 3 places in each pixel, with 1 % noise."""
    picture = np.zeros((SIDE_PX, SIDE_PX, 3))
    for right in (-1.0 / 3.0, 0.0, 1.0 / 3.0):
        for down in (-1.0 / 3.0, 0.0, 1.0 / 3.0):
            picture += seen_at(to_light, right, down) / 9.0
    return (picture * np.random.default_rng(1).normal(1.0, 0.01, picture.shape)).astype(np.float32)


def seen_at(to_light: np.ndarray, right: float, down: float) -> np.ndarray:
    v, u = np.mgrid[:SIDE_PX, :SIDE_PX]
    x, y = (u + right - 60.0) / RADIUS_PX, (60.0 - v - down) / RADIUS_PX
    z = np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))
    n = np.stack([x, y, z], axis=2)[z > 0.0]
    eye = np.array([0.0, 0.0, 1.0])

    def local(way: np.ndarray) -> np.ndarray:
        """Only angles to the normal and between the two matter."""
        return np.stack([np.sqrt(np.maximum(1.0 - (n @ way) ** 2, 0.0)), 0.0 * n[:, 0], n @ way], axis=1)

    wi, wo = local(to_light), local(eye)
    flat = to_light @ eye - wi[:, 2] * wo[:, 2]
    cosine = np.clip(flat / np.maximum(wi[:, 0] * wo[:, 0], 1e-12), -1.0, 1.0)
    wo[:, 0], wo[:, 1] = wo[:, 0] * cosine, wo[:, 0] * np.sqrt(1.0 - cosine**2)
    picture = np.zeros((SIDE_PX, SIDE_PX, 3))
    picture[z > 0.0] = finish(wi, wo) * np.maximum(wi[:, 2:], 0.0) * np.pi / 0.99 * WHITE
    return picture


def test_gold_on_a_sphere_becomes_a_merl_table_of_its_brdf(tmp_path: Path) -> None:
    lights = []
    for number, angle in enumerate(np.radians(np.arange(5.0, 150.0, 15.0))):
        to_light = np.array([np.sin(angle) * np.cos(number), np.sin(angle) * np.sin(number), np.cos(angle)])
        name = f"{number}.exr"
        picture = photographed(to_light)
        channels = {one: np.ascontiguousarray(picture[..., k]) for k, one in enumerate("RGB")}
        OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(tmp_path / name))
        lights.append({"path": name, "to_light": to_light.tolist()})
    sample = {
        "photographs": lights,
        "centre_px": [60, 60],
        "radius_px": RADIUS_PX,
        "white": {"values": WHITE.tolist()},
    }
    (tmp_path / "sample.yaml").write_text(json.dumps(sample))

    out = tmp_path / "gold.binary"
    done = CliRunner().invoke(app, ["sphere-brdf", str(tmp_path / "sample.yaml"), "--out", str(out), "--json"])

    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["median_miss"] < 0.01
    raw = out.read_bytes()
    assert np.frombuffer(raw[:12], "<i4").tolist() == [90, 90, 180]
    table = (
        np.frombuffer(raw[12:], "<f8").reshape(3, 90, 90, 180)
        * np.array([1, 1.15, 1.66])[:, None, None, None]
        / 1500
    )
    # Difference angles, the half vector along the normal, where the peak is, and 5 and 15 degrees from it.
    for theta_d, row in ((10.5, 10), (20.5, 20), (40.5, 40), (50.5, 50), (60.5, 60)):
        for index in (0, 5, 21, 36):
            theta_h = 0.5 * np.pi * ((index + 0.5) / 90.0) ** 2
            half, d = np.array([np.sin(theta_h), 0.0, np.cos(theta_h)]), np.radians(theta_d)
            across = np.array([0.0, 1.0, 0.0])
            wi, wo = np.cos(d) * half + np.sin(d) * across, np.cos(d) * half - np.sin(d) * across
            assert table[:, index, row, 89:91].mean(axis=1) == pytest.approx(finish(wi, wo), rel=0.03)
    left_out = told["left_out"]
    assert [one["path"] for one in left_out] == [f"{number}.exr" for number in range(10)]
    assert [one["incidence_deg"] for one in left_out] == pytest.approx(np.arange(2.5, 75.0, 7.5), abs=0.05)
    assert max(abs(one["peak_miss"]) for one in left_out[:9]) < 0.02
    assert max(one["nearest_to_peak_deg"] for one in left_out) < 2.0  # a pixel of 1 degree or so


def test_a_sphere_outside_of_its_picture_is_refused(tmp_path: Path) -> None:
    channels = {one: np.ones((50, 50), np.float32) for one in "RGB"}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(tmp_path / "one.exr"))
    sample = {
        "photographs": [{"path": "one.exr", "to_light": [0, 0, 1]}],
        "centre_px": [60, 60],
        "radius_px": 20,
        "white": {"values": [1, 1, 1]},
    }
    (tmp_path / "sample.yaml").write_text(json.dumps(sample))
    done = CliRunner().invoke(
        app, ["sphere-brdf", str(tmp_path / "sample.yaml"), "--out", str(tmp_path / "a.binary")]
    )
    assert "all of the sphere" in f"{done.output}{done.exception}"
