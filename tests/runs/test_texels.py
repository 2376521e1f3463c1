"""`--texels`: detail that the mesh does not have, in pictures of other lights and from other places."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from dask_cluster import cluster
from lazily import lazily
from relief_cells import DIFFUSE, FEWER, RECORDS, Made, ablated
from scipy.ndimage import gaussian_filter
from texel_truth import seen_by

from coupole.calibration.record import records_named
from coupole.reflectance.fits import TEXELS
from coupole.reflectance.new_light.light_kinds import DistantLight, LedLight
from coupole.reflectance.new_light.pictured_surface import FreeCamera, pixels_of_places
from coupole.reflectance.relit_uncertainty import uncertainty_of_picture
from coupole.reflectance.run_ablation import Variant, leds_of
from coupole.reflectance.run_job import RunRequest
from coupole.reflectance.run_pictures import read_check_frames
from coupole.reflectance.run_relighting import scene_from, scene_of_view
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.texels.pixel_file import read_view_texels, texel_uncertainty
from coupole.reflectance.texels.texel_job import add_texels

MaterialX: Any = lazily("MaterialX")
Usd: Any = lazily("pxr.Usd")
UsdGeom: Any = lazily("pxr.UsdGeom")
UsdValidation: Any = lazily("pxr.UsdValidation")


@pytest.fixture
def made(detailed: Made) -> Made:
    return detailed


def request_of(made: Made) -> RunRequest:
    return RunRequest((made[0].run_folder,), None, records_named([made[0].folder / "records"]))


def test_pictures_of_leds_that_no_fit_has_seen_are_better_than_by_triangles(made: Made) -> None:
    texels = made[2]["texels"]
    (other,) = set(texels["mae"]) - {TEXELS}
    assert texels["held_out_psnr_db"][TEXELS] > texels["held_out_psnr_db"][other] + 3.0
    assert texels["mae"][TEXELS] < 0.6 * texels["mae"][other]
    assert made[2]["mae_of_noise"] < texels["mae"][TEXELS] < 2.5 * made[2]["mae_of_noise"]


def test_paint_is_found_pixel_by_pixel_and_intervals_hold_most_of_it(made: Made) -> None:
    """In the pixels' own channels, in all five parts of what is darker and lighter paint."""
    result = RunResult(made[1])
    for view in result.views:
        texels = read_view_texels(result, view)
        seen = seen_by(result, view, texels.pixels)
        row, column = np.divmod(texels.pixels, 512)
        channel = np.array([[1, 2], [0, 1]])[row % 2, column % 2]
        kd = texels.kd[np.arange(len(row)), channel] * np.pi / np.array(DIFFUSE)[channel]
        error = np.log(kd) - np.log(seen.paint)
        u_kd = np.sqrt(texels.covariance[:, 5] + np.sum(np.square(texel_uncertainty(result, view))))
        assert np.median(np.abs(error)) < 0.03
        assert np.std(np.log(seen.paint)) > 0.15
        held = np.abs(error) < 1.96 * u_kd
        assert 0.85 < held.mean() < 0.99
        fifths = np.array_split(np.argsort(seen.paint), 5)
        assert min(held[fifth].mean() for fifth in fifths) > 0.78


def test_normals_show_bumps_that_the_mesh_does_not_have(made: Made) -> None:
    result = RunResult(made[1])
    view = result.views[1]
    texels = read_view_texels(result, view)
    seen = seen_by(result, view, texels.pixels)

    def off_deg(normals: np.ndarray) -> float:
        cosines = np.sum(normals * seen.bumpy, axis=1)[seen.inner]
        return float(np.degrees(np.median(np.arccos(np.clip(cosines, -1, 1)))))

    triangles = result.materials("ggx_normal", np.searchsorted(result.triangles, view.triangles)).normals
    assert off_deg(texels.normals) < 0.4 * min(off_deg(seen.normals), off_deg(triangles[seen.triangle]))


def test_fine_contrast_of_the_frames_is_kept(made: Made) -> None:
    """Of paint that is finer than three triangles, under LEDs that were left out, texels keep 0.8."""
    result = RunResult(made[1])
    view = result.views[1]
    frames = read_check_frames(result, view)
    shares: dict[str, list[float]] = {TEXELS: [], "ggx_normal": []}
    for number, led in enumerate(frames.leds):
        measured = frames.share[number, ..., 1].astype(float)
        known = np.isfinite(measured)
        for name, of_fit in shares.items():
            picture = scene_of_view(result, view.view, name).picture([LedLight(number=int(led))])[::2, ::2, 1]
            both = gaussian_filter((known & (picture > 0)).astype(float), 2.0) > 0.999
            fine, wanted = (
                image - gaussian_filter(image, 2.0) for image in (picture.astype(float), np.nan_to_num(measured))
            )
            of_fit.append(float(np.sum((fine * wanted)[both]) / np.sum(wanted[both] ** 2)))
    assert np.mean(shares[TEXELS]) > 0.9
    assert np.mean(shares["ggx_normal"]) < 0.75


