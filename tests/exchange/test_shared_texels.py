"""Materials that texels share, in exports and on the page: they are shown as by the command relight, and both say
that they are shared."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from lazily import lazily
from painted_texels import paint_texels
from relight_cases import GLOSSY, waves, write_result

from coupole.commands.completion import materials
from coupole.exchange.atlas.flat_surface import FlatSurface, flatten
from coupole.exchange.look.look_of_runs import OtherState, PageChoice, look_of_result
from coupole.exchange.of_results.measured_surface import read_surface
from coupole.reflectance.fits import TEXEL_CLUSTERS, TEXELS
from coupole.reflectance.run_result import VARIANCES, RunResult
from coupole.reflectance.texels.pixel_file import (
    TexelFileHead,
    ViewTexels,
    read_view_texels,
    texels_path,
    write_view_texels,
)
from coupole.reflectance.texels.texel_cluster_file import PATH, TexelClusters, write_texel_clusters
from coupole.reflectance.texels.texel_size import TexelSize

Usd: Any = lazily("pxr.Usd")
KD = np.array([[0.30, 0.05, 0.05], [0.05, 0.10, 0.30]])
KS, ALPHA = np.array([[0.02] * 3, [0.2] * 3]), np.array([0.1, 0.3])
TOLD = "share 2 materials, which `coupole reflectance cluster --texels` found"


@pytest.fixture
def result(tmp_path: Path) -> RunResult:
    """A result whose texels have two materials, one to the left and one to the right of the picture's middle. Both
    differ from the texels' own."""
    result = write_result(tmp_path / "result", waves(30), GLOSSY)
    paint_texels(result)
    texels = read_view_texels(result, result.views[0])
    number = (texels.pixels % 160 >= 80).astype(np.int32)
    clusters = TexelClusters(KD, KS, ALPHA, np.bincount(number), {"top": number})
    write_texel_clusters(result.folder / PATH, clusters)
    return result


def rewrite(result: RunResult, texels: ViewTexels) -> None:
    head = TexelFileHead("top", (160, 120), TexelSize(), 0.1, np.zeros(3), 0.0, is_simulated=True)
    write_view_texels(texels_path(result, result.views[0]), texels, head)


def flat_of(result: RunResult, fit: str) -> FlatSurface:
    return flatten(read_surface(result.folder, fit, takes_texels=True))


def test_maps_have_the_shared_materials_and_the_texels_own_normals(result: RunResult) -> None:
    own, shared = (flat_of(result, fit) for fit in (TEXELS, TEXEL_CLUSTERS))
    assert shared.measured_share > 0.7
    np.testing.assert_array_equal(shared.normals, own.normals)
    in_one = [np.isclose(shared.kd, kd, rtol=1e-4).all(axis=1) for kd in KD]
    of_triangles = np.isclose(shared.kd, own.kd).all(axis=1)
    assert (in_one[0] | in_one[1] | of_triangles).mean() > 0.97  # the others mix the two at their border
    for number, is_here in enumerate(in_one):
        assert is_here.mean() > 0.2
        np.testing.assert_allclose(shared.ks[is_here], np.repeat(KS[[number]], is_here.sum(), axis=0), rtol=1e-4)
        np.testing.assert_allclose(shared.alpha[is_here], ALPHA[number], rtol=1e-4)


def test_a_texel_whose_own_material_is_uncertain_has_the_shared_one(result: RunResult) -> None:
    """As in pictures of the command relight; its own material would give way to that of its triangle."""
    texels = read_view_texels(result, result.views[0])
    covariance = texels.covariance.copy()
    covariance[:, VARIANCES[2]] = 25.0
    rewrite(result, replace(texels, covariance=covariance))
    assert flat_of(result, TEXELS).measured_share == 0.0
    assert flat_of(result, TEXEL_CLUSTERS).measured_share > 0.7


def test_a_shared_material_has_no_uncertainty_but_a_normal_has(result: RunResult) -> None:
    own, shared = (flat_of(result, fit) for fit in (TEXELS, TEXEL_CLUSTERS))
    is_shared = np.isclose(shared.kd, KD[0], rtol=1e-4).all(axis=1)
    assert np.isnan(shared.uncertain[is_shared][:, [0, 1, 3]]).all()
    np.testing.assert_array_equal(shared.uncertain[:, 2], own.uncertain[:, 2])
    assert np.isfinite(own.uncertain[is_shared]).all()
    look = look_of_result(result.folder, choice=PageChoice(TEXEL_CLUSTERS))
    (block,) = (block for block in look.blocks if block.name == "uncertainty")
    of_own = look_of_result(result.folder, choice=PageChoice(TEXELS))
    (block_of_own,) = (block for block in of_own.blocks if block.name == "uncertainty")
    assert block.shape == block_of_own.shape
    assert block.text != block_of_own.text


