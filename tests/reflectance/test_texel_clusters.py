"""Clusters of texels whose materials are known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from painted_texels import paint_texels
from relight_cases import GLOSSY, waves, write_result

from coupole.errors import InputError
from coupole.reflectance.run_result import VARIANCES, RunResult
from coupole.reflectance.texels.pixel_file import (
    TexelFileHead,
    ViewTexels,
    read_view_texels,
    texels_path,
    write_view_texels,
)
from coupole.reflectance.texels.texel_clusters import group_texels
from coupole.reflectance.texels.texel_size import TexelSize

PAINTS = np.array([[0.30, 0.05, 0.05], [0.05, 0.10, 0.30]])
KS = np.array([0.05, 0.2])
MEMORY = 1 << 30


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
