"""`--texels MM`: texels as wide as asked, on the relief with detail that its mesh does not have."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cells
import numpy as np
import pytest
from dask_cluster import cluster
from relief_cells import DIFFUSE, Made, ablated
from texel_truth import seen_by_texels

from coupole.calibration.record import records_named
from coupole.commands.texels_told import lines_of
from coupole.exchange.atlas.flat_surface import flatten
from coupole.exchange.of_results.measured_surface import read_surface
from coupole.reflectance.fits import TEXELS
from coupole.reflectance.run_job import RunRequest
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.texels.pixel_file import read_view_texels, size_of_texels, texel_uncertainty
from coupole.reflectance.texels.texel_forecast import TexelForecast, ViewForecast
from coupole.reflectance.texels.texel_job import add_texels
from coupole.reflectance.texels.texel_size import TexelSize

SIZE_MM = 0.8


def arguments(detailed: Made, out: Path, size: str) -> tuple[str | Path, ...]:
    records = detailed[0].folder / "records"
    return ("reflectance", detailed[0].run_folder, "--calibrations", records, "--out", out, "--texels", size)


def without_texels(detailed: Made, out: Path) -> Path:
    return Path(shutil.copytree(detailed[1], out, ignore=shutil.ignore_patterns("texels")))


@pytest.fixture(scope="module")
def coarse(detailed: Made, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """The result with texels of 0.8 mm in the place of its own."""
    out = without_texels(detailed, tmp_path_factory.mktemp("sizes") / "result")
    ended = cells.here(*arguments(detailed, out, f"{SIZE_MM}"), "--json")
    assert ended.code == 0, ended.err
    return detailed[0], out, ended.document


def test_what_they_are_is_foreseen(coarse: Made) -> None:
    texels = coarse[2]["texels"]
    foreseen, made = texels["foreseen"], sum(texels["pixels"].values())
    assert abs(foreseen["texels"] / made - 1) < 0.1
    assert {view["view"]: view["side_px"] for view in foreseen["views"]} == texels["side_px"]
    assert all(abs(view["texel_mm"] - SIZE_MM) < 0.1 for view in foreseen["views"])
    disk = sum(path.stat().st_size for path in (coarse[1] / "texels").glob("*.h5"))
    assert 0.7 < foreseen["disk_bytes"] / disk < 1.4
    assert foreseen["time_s"] > 0.1
    assert foreseen["memory_bytes"] > 1e8


def test_they_take_a_quarter_of_the_disk(detailed: Made, coarse: Made) -> None:
    single, several = (
        sum(p.stat().st_size for p in (made[1] / "texels").glob("*.h5")) for made in (detailed, coarse)
    )
    assert several < 0.3 * single


def test_pictures_of_leds_that_no_fit_has_seen_are_better_than_by_triangles(coarse: Made) -> None:
    texels = coarse[2]["texels"]
    (other,) = set(texels["mae"]) - {TEXELS}
    assert texels["held_out_psnr_db"][TEXELS] > texels["held_out_psnr_db"][other]
    assert texels["mae"][TEXELS] < texels["mae"][other]
    assert texels["asked_mm"] == SIZE_MM


def test_paint_is_the_mean_of_what_their_pixels_see_in_all_channels(coarse: Made) -> None:
    result = RunResult(coarse[1])
    for view in result.views:
        texels = read_view_texels(result, view)
        seen = seen_by_texels(result, view, texels)
        error = np.log(texels.kd * np.pi / np.array(DIFFUSE)) - np.log(seen.paint)[:, None]
        u_kd = np.sqrt(texels.covariance[:, 5] + np.sum(np.square(texel_uncertainty(result, view))))
        assert (np.median(np.abs(error), axis=0) < 0.05).all()
        held = (np.abs(error) < 1.96 * u_kd[:, None]).mean(axis=0)
        assert (held > 0.85).all()
        assert (held < 0.995).all()


def test_normals_show_bumps_that_the_mesh_does_not_have(coarse: Made) -> None:
    result = RunResult(coarse[1])
    view = result.views[1]
    texels = read_view_texels(result, view)
    seen = seen_by_texels(result, view, texels)
    cosines = np.clip(np.sum(texels.normals * seen.bumpy, axis=1), -1, 1)
    assert np.degrees(np.median(np.arccos(cosines))) < 1.5


def test_a_pixel_of_a_picture_has_the_material_of_its_texel(coarse: Made) -> None:
    result = RunResult(coarse[1])
    view = result.views[1]
    texels = read_view_texels(result, view)
    number = texels.in_picture((384, 512))
    assert texels.side_px == 2
    assert np.bincount(number[number >= 0]).max() == 4
    np.testing.assert_array_equal(number.reshape(-1)[texels.pixels], np.arange(len(texels.pixels)))


def test_a_job_that_was_stopped_goes_on_and_ends_alike(detailed: Made, coarse: Made, tmp_path: Path) -> None:
    """Whatever the memory, and whoever does the work: the same bits."""
    copy = tmp_path / "result"
    shutil.copytree(coarse[1], copy)
    (copy / "texels/top.h5").unlink()
    request = RunRequest((detailed[0].run_folder,), None, records_named([detailed[0].folder / "records"]))
    add_texels(replace(request, memory_bytes=1_500_000), copy, TexelSize(SIZE_MM))
    assert (copy / "texels/top.h5").read_bytes() == (coarse[1] / "texels/top.h5").read_bytes()
    shutil.rmtree(copy / "texels")
    with cluster(tmp_path, 2) as (address, _):
        add_texels(request, copy, TexelSize(SIZE_MM), scheduler=address)
    for name in ("top.h5", "side.h5", "texels.json"):
        assert (copy / "texels" / name).read_bytes() == (coarse[1] / "texels" / name).read_bytes()


def test_texels_of_another_size_are_not_written_over(detailed: Made, coarse: Made) -> None:
    for size in ("auto", "1.6"):
        ended = cells.here(*arguments(detailed, coarse[1], size))
        assert ended.code == 2
        assert "has texels of 0.8 mm already" in ended.err
    assert size_of_texels(coarse[1]) == TexelSize(SIZE_MM)
    ended = cells.here(*arguments(detailed, detailed[1], "0.8"))
    assert ended.code == 2
    assert "has texels of single pixels (auto) already" in ended.err


def test_the_same_size_again_changes_nothing(detailed: Made, coarse: Made) -> None:
    before = (coarse[1] / "texels/top.h5").stat().st_mtime_ns
    ended = cells.here(*arguments(detailed, coarse[1], "0.80"), "--json")
    assert ended.code == 0, ended.err
    assert ended.document["texels"]["foreseen"] is None
    assert (coarse[1] / "texels/top.h5").stat().st_mtime_ns == before


@pytest.mark.parametrize("size", ["0", "-0.2", "nan", "inf", "101", "0.2mm", ""])
def test_what_is_no_size_is_refused(detailed: Made, tmp_path: Path, size: str) -> None:
    ended = cells.here(*arguments(detailed, tmp_path / "out", size))
    assert ended.code == 2
    assert "--texels: expected auto (each view's own pixels) or a width" in ended.err
    assert not (tmp_path / "out").exists()


def test_what_is_finer_than_the_frames_is_refused_before_any_work(detailed: Made, tmp_path: Path) -> None:
    ended = cells.here(*arguments(detailed, tmp_path / "out", "0.2"))
    assert ended.code == 2
    assert "a pixel of the finest view, top, sees 0.4" in ended.err
    assert "or more, or auto for single pixels" in ended.err
    assert not (tmp_path / "out").exists()


def test_relighting_takes_them_with_uncertainty_and_from_anywhere(coarse: Made, tmp_path: Path) -> None:
    for more in (("--uncertainty", tmp_path / "u.npy"), ("--from", "0,-200,300"), ("--view", "side")):
        ended = cells.here(
            "reflectance", "relight", coarse[1], "--direction", "0.3,-0.5,1", "--to", tmp_path / "p.npy", "--fit",
            TEXELS, *more, "--json",
        )  # fmt: skip
        assert ended.code == 0, ended.err
        assert (np.load(tmp_path / "p.npy") > 0.0).mean() > 0.05
    picture = np.load(tmp_path / "u.npy")
    assert np.isfinite(picture).all()


def test_maps_are_as_coarse_as_they_are(coarse: Made) -> None:
    flat = flatten(read_surface(coarse[1], TEXELS, takes_texels=True))
    assert flat.texel_mm == pytest.approx(SIZE_MM, rel=0.15)
    assert flat.measured_share > 0.8


def test_texels_larger_than_triangles_are_told() -> None:
    view = ViewForecast("top", 45, 200_000, 30_000, 0.4, 4)
    lines = list(lines_of(TexelForecast(TexelSize(1.6), (view,), 1.2, 500_000_000, 2_000_000, 75.0), 10**9))
    assert lines[0] == "texels: some 1,900 in 1 view, 4 x 4 pixels each, 1.6 mm on the surface"
    assert lines[1].startswith(
        "they need about 500.0 MB of memory and 2.0 MB of disk; after the fits of triangles they take 1 min 15 s"
    )
    assert "larger than the mesh's triangles, whose edge is 1.2 mm" in lines[2]
    assert len(list(lines_of(TexelForecast(TexelSize(), (view,), 1.2, 1, 1, 1.0), 1))) == 2


def test_memory_that_the_machine_does_not_have_is_told() -> None:
    view = ViewForecast("top", 1080, 12_582_912, 10_000_000, 0.05, 1)
    forecast = TexelForecast(TexelSize(), (view, view), 0.3, 12 * 10**9, 2 * 10**9, 7200.0)
    assert len(list(lines_of(forecast, 12 * 10**9))) == 2
    assert "this machine has 11.90 GB of memory" in list(lines_of(forecast, 11_900_000_000))[2]


def test_texels_that_the_disk_cannot_hold_are_refused_before_the_work(
    detailed: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the memory, disk and time that they take said first."""
    out = tmp_path / "new/result"
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=0, used=0, free=1_000_000))
    ended = cells.here(*arguments(detailed, out, "auto"))
    assert ended.code == 6, ended.err
    assert re.search(r"texels need about \d\.\d\d GB, and 0\.00 GB are free", " ".join(ended.err.split()))
    assert "of disk; after the fits" in " ".join(ended.out.split()) + " ".join(ended.err.split())
    assert not out.exists()


def test_ablation_of_squares_tells_what_fewer_leds_cost(coarse: Made, tmp_path: Path) -> None:
    """With all LEDs, the values of squares are means of their pixels, without the detail that squares lack; so the
    error is smaller than that of pictures."""
    _, document = ablated(coarse, tmp_path, "share of the LEDs")
    whole, half = (of_fits for _, of_fits in document["mae"]["share of the LEDs"])
    assert document["side_px"] == coarse[2]["texels"]["side_px"]
    assert whole[TEXELS] < coarse[2]["texels"]["mae"][TEXELS]
    assert half[TEXELS] > 1.2 * whole[TEXELS]