def test_a_camera_anywhere_sees_what_a_measured_view_shows(made: Made) -> None:
    """A free camera at a view's own place, under the same light: pixel by pixel nearly the view's picture."""
    result = RunResult(made[1])
    view = result.views[1]
    light = [DistantLight(towards=(0.3, -0.5, 1.0))]
    at_mm = np.linalg.inv(result.base_from_support) @ np.append(view.camera_mm, 1.0)
    free = scene_from(result, FreeCamera(at_mm[:3], None, (400, 300)))
    assert free.fit == TEXELS
    picture = free.picture(light)
    own = scene_of_view(result, view.view, TEXELS)
    lit = (picture > 0.0).all(axis=2) & np.isfinite(free.surface.places_mm).all(axis=2)
    pixels = pixels_of_places(own.surface, free.surface.places_mm[lit])
    assert pixels is not None
    column, row = np.round(pixels).astype(int).T
    inside = (row >= 0) & (row < 384) & (column >= 0) & (column < 512)
    there = own.picture(light)[row[inside], column[inside]]
    shown = (there > 0.0).all(axis=1)
    ratio = picture[lit][inside][shown] / there[shown]
    assert len(ratio) > 5000
    assert abs(np.median(ratio) - 1) < 0.01
    assert np.median(np.abs(ratio - 1)) < 0.05


def test_pictures_have_an_uncertainty(made: Made, tmp_path: Path) -> None:
    picture, uncertain = tmp_path / "p.npy", tmp_path / "u.npy"
    arguments = ("--direction", "0.3,-0.5,1", "--to", picture, "--uncertainty", uncertain, "--json")
    ended = cells.here("reflectance", "relight", made[1], *arguments)
    assert ended.code == 0, ended.err
    assert ended.document["fit"] == TEXELS
    values, u = np.load(picture), np.load(uncertain)
    share = u[values > 0.0] / values[values > 0.0]
    assert np.isfinite(share).all()
    assert 0.005 < np.median(share) < 0.1


def test_uncertainty_of_a_picture_is_that_of_its_texels(made: Made) -> None:
    """Where the covariance is a hundred times as large, pictures are nearly ten times as uncertain."""
    scene = scene_of_view(RunResult(made[1]), "top", TEXELS)
    light = [DistantLight(towards=(0.0, 0.0, 1.0))]
    once = uncertainty_of_picture(scene, light)
    wider = replace(scene, reflecting=replace(scene.reflecting, covariance=100 * scene.reflecting.covariance))  # type: ignore[union-attr]
    lit = scene.picture(light) > 0.0
    ratio = np.median(uncertainty_of_picture(wider, light)[lit] / once[lit])
    assert 8 < ratio <= 10.1


def test_a_job_that_was_stopped_goes_on_and_ends_alike(made: Made, tmp_path: Path) -> None:
    """Whatever the memory, and whoever does the work: the same bits."""
    _, out, _ = made
    copy = tmp_path / "result"
    shutil.copytree(out, copy)
    (copy / "texels/top.h5").unlink()
    (copy / "texels/side.h5.killed.part").write_bytes(b"half")
    kept = (copy / "texels/side.h5").read_bytes()
    add_texels(replace(request_of(made), memory_bytes=200_000), copy)
    assert (copy / "texels/side.h5").read_bytes() == kept
    assert not list(copy.rglob("*.part"))
    assert (copy / "texels/top.h5").read_bytes() == (out / "texels/top.h5").read_bytes()
    shutil.rmtree(copy / "texels")
    with cluster(tmp_path, 1) as (address, _):
        add_texels(request_of(made), copy, scheduler=address)
    for name in ("top.h5", "side.h5", "texels.json"):
        assert (copy / "texels" / name).read_bytes() == (out / "texels" / name).read_bytes()


def test_plain_materials_get_no_worse(glossy: Made) -> None:
    cell, out, _ = glossy
    about = add_texels(RunRequest((cell.run_folder,), None, records_named([RECORDS])), out)
    (other,) = set(about["mae"]) - {TEXELS}
    assert about["mae"][TEXELS] < 1.03 * about["mae"][other]
    assert about["held_out_psnr_db"][TEXELS] > about["held_out_psnr_db"][other] - 0.2


