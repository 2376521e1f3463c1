"""Clusters of texels whose materials are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cells
import numpy as np
import pytest
from painted_texels import paint_texels
from relight_cases import GLOSSY, waves, write_result

from coupole.errors import InputError
from coupole.reflectance.fits import TEXEL_CLUSTERS, TEXELS
from coupole.reflectance.new_light.light_kinds import DistantLight
from coupole.reflectance.new_light.pictured_surface import FreeCamera
from coupole.reflectance.run_relighting import scene_from, scene_of_view
from coupole.reflectance.run_result import VARIANCES, RunResult
from coupole.reflectance.texels.pixel_file import (
    TexelFileHead,
    ViewTexels,
    read_view_texels,
    texels_path,
    write_view_texels,
)
from coupole.reflectance.texels.texel_cluster_file import PATH, write_texel_clusters
from coupole.reflectance.texels.texel_clusters import group_texels
from coupole.reflectance.texels.texel_size import TexelSize

PAINTS = np.array([[0.30, 0.05, 0.05], [0.05, 0.10, 0.30]])
KS = np.array([0.05, 0.2])
MEMORY = 1 << 30
ANYWHERE = FreeCamera(np.array([30.0, -90.0, 250.0]), None, (160, 120))


@pytest.fixture
def result(tmp_path: Path) -> RunResult:
    result = write_result(tmp_path / "result", waves(30), GLOSSY)
    paint_texels(result)
    return result


def with_two_paints(result: RunResult) -> np.ndarray:
    """Give every third texel another paint, and return which paint each has."""
    texels = read_view_texels(result, result.views[0])
    paint: np.ndarray = (np.arange(len(texels.pixels)) % 3 == 0).astype(int)
    ks = np.repeat(KS[paint][:, None], 3, axis=1)
    rewrite(result, replace(texels, kd=PAINTS[paint].astype(np.float32), ks=ks.astype(np.float32)))
    return paint


def rewrite(result: RunResult, texels: ViewTexels) -> None:
    head = TexelFileHead("top", (160, 120), TexelSize(), 0.1, np.zeros(3), 0.0, is_simulated=True)
    write_view_texels(texels_path(result, result.views[0]), texels, head)


def test_texels_of_two_paints_are_two_clusters(result: RunResult) -> None:
    paint = with_two_paints(result)
    clusters = group_texels(result, 2, MEMORY)
    number = clusters.cluster["top"]
    assert len(clusters.alpha) == 2
    np.testing.assert_allclose(clusters.kd[number], PAINTS[paint], rtol=1e-5)
    np.testing.assert_allclose(clusters.ks[number, 0], KS[paint], rtol=1e-5)
    assert clusters.members[number[paint == 1][0]] == np.count_nonzero(paint)


def test_a_texel_that_saw_no_highlight_says_little_of_the_lobe(result: RunResult) -> None:
    """Nine of ten texels have a ks that is ten times too low, and an uncertainty that says so."""
    with_two_paints(result)
    texels = read_view_texels(result, result.views[0])
    is_poor = np.arange(len(texels.pixels)) % 10 != 0
    covariance = texels.covariance.copy()
    covariance[is_poor, VARIANCES[3]] = 1e4
    kd, ks = (
        np.full_like(texels.kd, 0.2),
        np.where(is_poor[:, None], np.float32(0.002), np.full_like(texels.ks, 0.02)),
    )
    rewrite(result, replace(texels, kd=kd, ks=ks, covariance=covariance))
    (ks_of_cluster,) = group_texels(result, 1, MEMORY).ks
    np.testing.assert_allclose(ks_of_cluster, 0.02, rtol=0.01)


def test_a_smaller_memory_gives_the_same_clusters(result: RunResult) -> None:
    whole, in_parts = (group_texels(result, 12, memory_bytes) for memory_bytes in (MEMORY, 300_000))
    np.testing.assert_array_equal(whole.cluster["top"], in_parts.cluster["top"])
    np.testing.assert_allclose(whole.kd, in_parts.kd, rtol=1e-12)


def test_clusters_without_texels_are_left_out(result: RunResult) -> None:
    with_two_paints(result)
    clusters = group_texels(result, 16, MEMORY)
    assert clusters.members.min() > 0
    assert clusters.cluster["top"].max() == len(clusters.alpha) - 1


def test_more_clusters_than_texels_are_refused(result: RunResult) -> None:
    texels = len(read_view_texels(result, result.views[0]).pixels)
    with pytest.raises(InputError, match=f"expected at most {texels}, the texels; got {texels + 1}"):
        group_texels(result, texels + 1, MEMORY)


def pictures(result: RunResult, count: int, camera: FreeCamera | None) -> tuple[np.ndarray, np.ndarray]:
    """Pictures under a low light by texels' own materials and by those of so many clusters, in the pixels where
    both have a value."""
    write_texel_clusters(result.folder / PATH, group_texels(result, count, MEMORY))
    light = [DistantLight(towards=(-0.6, -0.3, 0.7))]
    own, shared = (
        (scene_of_view(result, "top", fit) if camera is None else scene_from(result, camera, fit)).picture(light)
        for fit in (TEXELS, TEXEL_CLUSTERS)
    )
    is_lit = (own > 0.0).all(axis=2)
    assert is_lit.mean() > 0.2
    return own[is_lit], shared[is_lit]


@pytest.mark.parametrize("camera", [None, ANYWHERE], ids=["view", "anywhere"])
def test_pictures_by_the_true_materials_are_those_by_texels(result: RunResult, camera: FreeCamera | None) -> None:
    """Also by each texel's own normal: the texels have bumps, which the triangles do not have."""
    with_two_paints(result)
    own, shared = pictures(result, 2, camera)
    np.testing.assert_allclose(shared, own, rtol=1e-4)


