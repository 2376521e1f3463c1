"""`coupole reflectance cluster --texels`: a few materials for the texels of a run's result."""

from __future__ import annotations

import shutil
from pathlib import Path

import cells
import h5py
import pytest
from relief_cells import Made

from coupole.reflectance.texels.pixel_file import size_of_texels


@pytest.fixture
def copied(detailed: Made, tmp_path: Path) -> Path:
    return Path(shutil.copytree(detailed[1], tmp_path / "result"))


def test_texels_share_a_few_materials_and_the_error_is_told(detailed: Made, copied: Path) -> None:
    ended = cells.here("reflectance", "cluster", copied, "--texels", "--clusters", "24", "--json")
    assert ended.code == 0, ended.err
    about = ended.document
    assert about["texels"] == sum(detailed[2]["texels"]["pixels"].values())
    assert 1 < about["clusters"] <= 24
    assert about["mae"]["own"] == pytest.approx(detailed[2]["texels"]["mae"]["texels"], rel=0.1)
    assert about["mae"]["own"] < about["mae"]["clustered"] < 3.0 * about["mae"]["own"]
    with h5py.File(copied / "fits/texel_clusters.h5") as file:
        assert file["members"][()].sum() == about["texels"]
        assert set(file["cluster"]) == {path.stem for path in (copied / "texels").glob("*.h5")}
    page = (copied / "texel_clusters.html").read_text()
    assert "clusters, any colours" in page
    assert f"{100 * about['mae']['clustered']:.3f} % of range" in page
    assert size_of_texels(copied) is not None  # the files of texels are still only those of views


@pytest.mark.parametrize("options", [("--without-view", "side"), ("--degrees", "12")])
def test_what_only_samples_of_triangles_can_give_is_refused(copied: Path, options: tuple[str, str]) -> None:
    ended = cells.here("reflectance", "cluster", copied, "--texels", *options)
    assert ended.code == 2
    assert "are for clusters of triangles" in " ".join(ended.err.split())


def test_a_result_without_texels_is_refused(copied: Path) -> None:
    shutil.rmtree(copied / "texels")
    ended = cells.here("reflectance", "cluster", copied, "--texels")
    assert ended.code == 2
    assert "has no texels" in ended.err
