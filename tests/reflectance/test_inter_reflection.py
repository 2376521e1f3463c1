"""Light from one part of an object to another, against closed forms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh

from coupole.reflectance import inter_reflection
from coupole.reflectance.inter_reflection import radiosity, subtract
from coupole.reflectance.light_paths import Ahead, direct_irradiance, points_of, scene_of, seen_from
from coupole.reflectance.run_result import OBJECT, RunResult
from coupole.reflectance.run_result_files import write_object

LED_MM = np.array([[0.0, 0.0, 60.0]])
DOWN = np.array([[0.0, 0.0, -1.0]])


def inside_out(mesh: trimesh.Trimesh) -> np.ndarray:
    corners: np.ndarray = mesh.triangles[:, ::-1].astype(float)
    return corners


def test_a_closed_sphere_multiplies_light_by_its_reflectance_over_what_is_absorbed() -> None:
    """An integrating sphere: whatever the LED lights first, rho / (1 - rho) of the mean arrives everywhere."""
    scene = scene_of(inside_out(trimesh.creation.icosphere(subdivisions=4, radius=100.0)))
    points = points_of(scene)
    seen = sum(seen_from(scene, at, seed) for seed, at in enumerate(points)) * (1 / len(points))
    np.testing.assert_allclose(np.asarray(seen.sum(axis=1)), 1.0, atol=1e-5)
    direct = direct_irradiance(scene, LED_MM, DOWN, paper=False)
    areas = np.bincount(scene.patch, scene.areas_mm2)
    mean = float(areas @ direct[:, 0] / areas.sum())
    assert mean * areas.sum() * 1e-6 == pytest.approx(1.0, rel=0.02)  # all its light
    for reflectance in (0.2, 0.5):
        shown = np.full((scene.patches, 1), reflectance)
        indirect = seen @ radiosity(seen, direct, shown, passes=1)[0]
        expected = mean * reflectance / (1 - reflectance)
        np.testing.assert_allclose(np.median(indirect), expected, rtol=0.03)


def test_a_wall_sees_the_floor_as_its_form_factor_tells() -> None:
    """Two equal squares with an edge in common see 0.20004 of each other (Howell, C-14)."""
    square = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], float) * 100
    floor = np.concatenate([_split(triangle, 4) for triangle in square])
    wall = floor[:, :, [2, 1, 0]][:, ::-1]
    scene = scene_of(np.concatenate([floor, wall]))
    assert (scene.normals[: len(floor), 2] > 0.99).all()
    assert (scene.normals[len(floor) :, 0] > 0.99).all()
    seen = seen_from(scene, np.arange(len(floor)), 1)
    of_wall = np.asarray(seen[:, np.unique(scene.patch[len(floor) :])].sum(axis=1))
    assert of_wall.mean() == pytest.approx(0.20004, rel=0.02)


def _split(triangle: np.ndarray, times: int) -> np.ndarray:
    parts = triangle[None]
    for _ in range(times):
        a, b, c = parts[:, 0], parts[:, 1], parts[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    return parts


def folded(folder: Path) -> RunResult:
    """Samples of a floor and a wall of reflectance 0.5 in two views, all light taken for direct."""
    square = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], float) * 100
    floor = np.concatenate([_split(triangle, 3) for triangle in square])
    corners = np.concatenate([floor, floor[:, :, [2, 1, 0]][:, ::-1]])
    (folder / "samples").mkdir(parents=True)
    write_object(folder / OBJECT, corners, np.eye(4))
    random = np.random.default_rng(4)
    ways = random.normal(size=(24, 3))
    leds = 700 * np.abs(ways) / np.linalg.norm(ways, axis=1, keepdims=True)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = across / np.linalg.norm(across, axis=1, keepdims=True)
    for number, view in enumerate(("first", "second")):
        mine = np.arange(number, len(corners), 2)
        with h5py.File(folder / f"samples/{view}.h5", "w") as file:
            file.attrs["view"] = view
            file["triangles"], file["leds"] = mine, np.arange(len(leds))
            file["centres_mm"], file["normals"] = corners.mean(axis=1)[mine], normals[mine]
            file["camera_mm"], file["full_scales"] = np.array([300.0, 300, 600]), np.ones((len(leds), 1))
            file["led_positions_mm"] = leds
            file["led_normals"] = -leds / np.linalg.norm(leds, axis=1, keepdims=True)
            shape = (len(mine), len(leds), 1)
            f = random.uniform(0.9, 1.1, shape) * 0.5 / np.pi * 1.2
            for name, values in (("f", f), ("u_own", np.full(shape, 0.01))):
                file.create_dataset(name, data=values.astype(np.float16), chunks=(16, 8, 1))
    return RunResult(folder)


def test_killed_between_two_views_it_goes_on_to_the_same(tmp_path: Path) -> None:
    subtract(folded(tmp_path / "whole"), paper=False)

    def killed(step: str, done: int, of: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        subtract(folded(tmp_path / "killed"), paper=False, say=killed)
    views = RunResult(tmp_path / "killed").views
    assert [view.inter_reflection is None for view in views] == [False, True]
    subtract(RunResult(tmp_path / "killed"), paper=False)
    for view in ("first", "second"):
        one, other = (h5py.File(tmp_path / name / f"samples/{view}.h5") for name in ("whole", "killed"))
        for name in ("f", "u_own", "inter_reflection"):
            np.testing.assert_array_equal(one[name][()], other[name][()])
    share = h5py.File(tmp_path / "whole/samples/first.h5")["inter_reflection"][()].astype(float)
    assert 0.02 < np.nanmedian(share) < 0.2


def test_paths_of_light_that_an_earlier_result_left_change_no_bit(tmp_path: Path) -> None:
    ahead = Ahead()
    subtract(folded(tmp_path / "whole"), paper=False)
    one_view = folded(tmp_path / "so-far")
    (one_view.folder / "samples/second.h5").unlink()
    subtract(RunResult(one_view.folder), paper=False, ahead=ahead)
    subtract(folded(tmp_path / "with"), paper=False, ahead=ahead)
    for view in ("first", "second"):
        one, other = (h5py.File(tmp_path / name / f"samples/{view}.h5") for name in ("whole", "with"))
        for name in ("f", "u_own", "inter_reflection"):
            np.testing.assert_array_equal(one[name][()], other[name][()])


def test_what_is_left_out_has_no_share_and_noise_grows_with_what_was_taken_off(tmp_path: Path) -> None:
    result = folded(tmp_path)
    with h5py.File(tmp_path / "samples/first.h5", "r+") as file:
        file["f"][:40] *= np.float16(0.02)  # far less than arrives from the wall
    subtract(result, paper=False)
    with h5py.File(tmp_path / "samples/first.h5") as file:
        f, u_own, share = (file[name][()].astype(float) for name in ("f", "u_own", "inter_reflection"))
        assert np.isnan(f[:40]).any()
        assert (np.isnan(f) == np.isnan(share)).all()
        assert (np.isnan(f) == np.isnan(u_own)).all()
        known = np.isfinite(f)
        assert share[known].max() < 0.5
        np.testing.assert_allclose(u_own[known] * (1 - share[known]), 0.01, rtol=2e-3)
        assert int(file.attrs["samples"]) == known.sum()


def test_views_under_the_same_leds_share_the_exitance_and_others_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    computed = []

    def counted(*arguments: Any, **more: Any) -> np.ndarray:
        computed.append(exitance := radiosity(*arguments, **more))
        return exitance

    monkeypatch.setattr(inter_reflection, "radiosity", counted)
    subtract(folded(tmp_path / "same"), paper=False)
    assert len(computed) == 1
    moved = folded(tmp_path / "moved")
    with h5py.File(moved.folder / "samples/second.h5", "r+") as file:
        file["led_positions_mm"][0] += 50.0
    subtract(moved, paper=False)
    assert len(computed) == 3
    first, second = (
        h5py.File(tmp_path / name / "samples/second.h5")["inter_reflection"][()] for name in ("same", "moved")
    )
    assert not np.array_equal(first[:, 0], second[:, 0], equal_nan=True)