def test_both_errors_are_told(made: Made) -> None:
    ended = cells.here(
        "reflectance",
        made[0].run_folder,
        "--calibrations",
        made[0].folder / "records",
        "--out",
        made[1],
        "--texels",
        "auto",
    )
    assert ended.code == 0, ended.err
    said = " ".join((ended.out + ended.err).split())
    for mae in made[2]["texels"]["mae"].values():
        assert f"off by {100 * mae:.3f} % of range" in said


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--texels", "fine"), "--texels: expected auto"),
        (("--texels", "auto", "--uncalibrated"), "--texels: is for calibrated runs"),
    ],
)
def test_what_is_not_possible_is_refused(made: Made, tmp_path: Path, options: tuple[str, ...], told: str) -> None:
    ended = cells.here("reflectance", made[0].run_folder, "--out", tmp_path / "out", *options)
    assert ended.code == 2
    assert told in ended.err


def test_texels_of_other_settings_are_refused(made: Made, tmp_path: Path) -> None:
    copy = tmp_path / "result"
    shutil.copytree(made[1], copy)
    settings = json.loads((copy / "settings.json").read_text())
    (copy / "settings.json").write_text(json.dumps({**settings, "scan_noise_um": 31.0}))
    ended = cells.here(
        "reflectance", made[0].run_folder, "--calibrations", RECORDS, "--out", copy, "--texels", "auto"
    )
    assert ended.code == 2
    assert "other input" in ended.err


def test_without_texels_the_remedy_is_told(made: Made, tmp_path: Path) -> None:
    copy = tmp_path / "result"
    shutil.copytree(made[1], copy, ignore=shutil.ignore_patterns("texels"))
    for more in ((), ("--from", "0,-200,300")):
        ended = cells.here(
            "reflectance", "relight", copy, "--fit", TEXELS, "--led", "0", "--to", tmp_path / "p.npy", *more
        )
        assert ended.code == 2
        assert "--texels auto" in ended.err


def test_ablation_tells_what_fewer_leds_and_less_grazing_light_cost(made: Made, tmp_path: Path) -> None:
    """With all values, the error is that of pictures in the check, which are made in another way."""
    out, document = ablated(made, tmp_path, *FEWER)
    mae = {setting: dict(steps) for setting, steps in document["mae"].items()}
    whole, half = mae["share of the LEDs"][1.0], mae["share of the LEDs"][0.5]
    steep = mae["most incidence, degrees"][60]
    assert mae["most incidence, degrees"][89] == whole
    assert whole[TEXELS] == pytest.approx(made[2]["texels"]["mae"][TEXELS], rel=0.1)
    assert whole["ggx_normal"] == pytest.approx(made[2]["mae"]["ggx_normal"], rel=0.2)
    assert 1.5 < half[TEXELS] / whole[TEXELS] < 3.0
    assert 1.05 < half["ggx_normal"] / whole["ggx_normal"] < 1.5
    assert 1.08 < steep[TEXELS] / whole[TEXELS] < 1.5
    assert steep["ggx_normal"] > whole["ggx_normal"]
    shares = dict(document["share_with_material"]["share of the LEDs"])
    assert 0.99 < shares[1.0] <= 1.0
    assert 0.9 < shares[0.5] < shares[1.0]
    written = json.loads((out / "texel_ablation.json").read_text())
    assert written == {name: value for name, value in document.items() if name != "report"}
    page = (out / "texel_ablation.html").read_text()
    assert f"{100 * half[TEXELS]:.3f}" in page
    assert "Most incidence, degrees" in page


def test_every_second_led_is_one_of_those_that_are_not_left_out() -> None:
    assert list(leds_of(Variant(led_step=2), np.arange(10), [0, 5])) == [1, 3, 6, 8]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--texels",), "--texels: needs the frames; give the runs of the result"),
        (("RUN",), "are for --texels"),
        (("--calibrations", "RECORDS"), "are for --texels"),
        (("RUN", "--texels", "--calibrations", "SHIPPED"), "is a result of other runs, records or settings"),
    ],
)
def test_an_ablation_that_is_not_possible_is_refused(made: Made, options: tuple[str, ...], told: str) -> None:
    paths = {"RUN": made[0].run_folder, "RECORDS": made[0].folder / "records", "SHIPPED": RECORDS}
    ended = cells.here("reflectance", "ablate", made[1], *(paths.get(option, option) for option in options))
    assert ended.code == 2
    assert told in " ".join(ended.err.split())


def test_a_result_without_texels_cannot_be_ablated(made: Made, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(made[1], tmp_path / "result", ignore=shutil.ignore_patterns("texels")))
    ended = cells.here(
        "reflectance", "ablate", copy, made[0].run_folder, "--texels", "--calibrations", made[0].folder / "records"
    )
    assert ended.code == 2
    assert "has no texels" in ended.err