@pytest.mark.parametrize("camera", [None, ANYWHERE], ids=["view", "anywhere"])
def test_pictures_by_one_material_have_one_colour(result: RunResult, camera: FreeCamera | None) -> None:
    """Two thirds of the texels, all as certain, have the first paint; no texel shines."""
    paint = with_two_paints(result)
    texels = read_view_texels(result, result.views[0])
    rewrite(result, replace(texels, ks=np.full_like(texels.ks, 1e-9)))
    share = paint.mean()
    mean = np.exp((1 - share) * np.log(PAINTS[0]) + share * np.log(PAINTS[1]))
    own, shared = pictures(result, 1, camera)
    np.testing.assert_allclose(shared[:, 0] / shared[:, 2], mean[0] / mean[2], rtol=1e-3)
    assert np.ptp(own[:, 0] / own[:, 2]) > 1.0


@pytest.mark.parametrize("more", [(), ("--from", "30,-90,250")])
def test_without_clusters_the_command_that_makes_them_is_told(
    result: RunResult, tmp_path: Path, more: tuple[str, ...]
) -> None:
    ended = relit(result, tmp_path, *more)
    assert ended.code == 2
    assert f"`coupole reflectance cluster {result.folder} --texels` makes it" in " ".join(ended.err.split())


def test_clusters_of_other_texels_are_refused(result: RunResult, tmp_path: Path) -> None:
    write_texel_clusters(result.folder / PATH, group_texels(result, 2, MEMORY))
    texels = read_view_texels(result, result.views[0])
    fields = ("pixels", "normals", "kd", "ks", "alpha", "covariance")
    rewrite(result, replace(texels, **{name: getattr(texels, name)[:-1] for name in fields}))
    ended = relit(result, tmp_path)
    assert ended.code == 2
    assert "belongs to other texels" in ended.err


@pytest.mark.parametrize("option", ["--uncertainty", "--interval"])
def test_shared_materials_have_no_uncertainty(result: RunResult, tmp_path: Path, option: str) -> None:
    write_texel_clusters(result.folder / PATH, group_texels(result, 2, MEMORY))
    files = [str(tmp_path / "u.npy")] + [str(tmp_path / "high.npy")] * (option == "--interval")
    ended = relit(result, tmp_path, option, ",".join(files))
    assert ended.code == 2
    assert "texel_clusters has none" in ended.err
    assert not (tmp_path / "p.npy").exists()


def relit(result: RunResult, folder: Path, *more: str) -> cells.Ended:
    arguments = ("--fit", TEXEL_CLUSTERS, "--direction", "0,0,1", "--to", folder / "p.npy", *more)
    return cells.here("reflectance", "relight", result.folder, *arguments)
