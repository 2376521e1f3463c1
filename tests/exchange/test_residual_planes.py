"""Planes of what GGX leaves: against the fit itself, written out anew from what a page has."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path

import cells
import numpy as np
import pytest
from relight_cases import unit, waves
from residual_cases import write_backscatter
from scipy.interpolate import RegularGridInterpolator

from coupole.exchange.look.residual_planes import SIDE, residual_blocks, residual_planes
from coupole.reflectance.fits import SLICES
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.slice_fit import slice_values
from coupole.reflectance.triangle_fit import model_values


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return write_backscatter(tmp_path_factory.mktemp("planes") / "result", waves(14))


def test_a_page_has_the_fit_from_its_bytes_alone(result: RunResult) -> None:
    """By the layout of docs/reference/page.md: tables in Lambert's projection, roots of numbers, shares of GGX."""
    (view,) = result.views
    found = residual_planes(result, view, 9)
    samples = result.view_samples(view, slice(None))
    model = model_values(samples, result.materials("ggx_normal"))
    fit = slice_values(samples, result.slices("ggx_rbf", view), SLICES["ggx_rbf"].basis, model)
    n = samples.normals
    to_camera = samples.cameras_mm[0] - samples.centres_mm
    x = unit(to_camera - n * np.sum(to_camera * n, axis=1, keepdims=True))
    ways = unit(samples.led_mm - samples.centres_mm[:, None])
    x, y, z = (np.einsum("nlk,nk->nl", ways, axis) for axis in (x, np.cross(n, x), n))
    line = np.linspace(-1, 1, SIDE)
    table = RegularGridInterpolator((line, line), found.planes.astype(float).transpose(1, 2, 0, 3))
    at = np.stack([y, x], axis=-1) / np.sqrt(1 + np.maximum(z, 0))[..., None]
    codes = found.codes.astype(float)
    roots = (codes[3:] - 128) / 127
    left = np.einsum("pn,nlpc->nlc", roots * np.abs(roots), table(np.clip(at, -1, 1)))
    shares = (codes[:3].T[:, None] - 1) / 254
    mine = np.maximum(shares * model + np.maximum(z, 0)[..., None] * left, 0)
    above = z > 0.05
    size = np.sqrt(np.mean(fit[above] ** 2))
    assert np.sqrt(np.mean((model - fit)[above] ** 2)) > 0.1 * size  # there is something to be kept
    assert np.sqrt(np.mean((mine - fit)[above] ** 2)) < 0.01 * size


def test_the_share_of_energy_that_is_kept_is_what_was_missed_of_it(result: RunResult) -> None:
    kept = {planes: residual_blocks(result, planes, lambda *_: None)[0]["kept"] for planes in (1, 3, 9, 29)}
    assert sorted(kept.values()) == list(kept.values())
    assert kept[1] < 0.95
    assert kept[9] > 0.99
    assert kept[29] > 0.999


def test_triangles_without_a_fit_have_no_residual(result: RunResult) -> None:
    about, blocks = residual_blocks(result, 2, lambda *_: None)
    assert [block.name for block in blocks] == about["views"][0]["blocks"] == ["residual-top", "planes-top"]
    assert blocks[1].shape == (2, SIDE, SIDE, 3)
    codes = np.frombuffer(zlib.decompress(base64.b64decode(blocks[0].text)), np.uint8)
    fitted = np.zeros(len(result.corners_mm), bool)
    fitted[result.views[0].triangles] = np.isfinite(result.slices("ggx_rbf", result.views[0])).all(axis=(1, 2))
    assert not fitted.all()
    np.testing.assert_array_equal(codes.reshape(blocks[0].shape)[:3].all(axis=0), fitted)


def test_the_command_tells_how_much_is_kept_and_where_it_lies(result: RunResult, tmp_path: Path) -> None:
    ended = cells.here("show", result.folder, "--residual-planes", "5", "--out", tmp_path / "look.html")
    assert ended.code == 0, ended.err
    assert "residual: 5 planes contain 99." in ended.err
    told = cells.here("show", result.folder, "--residual-planes", "0", "--out", tmp_path / "look.html", "--json")
    assert "residual" not in told.document["about"]
    assert told.document["about"]["fit"] == "ggx"
