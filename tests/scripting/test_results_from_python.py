"""`coupole.open_result`: arrays, new lights and exports are those of the files and of the commands."""

from __future__ import annotations

from pathlib import Path

import cells
import h5py
import numpy as np
import pytest
import relight_cases as cases
import trimesh
from relight_cases import Coat, waves, write_result

import coupole


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> coupole.Result:
    folder = tmp_path_factory.mktemp("relief") / "result"
    write_result(folder, waves(), Coat(ks=(0.1, 0.1, 0.1)))
    opened = coupole.open_result(folder)
    assert isinstance(opened, coupole.Result)
    return opened


def test_arrays_lie_on_the_mesh(result: coupole.Result) -> None:
    with h5py.File(result.folder / "object.h5") as file:
        corners_mm = file["corners_mm"][()]
    np.testing.assert_array_equal(result.vertices_mm[result.faces], corners_mm)
    assert len(result.vertices_mm) == 60 * 60
    materials = result.materials("ggx")
    assert materials.kd.shape == (len(result.faces), 3)
    np.testing.assert_allclose(materials.kd[result.is_seen], np.tile([0.2, 0.15, 0.1], (result.is_seen.sum(), 1)))
    assert np.isnan(materials.kd[~result.is_seen]).all()
    true_normals = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    true_normals /= np.linalg.norm(true_normals, axis=1, keepdims=True)
    np.testing.assert_allclose(result.normals()[result.is_seen], true_normals[result.is_seen], atol=1e-4)
    assert result.covariances().shape == (len(result.faces), 5, 5)
    assert (result.views, result.fits) == (("top",), ("ggx", "ggx_normal"))
    with pytest.raises(coupole.errors.InputError, match="expected a fit of ggx, ggx_normal; found phong"):
        result.materials("phong")


def test_a_relit_picture_and_its_uncertainty_are_the_commands(result: coupole.Result, tmp_path: Path) -> None:
    to, u_to = tmp_path / "lit.npy", tmp_path / "u.npy"
    options = ("--direction", "0,2,2", "--light-at", "10,20,300", "--fit", "ggx", "--uncertainty", u_to)
    assert cells.here("reflectance", "relight", result.folder, *options, "--to", to).code == 0
    near = coupole.lights.PointLight(at_mm=(10.0, 20.0, 300.0))
    picture = result.relight([near], direction=(0.0, 2.0, 2.0), fit="ggx")
    assert picture.shape == (*cases.SIZE_PX[::-1], 3)
    np.testing.assert_allclose(picture, np.load(to), rtol=1e-5, atol=1e-6)
    u = result.relight_uncertainty([near], direction=(0.0, 2.0, 2.0), fit="ggx")
    np.testing.assert_allclose(u, np.load(u_to), rtol=1e-5, atol=1e-6)
    with pytest.raises(coupole.errors.InputError, match="expected a light"):
        result.relight()
    with pytest.raises(coupole.errors.InputError, match="expected one of top"):
        result.relight(direction=(0.0, 0.0, 1.0), view="side")


def test_an_export_is_written_into_a_folder(result: coupole.Result, tmp_path: Path) -> None:
    (path,) = result.to("ply", tmp_path / "out")
    assert len(trimesh.load(path, process=False).faces) > 0
    with pytest.raises(coupole.errors.InputError, match="has files already"):
        result.to("ply", tmp_path / "out")
    with pytest.raises(coupole.errors.InputError, match="found docx"):
        result.to("docx", tmp_path / "other")


def test_a_folder_without_a_result_is_refused(tmp_path: Path) -> None:
    with pytest.raises(coupole.errors.InputError, match="holds no result"):
        coupole.open_result(tmp_path)