def about_of(folder: Path, to: str) -> str:
    """What a file says of itself."""
    match to:
        case "gltf":
            data = (folder / "surface.glb").read_bytes()
            document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
            return str(document["asset"]["extras"]["about"])
        case "obj":
            return (folder / "surface.mtl").read_text()
        case "usd":
            stage = Usd.Stage.Open(str(folder / "surface.usdz"))
            return str(stage.GetRootLayer().comment)
        case "ktx2":
            return (folder / "normal.ktx2").read_bytes().decode(errors="ignore")
        case _:
            return (folder / "surface.mtlx").read_text()


@pytest.mark.parametrize("to", ["gltf", "obj", "usd", "ktx2", "materialx"])
def test_files_say_that_texels_share_materials_how_many_and_by_which_command(
    result: RunResult, tmp_path: Path, to: str
) -> None:
    """XML allows no two hyphens in a comment."""
    texels = len(read_view_texels(result, result.views[0]).pixels)
    told = f"fit texel_clusters of waves; {texels:,} texels {TOLD}"
    for fit in (TEXELS, TEXEL_CLUSTERS):
        ended = cells.here("export", result.folder, "--to", to, "--out", tmp_path / fit, "--fit", fit)
        assert ended.code == 0, ended.err
    assert told.replace("--", "- -" if to == "materialx" else "--") in about_of(tmp_path / TEXEL_CLUSTERS, to)
    assert "share" not in about_of(tmp_path / TEXELS, to).replace("share of", "")


@pytest.mark.parametrize("to", ["ply", "exr", "bsdf", "merl"])
def test_formats_without_maps_refuse_shared_materials(result: RunResult, tmp_path: Path, to: str) -> None:
    ended = cells.here("export", result.folder, "--to", to, "--out", tmp_path / "out", "--fit", TEXEL_CLUSTERS)
    assert ended.code == 2
    assert "--fit texel_clusters: is for formats with maps" in " ".join(ended.err.split())
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.parametrize("is_there", [False, True], ids=["none", "of other texels"])
@pytest.mark.parametrize("command", ["export", "show"])
def test_without_clusters_of_these_texels_the_command_that_makes_them_is_told(
    result: RunResult, tmp_path: Path, command: str, is_there: bool
) -> None:
    if is_there:
        texels = read_view_texels(result, result.views[0])
        fields = ("pixels", "normals", "kd", "ks", "alpha", "covariance")
        rewrite(result, replace(texels, **{name: getattr(texels, name)[:-1] for name in fields}))
    else:
        (result.folder / PATH).unlink()
    out = tmp_path / ("out" if command == "export" else "page.html")
    to = ("--to", "gltf") if command == "export" else ()
    ended = cells.here(command, result.folder, *to, "--out", out, "--fit", TEXEL_CLUSTERS)
    assert ended.code == 2
    assert f"`coupole reflectance cluster {result.folder} --texels` makes it" in " ".join(ended.err.split())
    assert not out.is_file()
    assert not list(out.glob("*"))


def test_the_page_says_that_materials_are_shared(result: RunResult) -> None:
    about = look_of_result(result.folder, choice=PageChoice(TEXEL_CLUSTERS)).about
    assert about["fit"] == TEXEL_CLUSTERS
    assert TOLD in about["told"]["Texels"]
    own = look_of_result(result.folder).about
    assert own["fit"] == TEXELS
    assert "share" not in own["told"]["Texels"]


def test_a_state_beside_it_shows_its_shared_materials(result: RunResult) -> None:
    choice = PageChoice(TEXEL_CLUSTERS, beside=OtherState(result.folder, np.eye(4), "the same"))
    look = look_of_result(result.folder, choice=choice)
    assert look.about["beside"]["fit"] == TEXEL_CLUSTERS
    texts = {block.name: block.text for block in look.later}
    tiles = [name for name in texts if name.startswith("texels-")]
    assert tiles
    assert all(texts[f"beside-{name}"] == texts[name] for name in tiles)


def test_the_shell_completes_them() -> None:
    assert ("texel_clusters", "of clusters of texels") in materials("te")
