"""`coupole reflectance RUN`: a glossy relief in the shipped cell, its material found with the shipped records."""

from __future__ import annotations

import json
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cells
import cv2
import h5py
import numpy as np
import OpenEXR
import pytest
import trimesh
from arms import KR10_R1100_SIXX
from cells import CellFolder
from dask_cluster import cluster
from lazily import lazily
from relief_cells import DIFFUSE, F0, RECORDS, ROUGHNESS, SIDE, shipped_cell, unit, walter
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from coupole.appearance.matter.alta_samples import read_alta
from coupole.calibration.light.frames import open_light_frames
from coupole.kinematics import forward
from coupole.reflectance import ggx
from coupole.reflectance.light_files import read_lights
from coupole.reflectance.new_light.light_kinds import DistantLight
from coupole.reflectance.new_light.shading import coats_of
from coupole.reflectance.normal_fit import fit_materials
from coupole.reflectance.picture_set import read_pictures
from coupole.reflectance.relit_uncertainty import uncertainty_of_picture
from coupole.reflectance.run_job import RunRequest, reflectance_of
from coupole.reflectance.run_relighting import materials_of, scene_of_view
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.sample_uncertainty import Places, Sources, bounds
from coupole.reflectance.triangle_fit import fit_triangles
from coupole.reflectance.uncalibrated import FILES, write_pictures

pycolmap: Any = lazily("pycolmap")

Made = tuple[CellFolder, Path, dict[str, Any]]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    material = {"diffuse": DIFFUSE, "f0": F0, "roughness": ROUGHNESS}
    cell = shipped_cell(tmp_path_factory.mktemp("cell"), material=material)
    assert cell.acquire().code == 0
    out = cell.folder / "result"
    ended = cells.here("reflectance", cell.run_folder, "--calibrations", RECORDS, "--out", out, "--json")
    assert ended.code == 0, ended.err
    return cell, out, ended.document


@pytest.mark.parametrize("view", ["top", "side"])
def test_samples_are_the_reflectance_that_was_there(made: Made, view: str) -> None:
    _, out, _ = made
    with h5py.File(out / "samples" / f"{view}.h5") as file:
        f, u_own = file["f"][()], file["u_own"][()]
        whole = np.sqrt(u_own**2 + file["led_u_own"][()] ** 2 + file["led_u_shared"][()] ** 2)
        centres, normals = file["centres_mm"][()], file["normals"][()]
        light = unit(file["led_positions_mm"][()] - centres[:, None])
        towards = unit(file["camera_mm"][()] - centres)[:, None]
    truth = walter(normals[:, None], light, towards)
    known = np.isfinite(f)
    assert known.sum() > 100_000
    ratio = np.where(known, f / truth, np.nan)
    np.testing.assert_allclose(np.nanmedian(ratio, axis=(0, 1)), 1.0, atol=0.01)
    incidence = np.broadcast_to(np.einsum("nlk,nk->nl", light, normals)[..., None], f.shape)
    for low, high in ((0.0, 0.5), (0.5, 0.87), (0.87, 1.0)):
        mine = known & (incidence > low) & (incidence <= high)
        within = np.abs(ratio - 1)[mine] < 1.96 * whole[mine]
        assert 0.9 < within.mean() < 0.99, (low, high, within.mean())


def test_the_material_is_found_and_makes_the_pictures_under_leds_kept_for_the_check(made: Made) -> None:
    _, out, document = made
    with h5py.File(out / "fits/ggx_normal.h5") as file:
        kd, alpha, ks = (file[name][()] for name in ("kd", "alpha", "ks"))
    np.testing.assert_allclose(np.nanmedian(kd, axis=0) * np.pi, DIFFUSE, rtol=0.05)
    np.testing.assert_allclose(np.nanmedian(alpha), ROUGHNESS, rtol=0.15)
    np.testing.assert_allclose(np.nanmedian(ks, axis=0), F0, rtol=0.25)
    assert len(document["left_out"]) == 4
    assert document["simulated"]
    assert set(document["mae"]) == {"ggx", "ggx_normal", "sh", "rbf", "ggx_rbf"}
    for name in ("ggx", "ggx_normal", "ggx_rbf"):
        assert document["mae"][name] < 0.008  # of range; the noise of some four pixels is 0.005
        assert document["held_out_psnr_db"][name] > 35
    for name in ("sh", "rbf"):  # 41 LEDs for 100 coefficients
        assert document["mae"][name] < 0.03


def test_stated_intervals_hold_the_material(made: Made) -> None:
    """All parts together, and without what all triangles share: as they lie around their own middle."""
    _, out, document = made
    with h5py.File(out / "fits/ggx_normal.h5") as file:
        kd, u_kd, u_triangle, u_shared = (file[name][()] for name in ("kd", "u_kd", "u_triangle", "u_shared"))
    off = np.log(np.maximum(kd, 1e-9) * np.pi / DIFFUSE)
    alone = np.hypot(u_kd, u_triangle[:, None])
    known = np.isfinite(alone).all(axis=1)
    assert (np.abs(off) < 1.96 * np.hypot(alone, u_shared))[known].mean() > 0.95
    around = np.abs(off - np.nanmedian(off, axis=0)) < 1.96 * alone
    assert 0.9 < around[known].mean() <= 1.0
    assert 0.9 < document["held_out_inside"]["ggx_normal"] < 0.99
    assert document["held_out_inside"]["ggx"] > 0.9
    assert (
        document["material_uncertainty"]["ggx"]["normal_deg"]
        > document["material_uncertainty"]["ggx_normal"]["normal_deg"]
    )


def test_pictures_for_the_check_are_the_frames_and_fits_miss_little_more_than_noise(made: Made) -> None:
    """Read from the run itself: one pixel of each channel of a block, dark and fall-off taken out."""
    cell, out, document = made
    with h5py.File(out / "samples/frames/top.h5") as file:
        share, leds = file["share"][()].astype(float), file["leds"][()]
    with h5py.File(cell.run_folder / "views/top.h5") as file:
        detector = file["entry/instrument/detector"]
        data, led = detector["data"][()].astype(float), detector["frames"]["led"]
        pattern = detector["bayer_pattern"][()].decode()
    with h5py.File(RECORDS / "flat-field.h5") as file:
        over = file["g"][()] * file["pixel_response"][()] * 4031.0  # range of the camera, by its response record
    raw = (data[led == leds[0]][0] - data[led == 65535].mean(axis=0)) / over
    for channel, letter in enumerate("RGB"):
        row, column = divmod(pattern.index(letter), 2)
        mine = share[0, ..., channel]
        off = (raw[row::2, column::2] - mine)[np.isfinite(mine)]
        assert len(off) > 1000
        assert abs(np.median(off)) < 5e-4
        assert np.abs(off).max() < 0.01
    assert leds.tolist() == document["left_out"]
    noise = document["mae_of_noise"]
    assert noise < document["mae"]["ggx_normal"] < 1.5 * noise
    assert document["mae_of_triangles"]["ggx_normal"] < document["mae"]["ggx_normal"]


def test_without_calibrations_pixels_have_normals_by_nominal_lights(made: Made, tmp_path: Path) -> None:
    cell, out, _ = made
    write_pictures(cell.run_folder, "side", tmp_path, lambda step, done, of: None)
    lights, intensities, mask = (tmp_path / name for name in FILES)
    pictures = read_pictures(tmp_path, lights, intensities=intensities, mask=mask)
    every = np.stack([pictures.raw_values(number)[::27, 1] for number in range(len(pictures))], axis=1) / 65535
    values = every / pictures.intensities[:, 1]
    found = np.full((*pictures.mask.shape, 3), np.nan)
    rows, columns = (places[::27] for places in np.nonzero(pictures.mask))
    found[rows, columns] = fit_materials(values, pictures.directions, np.array([0.0, 0.0, 1.0])).normals
    with h5py.File(out / "samples/side.h5") as file:
        seen, normals = file["seen"][()][::2, ::2], file["normals"][()]
    frame = next(one for one in open_light_frames([cell.run_folder]).lit if one.view == "side")
    truth = normals[seen] @ frame.base_from_camera[:3, :3] * (1, -1, -1)
    known = (seen >= 0) & np.isfinite(found).all(axis=2)
    assert known.sum() > 150
    off = np.degrees(np.arccos(np.clip(np.sum(found * truth, axis=2)[known], -1, 1)))
    assert np.median(off) < 5.0, np.median(off)  # lights near by are taken as far away


def test_pictures_for_rti_show_the_object_under_the_lights_that_their_file_names(
    made: Made, tmp_path: Path
) -> None:
    """Read as other programs do: by name, direction, and sRGB. Lambert's normals are near the mesh's."""
    cell, out, _ = made
    ended = cells.here("export", cell.run_folder, "--to", "lp", "--views", "top", "--out", tmp_path)
    assert ended.code == 0, ended.err
    again = cells.here("export", cell.run_folder, "--to", "lp", "--views", "top", "--out", tmp_path)
    assert again.code == 2
    assert "top.lp: exists already" in again.err
    count, *lines = (tmp_path / "top/top.lp").read_text().splitlines()
    assert int(count) == len(lines) == 45
    ways = np.array([line.split()[1:] for line in lines], float)
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 1.0, atol=1e-5)
    codes = np.stack([cv2.imread(str(tmp_path / "top" / line.split()[0]))[::9, ::9, 1] for line in lines]) / 255.0
    linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    dome = json.loads((tmp_path / "top/top.dome").read_text())
    places = np.array([[place[axis] for axis in "xyz"] for place in dome["positions3d"]])
    alone = cells.here("export", cell.run_folder, "--to", "dome", "--views", "top", "--out", tmp_path / "dome")
    assert alone.code == 0, alone.err
    assert json.loads((tmp_path / "dome/top.dome").read_text()) == dome
    np.testing.assert_allclose(unit(read_lights(tmp_path / "dome/top.dome").directions), ways, atol=1e-5)
    np.testing.assert_allclose(unit(places), ways, atol=1e-5)
    web = cells.here("export", cell.run_folder, "--to", "relight", "--views", "top", "--out", tmp_path, "--json")
    assert web.code == 0, web.err
    info = json.loads((tmp_path / "top/info.json").read_text())
    np.testing.assert_allclose(np.reshape(info["lights"], (-1, 3)), ways, atol=1e-5)
    assert info["width"] * info["pixelSizeInMM"] == pytest.approx(dome["imageWidth"])
    assert "simulated" in info["origin"]
    assert web.document["misses_dn"]["top"] < 15.0
    assert not list(tmp_path.glob(".pictures-*"))
    lens = cell.rig_data["lens"]
    image_mm = 1 / (1 / lens["focal_length_mm"] - 1 / lens["focus_distance_mm"])  # thin lens
    assert dome["imageWidth"] == pytest.approx(512 * 44e-3 * lens["focus_distance_mm"] / image_mm)
    falling = (np.linalg.norm(places, axis=1) / 1000) ** 2
    order = np.sort(linear, axis=0)
    low, high = order[len(ways) // 3], order[-2]  # neither shadows nor highlights
    with h5py.File(out / "samples/top.h5") as file:
        seen, normals = file["seen"][()][::18, ::18], file["normals"][()]
    frame = next(one for one in open_light_frames([cell.run_folder]).lit if one.view == "top")
    truth = normals @ frame.base_from_camera[:3, :3] * (1, -1, -1)
    off = []
    for row, column in zip(*np.nonzero(seen >= 0), strict=True):
        value = linear[:, row, column] * falling
        used = (linear[:, row, column] > max(low[row, column], 0.02)) & (
            linear[:, row, column] < high[row, column]
        )
        normal = unit(np.linalg.lstsq(ways[used], value[used], rcond=None)[0])
        off.append(np.degrees(np.arccos(np.clip(normal @ truth[seen[row, column]], -1, 1))))
    assert len(off) > 50
    assert np.median(off) < 8.0


@pytest.mark.full
def test_without_calibrations_values_are_relative_and_it_is_said(made: Made, tmp_path: Path) -> None:
    cell, _, _ = made
    words = ("reflectance", cell.run_folder, "--uncalibrated", "--view", "side", "--out", tmp_path / "plain")
    ended = cells.here(*words, "--json")
    assert ended.code == 0, ended.err
    assert ended.document["uncalibrated_run"] == cell.run_folder.name
    assert ended.document["simulated"] is True
    assert "values are relative" in (tmp_path / "plain/report.html").read_text()


def test_runs_of_one_object_are_fitted_together(made: Made, tmp_path: Path) -> None:
    first, _, alone = made
    material = {"diffuse": DIFFUSE, "f0": F0, "roughness": ROUGHNESS}
    second = shipped_cell(tmp_path, material=material)
    third = {**SIDE, "name": "third", "azimuth_deg": -120}
    second.write(views=[third], lights={"kind": "every", "every": 60})
    assert second.acquire().code == 0
    runs, out = (first.run_folder, second.run_folder), tmp_path / "result"
    ended = cells.here("reflectance", "extract", *runs, "--calibrations", RECORDS, "--out", out, "--json")
    assert ended.code == 0, ended.err
    names = {path.stem for path in (out / "samples").glob("*.h5")}
    assert names == {f"{runs[0].name}-top", f"{runs[0].name}-side", f"{runs[1].name}-third"}
    result = RunResult(out)
    assert len(result.triangles) > alone["triangles"]
    block = slice(2000, 2200)
    samples = result.samples(block)
    assert len(samples.led_mm) == 45 + 45 + 18
    fitted = fit_triangles(samples, np.ones(108, bool), 30.0)
    np.testing.assert_allclose(np.nanmedian(fitted.kd, axis=0) * np.pi, DIFFUSE, rtol=0.05)
    np.testing.assert_allclose(np.nanmedian(fitted.alpha), ROUGHNESS, rtol=0.15)
    second.plan_data["object"]["support_from_object"] = {"translation_mm": [1.0, 0, 0]}
    second.write()
    moved = second.acquire()
    assert moved.code == 0
    ended = cells.here(
        "reflectance", runs[0], moved.document["run"], "--calibrations", RECORDS, "--out", tmp_path / "b"
    )
    assert ended.code == 2
    assert "shows another object, or in another place" in ended.err


def test_a_mesh_whose_normals_are_off_is_mended(made: Made, tmp_path: Path) -> None:
    cell, out, _ = made
    mesh = trimesh.load(cell.plan_data["object"]["mesh"], process=False)
    mesh.vertices += np.random.default_rng(3).normal(0, 0.03, mesh.vertices.shape)
    noisy = tmp_path / "noisy.ply"
    mesh.export(noisy)
    options = ("--calibrations", RECORDS, "--mesh", noisy, "--out", tmp_path / "result", "--json")
    ended = cells.here("reflectance", cell.run_folder, *options)
    assert ended.code == 0, ended.err
    off = {}
    with h5py.File(out / "fits/ggx.h5") as file:
        triangles, truth = file["triangles"][()], file["normals"][()]
    for name in ("ggx", "ggx_normal"):
        with h5py.File(tmp_path / "result" / f"fits/{name}.h5") as file:
            _, at, here = np.intersect1d(triangles, file["triangles"][()], return_indices=True)
            cosine = np.sum(file["normals"][()][here] * truth[at], axis=1)
        off[name] = float(np.nanmedian(np.degrees(np.arccos(np.clip(cosine, -1, 1)))))
    assert off["ggx"] > 0.8
    assert off["ggx_normal"] < 0.5 * off["ggx"], off
    # its samples are wrong by their cosines, and their intervals say so
    ratio, places, sources = noisy_samples(tmp_path / "result", out)
    low, high = bounds(places, sources, 1.959964)
    assert 0.93 < np.mean((ratio > low) & (ratio < high)) < 0.97
    low, high = bounds(places, sources.without("vertex_um"), 1.959964)
    assert np.mean((ratio > low) & (ratio < high)) < 0.8
    told = ended.document["uncertainty_percent"]
    interval = ended.document["median_interval_percent"]
    assert told["interval"]["median"] == [interval["low"], interval["high"]]
    widest = min(told["without"], key=lambda name: told["without"][name]["median"][1])
    assert widest == "vertices of the mesh"
    np.testing.assert_allclose(told["closed_form"]["median"], told["monte_carlo"]["median"], rtol=0.1)


def noisy_samples(noisy: Path, clean: Path) -> tuple[np.ndarray, Places, Sources]:
    """Of the top view's green samples: the true reflectance over that with a noisy mesh; where; what is known."""
    with h5py.File(clean / "samples/top.h5") as file:
        numbers, truths = file["triangles"][()], file["normals"][()]
    with h5py.File(noisy / "samples/top.h5") as file:
        _, at, here = np.intersect1d(numbers, file["triangles"][()], return_indices=True)
        f, u_own = file["f"][()][here][..., 1], file["u_own"][()][here][..., 1]
        leds, axes, triangles = file["led_positions_mm"][()], file["led_normals"][()], file["triangles"][()][here]
        u_response = file["u_response"][()][here][:, 1]
        u_led, u_leds = file["led_u_own"][:, 1], file["led_u_shared"][:, 1]
        centres, camera, led_mm = file["centres_mm"][()][here], file["camera_mm"][()], file.attrs["led_u_mm"]
    triangle, led = np.nonzero(np.isfinite(f))
    triangle, led = triangle[::37], led[::37]
    light, towards = unit(leds[led] - centres[triangle]), unit(camera - centres[triangle])
    truth = walter(truths[at][triangle], light, towards)[..., 1]
    with h5py.File(noisy / "object.h5") as file:
        corners = file["corners_mm"][()].astype(float)[triangles[triangle]]
    same = np.ones(len(led))
    noise, own = u_own[triangle, led].astype(float), u_response[triangle]
    sources = Sources(noise, own, 0 * same, 0 * same, u_led[led], u_leds[led], 30.0 * same, led_mm * same)
    return truth / f[triangle, led], Places(corners, leds[led], axes[led]), sources


def test_a_job_that_was_stopped_goes_on_and_another_is_refused(made: Made) -> None:
    cell, out, document = made
    (out / "fits/ggx_rbf/side.h5").unlink()
    ended = cells.here("reflectance", "check", out)
    assert ended.code == 2
    assert "`coupole reflectance fit" in ended.err
    before = {path: path.stat().st_mtime_ns for path in (out / "samples").iterdir()}
    again = ("reflectance", cell.run_folder, "--calibrations", RECORDS, "--out", out, "--json")
    ended = cells.here(*again)
    assert ended.code == 0, ended.err
    assert {path: path.stat().st_mtime_ns for path in (out / "samples").iterdir()} == before
    assert ended.document["mae"] == document["mae"]
    other = cells.here(*again, "--leave-out", "24,48")
    assert other.code == 2
    assert "name another folder" in other.err
    assert "normals of the mesh" in (out / "report.html").read_text()


def same_datasets(one: Path, other: Path) -> None:
    """Every HDF5 file of both folders, to the bit."""
    names = {str(path.relative_to(one)) for path in one.rglob("*.h5")}
    assert {str(path.relative_to(other)) for path in other.rglob("*.h5")} == names
    for name in names:
        with h5py.File(one / name) as mine, h5py.File(other / name) as its:
            assert set(mine) == set(its)
            for key in mine:
                assert mine[key][()].tobytes() == its[key][()].tobytes(), (name, key)


@pytest.mark.full
def test_two_workers_of_which_one_is_killed_give_the_same_result(made: Made, tmp_path: Path) -> None:
    """To the bit: killed while it extracts, when it may have begun a file, and another one while it fits."""
    cell, alone, document = made
    out = tmp_path / "result"
    with cluster(tmp_path, 3) as (address, workers), ThreadPoolExecutor(1) as pool:
        request = RunRequest((cell.run_folder,), calibrations=tuple(sorted(RECORDS.glob("*.yaml"))))
        job = pool.submit(reflectance_of, request, out, scheduler=address)
        for worker, sign in zip(workers, ("samples/*.part", "fits/*.h5"), strict=False):
            while not list(out.glob(sign)):
                assert not job.done(), job.result()
                time.sleep(0.01)
            worker.kill()
        about = job.result()
    assert about["mae"] == document["mae"]
    same_datasets(alone, out)
    assert not list(out.rglob("*.part"))


def test_ablation_tells_what_fewer_leds_angles_and_coefficients_cost(made: Made) -> None:
    _, out, document = made
    ended = cells.here("reflectance", "ablate", out, "--json")
    assert ended.code == 0, ended.err
    mae = {setting: dict(steps) for setting, steps in ended.document["mae"].items()}
    for whole in (mae["share of the LEDs"][1.0], mae["most incidence, degrees"][89], mae["coefficients"][100]):
        assert whole == mae["coefficients"][100]
        for name, value in whole.items():
            assert value == pytest.approx(document["mae_of_triangles"][name], rel=0.25), name
    assert set(mae["share of the LEDs"][0.125].values()) == {None}  # 5 of 41 LEDs are too few
    assert set(mae["most incidence, degrees"][60].values()) == {None}
    few, many = mae["coefficients"][16], mae["coefficients"][100]
    assert {name: few[name] == many[name] for name in few} == {
        "ggx": True, "ggx_normal": True, "sh": False, "rbf": False, "ggx_rbf": False
    }  # fmt: skip
    assert "share of the LEDs" in (out / "ablation.html").read_text()


def test_runs_without_what_is_needed_are_refused_with_the_remedy(made: Made, tmp_path: Path) -> None:
    cell, _, _ = made

    def refused(*arguments: str | Path) -> str:
        ended = cells.here("reflectance", *arguments, "--out", tmp_path / "none")
        assert ended.code == 2
        return " ".join(ended.err.split())

    assert "no calibration record of the kind hand-eye, leds, led-power" in refused(cell.run_folder)
    assert "expected runs, or --pictures" in refused()
    uncalibrated = (cell.run_folder, "--uncalibrated")
    assert "no --calibrations" in refused(*uncalibrated, "--calibrations", RECORDS)
    assert "expected one of" in refused(*uncalibrated, "--view", "none")
    few = [word for kind in ("hand-eye", "leds") for word in ("--calibrations", RECORDS / f"{kind}.yaml")]
    assert "kind led-power is named" in refused(cell.run_folder, *few)
    records = ("--calibrations", RECORDS)
    assert "there is no" in refused(cell.run_folder, *records, "--mesh", tmp_path / "nothing.ply")
    assert "no frame under LED 1 in these runs" in refused(cell.run_folder, *records, "--leave-out", "1")
    assert "--memory" in refused(cell.run_folder, *records, "--memory", "much")
    assert not (tmp_path / "none").exists()
    elsewhere = trimesh.creation.box(bounds=[[4e3, 0, 0], [4.1e3, 10, 10]])
    elsewhere.export(tmp_path / "elsewhere.ply")
    assert "shows the mesh" in refused(cell.run_folder, *records, "--mesh", tmp_path / "elsewhere.ply")


def test_records_of_another_camera_are_refused(made: Made, tmp_path: Path) -> None:
    cell = CellFolder(tmp_path, speed=10.0)
    cell.write(lights={"kind": "every", "every": 360})
    assert cell.acquire().code == 0
    ended = cells.here("reflectance", cell.run_folder, "--calibrations", RECORDS, "--out", tmp_path / "result")
    assert ended.code == 2
    assert "frames of 512 x 384 pixels" in " ".join(ended.err.split())


def test_a_frame_that_is_not_the_one_that_was_proven_is_refused(made: Made, tmp_path: Path) -> None:
    cell, _, _ = made
    run = shutil.copytree(cell.run_folder, tmp_path / "run")
    with h5py.File(run / "views/top.h5", "r+") as file:
        data = file["entry/instrument/detector/data"]
        led = int(np.flatnonzero(file["entry/instrument/detector/frames"]["led"] == 480)[0])
        data[led, 100, 100] ^= 1
    ended = cells.here("reflectance", run, "--calibrations", RECORDS, "--out", tmp_path / "result")
    assert ended.code == 6
    assert "top/led0480/e0 is not what was proven" in " ".join(ended.err.split())
    assert not list((tmp_path / "result/samples").glob("top*"))


@pytest.mark.parametrize("view", ["top", "side"])
def test_under_an_led_kept_for_the_check_a_view_looks_as_it_was_photographed(made: Made, view: str) -> None:
    """In shares of the camera's range, pixel by pixel of the frame itself."""
    cell, out, document = made
    led, to = document["left_out"][1], out / "led.npy"
    with h5py.File(cell.run_folder / f"views/{view}.h5") as file:
        number = int(np.flatnonzero(file["entry/instrument/detector/frames"]["led"] == led)[0])
        raw = file["entry/instrument/detector/data"][number].astype(float)
    with h5py.File(RECORDS / "flat-field.h5") as file:
        share = (raw - cells.BLACK_DN) / (4095 - cells.BLACK_DN) / file["g"][()]
    for fit in ("ggx_normal", "ggx_rbf"):
        options = ("--led", led, "--view", view, "--fit", fit, "--to", to)
        ended = cells.here("reflectance", "relight", out, *map(str, options))
        assert ended.code == 0, ended.err
        picture = np.load(to)
        for channel, row, column in ((1, 0, 0), (2, 0, 1), (0, 1, 0)):  # GBRG
            relit, taken = picture[row::2, column::2, channel], share[row::2, column::2]
            seen = relit > 0.05
            assert seen.mean() > 0.05
            assert np.median(taken[seen] / relit[seen]) == pytest.approx(1.0, abs=0.015)
            assert np.abs(relit - taken)[seen].mean() < 0.009  # of range; noise of one pixel is 0.006


def test_slices_show_an_environment_as_materials_do(made: Made) -> None:
    out = made[1]
    OpenEXR.File({}, {"RGB": np.ones((8, 16, 3), np.float32)}).write(str(out / "white.exr"))
    pictures = []
    for fit in ("ggx_normal", "ggx_rbf"):
        options = ("--environment", out / "white.exr", "--fit", fit, "--samples", 24, "--to", out / "white.npy")
        ended = cells.here("reflectance", "relight", out, *map(str, options))
        assert ended.code == 0, ended.err
        pictures.append(np.load(out / "white.npy"))
    seen = (pictures[0] > 0) & (pictures[1] > 0)
    assert seen.mean() > 0.1
    assert np.median(pictures[1][seen] / pictures[0][seen]) == pytest.approx(1.0, abs=0.03)


def test_a_view_is_relit_with_its_shadows(made: Made) -> None:
    """From a direction in which no LED stands; the light's frame is the support's, whose z is the base's -z."""
    out = made[1]
    to = out / "relit.npy"
    ended = cells.here("reflectance", "relight", out, "--direction", "0.6,0.3,1", "--view", "side", "--to", to)
    assert ended.code == 0, ended.err
    best = min(made[2]["mae"], key=made[2]["mae"].__getitem__)
    by_name = out / "named.npy"
    for name, same in ((best, True), ("sh", False)):
        arguments = ("--direction", "0.6,0.3,1", "--view", "side", "--fit", name, "--to", by_name)
        assert cells.here("reflectance", "relight", out, *arguments).code == 0
        assert np.array_equal(np.load(by_name), np.load(to)) is same
    picture = np.load(to)
    with h5py.File(out / "samples/side.h5") as file:
        seen, normals, centres = file["seen"][()], file["normals"][()], file["centres_mm"][()]
        camera = file["camera_mm"][()]
    with h5py.File(out / "fits/ggx.h5") as file:
        known = np.isfinite(file["alpha"][()])
        known = known[np.searchsorted(file["triangles"][()], h5py.File(out / "samples/side.h5")["triangles"][()])]
    towards = unit(np.array([0.6, -0.3, -1.0]))
    cosine = normals @ towards
    truth = np.pi * walter(normals, towards[None], unit(camera - centres)) * cosine[:, None]
    shown, wanted = picture[seen >= 0], truth[seen[seen >= 0]]
    lit = (shown[:, 1] > 0) & (cosine[seen[seen >= 0]] > 0.2)
    assert lit.mean() > 0.5
    np.testing.assert_allclose(np.median(shown[lit] / wanted[lit], axis=0), 1.0, atol=0.02)
    shadowed = (shown[:, 1] == 0) & (cosine[seen[seen >= 0]] > 0.2) & known[seen[seen >= 0]]
    assert shadowed.mean() > 0.02
    assert (picture[seen < 0] == 0).all()
    wrong = cells.here("reflectance", "relight", out, "--direction", "0,0,1", "--view", "none", "--to", to)
    assert wrong.code == 2
    assert "expected one of side, top" in wrong.err
    wrong = cells.here("reflectance", "relight", out, "--direction", "0,0,1", "--fit", "none", "--to", to)
    assert wrong.code == 2
    assert "expected one of ggx, ggx_normal, sh, rbf, ggx_rbf, clusters, harmonics" in " ".join(wrong.err.split())


def test_a_relit_picture_holds_the_truth_within_its_uncertainty(made: Made, tmp_path: Path) -> None:
    """In a direction in which no LED stands; for the truth, Walter's formula at the triangles' centres."""
    out = made[1]
    to, u_to = tmp_path / "relit.npy", tmp_path / "u.npy"
    words = ("reflectance", "relight", out, "--direction", "0.6,0.3,1", "--view", "side", "--fit", "ggx_normal")
    ended = cells.here(*words, "--to", to, "--uncertainty", u_to, "--json")
    assert ended.code == 0, ended.err
    assert ended.document["uncertainty"] == str(u_to)
    picture, u = np.load(to), np.load(u_to)
    with h5py.File(out / "samples/side.h5") as file:
        seen, normals, centres = file["seen"][()], file["normals"][()], file["centres_mm"][()]
        camera = file["camera_mm"][()]
    towards = unit(np.array([0.6, -0.3, -1.0]))
    cosine = normals @ towards
    truth = np.pi * walter(normals, towards[None], unit(camera - centres)) * cosine[:, None]
    lit = (picture[..., 1] > 0) & (cosine[seen] > 0.2) & (seen >= 0)
    assert lit.sum() > 1000
    off = (picture[lit] - truth[seen[lit]]) / u[lit]
    assert 0.9 < np.mean(np.abs(off) < 1.96) <= 1.0
    assert np.median(u[lit] / picture[lit]) < 0.02
    assert (u[seen < 0] == 0).all()


def test_uncertainty_of_a_relit_picture_is_the_spread_of_pictures_of_drawn_materials(made: Made) -> None:
    scene = scene_of_view(RunResult(made[1]), "top", "ggx_normal")
    lights = [DistantLight(towards=(0.2, 0.5, 1.0))]
    u = uncertainty_of_picture(scene, lights)
    places = np.searchsorted(scene.result.triangles, scene.surface.triangles)
    covariance = scene.result.material_covariances("ggx_normal", places)
    own = materials_of(scene.result, "ggx_normal", scene.surface)
    with h5py.File(made[1] / "fits/ggx_normal.h5") as file:
        widths = [file[name][()][places] for name in ("u_kd", "u_ks")]
        common = np.hypot(file["u_triangle"][()][places], file["u_shared"][()])[scene.surface.triangle_of_pixel]
    known = np.isfinite(covariance).all(axis=(1, 2))
    generator, pictures = np.random.default_rng(3), []
    roots, shorter = np.linalg.cholesky(covariance[known]), 0.25  # drawn at a quarter, where pictures are linear
    tangents = np.array([ggx.tangents.py_func(*normal) for normal in own.normals])
    for _ in range(60):
        drawn = np.zeros((len(known), 5))
        drawn[known] = shorter * np.einsum("nij,nj->ni", roots, generator.normal(size=(known.sum(), 5)))
        by_sigma = drawn[:, 2:4] / np.sqrt(np.einsum("nii->ni", covariance)[:, 2:4])
        normals = own.normals + np.einsum("nk,nkj->nj", drawn[:, :2], tangents)
        moved = replace(
            own,
            normals=unit(normals),
            kd=own.kd * (1 + widths[0] * by_sigma[:, :1]),
            ks=own.ks * (1 + widths[1] * by_sigma[:, 1:]),
            alpha=own.alpha * np.exp(drawn[:, 4]),
        )
        pictures.append(replace(scene, reflecting=coats_of(moved)).picture(lights))
    spread = np.std(pictures, axis=0) / shorter
    shown = (np.mean(pictures, axis=0) > 0.02) & np.isfinite(u)
    assert shown.sum() > 3000
    stated = np.sqrt(u**2 - (common[..., None] * np.mean(pictures, axis=0)) ** 2)
    assert np.median(spread[shown] / stated[shown]) == pytest.approx(1.0, abs=0.05)
    assert np.quantile(spread[shown] / stated[shown], 0.05) > 0.8
    assert np.quantile(spread[shown] / stated[shown], 0.95) < 1.4  # of sixty draws


@pytest.mark.parametrize(
    ("words", "why"),
    [(("--fit", "sh"), "sh has none; choose --fit ggx or ggx_normal"), (("--turn", "4"), "not to a video")],
)
def test_uncertainty_that_cannot_be_stated_is_refused(
    made: Made, tmp_path: Path, words: tuple[str, ...], why: str
) -> None:
    to = tmp_path / ("relit.mp4" if "--turn" in words else "relit.npy")
    options = ("--direction", "0,0,1", "--to", to, "--uncertainty", tmp_path / "u.npy", *words)
    ended = cells.here("reflectance", "relight", made[1], *options)
    assert ended.code == 2
    assert why in " ".join(ended.err.split())
    assert not (tmp_path / "u.npy").exists()


def test_samples_are_exported_with_bounds_that_hold_the_truth(made: Made, tmp_path: Path) -> None:
    """Read as ALTA has it: from theta_l and the projected theta_v alone the material's formula gives f."""
    _, out, _ = made
    with h5py.File(out / "samples/top.h5") as file:
        many = np.isfinite(file["f"][()]).all(axis=2).sum(axis=1)
        chosen = file["triangles"][()][np.argsort(many)[-20::4]]
    options = [word for number in chosen for word in ("--triangle", str(number))]
    ended = cells.here("export", out, "--to", "alta", *options, "--out", tmp_path)
    assert ended.code == 0, ended.err
    inside = []
    for path in sorted(tmp_path.glob("*_green.alta")):
        head = [line for line in path.read_text().splitlines() if line.startswith("#")]
        assert {"#DIM 3 1", "#VS 2", "#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI"} <= set(head)
        theta_l, x, y, f, low, high = np.loadtxt(path).T
        theta_v, dphi = np.hypot(x, y), np.arctan2(y, x)
        light = np.stack([np.sin(theta_l), np.zeros(len(f)), np.cos(theta_l)], axis=1)
        view = np.stack([np.sin(theta_v) * np.cos(dphi), np.sin(theta_v) * np.sin(dphi), np.cos(theta_v)], axis=1)
        truth = walter(np.array([[0.0, 0.0, 1.0]]), light, view)[:, 1]
        inside += ((low < truth) & (truth < high)).tolist()
        assert np.median(f / truth) == pytest.approx(1.0, abs=0.03)
        back = read_alta(path)
        np.testing.assert_allclose(back.directions(), [light, view], atol=1e-12)
        np.testing.assert_array_equal([back.values[:, 0], back.low[:, 0]], [f, low])
        np.testing.assert_array_equal(back.high[:, 0], np.where(high > 3e38, np.inf, high))
    assert len(inside) > 300
    assert np.mean(inside) > 0.9


def test_samples_as_the_bird_project_has_them_hold_the_truth(made: Made, tmp_path: Path) -> None:
    """By its angles of zenith and azimuth the material's formula gives BRDF, within uBRDF as often as it says."""
    _, out, _ = made
    with h5py.File(out / "samples/top.h5") as file:
        many = np.isfinite(file["f"][()]).all(axis=2).sum(axis=1)
        chosen = file["triangles"][()][np.argsort(many)[-20::4]]
    options = [word for number in chosen for word in ("--triangle", str(number))]
    assert cells.here("export", out, "--to", "bird", *options, "--out", tmp_path).code == 0
    inside = []
    for path in sorted(tmp_path.glob("*_green.brdf")):
        document = json.loads(path.read_text())
        assert document["metadata"]["type"] == "BRDF"
        assert document["metadata"]["method"] == "simulation"
        data = document["data"]
        columns = {name: np.array(data[name]["values"]) for name in data}
        assert {one["unit"] for name, one in data.items() if "BRDF" not in name} == {"deg"}
        assert data["BRDF"]["unit"] == data["uBRDF"]["unit"] == "1/sr"
        assert len({len(column) for column in columns.values()}) == 1
        assert 0 <= columns["phi_i"].min() < columns["phi_i"].max() < 360

        def ways(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
            return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)

        light, view = (
            ways(np.radians(columns[f"theta_{end}"]), np.radians(columns[f"phi_{end}"])) for end in "ir"
        )
        truth = walter(np.array([[0.0, 0.0, 1.0]]), light, view)[:, 1]
        inside += (np.abs(columns["BRDF"] - truth) < columns["uBRDF"]).tolist()
        assert np.median(columns["BRDF"] / truth) == pytest.approx(1.0, abs=0.03)
        assert 0.01 < np.median(columns["uBRDF"] / truth) < 0.2
    assert len(inside) > 300
    assert np.mean(inside) > 0.6  # the mesh is exact here, which a scan's would not be


def test_clusters_are_a_few_materials_for_all_and_fill_what_has_too_few_samples(made: Made) -> None:
    _, out, document = made
    to = out / "clustered.npy"
    relight = ("reflectance", "relight", out, "--direction", "0.3,0.2,1", "--to", to)
    none = cells.here(*relight, "--fit", "clusters")
    assert none.code == 2
    assert "`coupole reflectance cluster" in none.err
    many = cells.here("reflectance", "cluster", out, "--clusters", "1000000")
    assert many.code == 2
    assert f"expected at most {document['triangles'] - document['not_fitted']}" in " ".join(many.err.split())
    wrong = cells.here("reflectance", "cluster", out, "--without-view", "none")
    assert wrong.code == 2
    assert "expected one of side, top" in " ".join(wrong.err.split())
    ended = cells.here("reflectance", "cluster", out, "--json")
    assert ended.code == 0, ended.err
    told = ended.document
    assert told["harmonics"] == 220
    assert told["mae"]["harmonics"] < 1.3 * told["mae"]["clustered"]
    assert 16 <= told["clusters"] <= 40
    assert 0 < told["borrowed"] <= document["not_fitted"]
    assert told["triangles"] + told["without"] == document["triangles"]
    assert told["mae_ratio"] < 1.3
    assert told["mae"]["borrowed"] < 2 * told["mae"]["own"]
    with h5py.File(out / "fits/clusters.h5") as file:
        cluster, borrowed, alpha = file["cluster"][()], file["borrowed"][()], file["alpha"][()]
        np.testing.assert_allclose(np.median(file["kd"][()], axis=0) * np.pi, DIFFUSE, rtol=0.05)
        assert file["harmonics"].shape == (told["clusters"], 220, 3)
        assert file["members"][()].sum() == (cluster >= 0).sum() - borrowed.sum()
    with h5py.File(out / "fits/ggx_normal.h5") as file:
        assert not np.isfinite(file["alpha"][()][borrowed]).any()
    assert cluster.max() == len(alpha) - 1
    assert cells.here(*relight, "--fit", "clusters").code == 0
    filled = np.load(to)
    assert cells.here(*relight, "--fit", "harmonics").code == 0
    by_harmonics = np.load(to)
    both = (by_harmonics > 0.1) & (filled > 0.1)
    assert both.mean() > 0.05
    assert np.median(np.abs(by_harmonics / np.where(both, filled, 1.0) - 1)[both]) < 0.05
    assert cells.here(*relight, "--fit", "ggx_normal").code == 0
    assert np.count_nonzero(filled) > np.count_nonzero(np.load(to))
    assert "any colours" in (out / "clusters.html").read_text()


def test_colmap_projects_the_mesh_where_the_records_do(made: Made, tmp_path: Path) -> None:
    """Its own camera against OpenCV's, with lens and hand-eye as the record has them."""
    cell, _, _ = made
    options = ("--to", "colmap", "--calibrations", RECORDS, "--out", tmp_path)
    assert cells.here("export", cell.run_folder, *options).code == 0
    model = pycolmap.Reconstruction(tmp_path / "sparse/0")
    model.update_point_3d_errors()
    assert len(model.points3D) > 1000
    assert max(point.error for point in model.points3D.values()) < 1e-4
    assert {point.track.length() for point in model.points3D.values()} == {2}
    record = YAML(typ="safe").load(RECORDS / "hand-eye.yaml")
    lens = {one["name"].removesuffix("_px"): one["value"] for one in record["parameters"]}
    hand_eye = record["transforms"]["flange_from_camera"]
    flange_from_camera = np.eye(4)
    turned = Rotation.from_euler("ZYX", hand_eye["abc_deg"], degrees=True)
    flange_from_camera[:3, :3], flange_from_camera[:3, 3] = turned.as_matrix(), hand_eye["translation_mm"]
    zeros_deg = [0.0, *(lens[f"axis_zero.a{axis}_deg"] for axis in range(2, 7))]
    matrix = np.array([[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1]])
    bent = np.array([lens.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")])
    corners = trimesh.load(cell.plan_data["object"]["mesh"], process=False).vertices
    proven = [event for event in cells.events(cell.run_folder, "frame") if "/led" in event["shot"]]
    first = {event["shot"].partition("/")[0]: event["index"] for event in reversed(proven)}
    for image in model.images.values():
        with h5py.File(cell.run_folder / f"views/{Path(image.name).stem}.h5") as file:
            frames = file["entry/instrument/detector/frames"][()]
            at = int(frames["pose"][first[Path(image.name).stem]])
            pose = file["entry/instrument/robot/poses"][at]
            base_from_support = file["entry"].attrs["base_from_support"]
        moved = [forward(KR10_R1100_SIXX, pose["joints_deg"] + zeros) for zeros in (np.zeros(6), zeros_deg)]
        base_from_flange = pose["base_from_flange"] @ np.linalg.inv(moved[0]) @ moved[1]
        camera = np.linalg.inv(base_from_flange @ flange_from_camera) @ base_from_support
        wanted, _ = cv2.projectPoints(corners, camera[:3, :3], camera[:3, 3], matrix, bent)
        found = np.array([image.project_point(corner) for corner in corners]) - 0.5
        np.testing.assert_allclose(found, wanted[:, 0], rtol=0, atol=1e-3)
        picture = cv2.imread(str(tmp_path / "images" / image.name))
        assert picture.shape == (384, 512, 3)
    red, green, blue = np.mean([point.color for point in model.points3D.values()], axis=0)
    assert red > green > blue  # as the relief is


def test_colmaps_poses_are_what_samples_are_made_with(made: Made, tmp_path: Path) -> None:
    """One view, moved by a tenth of a millimetre in COLMAP's file."""
    cell, out, _ = made
    given = ("--calibrations", RECORDS, "--out")
    assert cells.here("export", cell.run_folder, "--to", "colmap", *given, tmp_path / "model").code == 0
    images = tmp_path / "model/sparse/0/images.txt"
    lines = images.read_text().splitlines()
    (number,) = (number for number, line in enumerate(lines) if line.endswith(" top.png"))
    words = lines[number].split()
    words[7] = f"{float(words[7]) + 0.1:.12g}"
    lines[number] = " ".join(words)
    images.write_text("\n".join(lines) + "\n")
    asked = ("reflectance", "extract", cell.run_folder, *given, tmp_path / "result", "--poses", tmp_path / "model")
    ended = cells.here(*asked)
    assert ended.code == 0, ended.err
    told = json.loads((tmp_path / "result/settings.json").read_text())["poses"]
    assert told["median_moved_mm"] == pytest.approx(0.05, abs=1e-4)
    for view, moved_mm in (("top", 0.1), ("side", 0.0)):
        with (
            h5py.File(out / f"samples/{view}.h5") as before,
            h5py.File(tmp_path / f"result/samples/{view}.h5") as file,
        ):
            shift_mm = np.linalg.norm(file["camera_mm"][()] - before["camera_mm"][()])
        assert shift_mm == pytest.approx(moved_mm, abs=1e-4)
    ended = cells.here(*asked, "--refined", tmp_path)
    assert ended.code == 2
    assert "--poses: expected one run, and no --refined" in " ".join(ended.err.split())


def test_a_frame_becomes_a_picture_for_the_eye(made: Made, tmp_path: Path) -> None:
    cell, _, _ = made
    nm = np.arange(380, 781, 10)
    bells = np.exp(-0.5 * ((nm[:, None] - [600, 540, 460]) / 40) ** 2)
    np.savetxt(tmp_path / "sensor.csv", np.column_stack([nm, bells]), delimiter=";")
    np.savetxt(tmp_path / "led.csv", np.column_stack([nm, np.ones(len(nm))]), delimiter=";")
    options = ("--to", "tiff", "--for-the-eye", "--sensor-spectra", tmp_path / "sensor.csv", "--views", "top")
    asked = ("export", cell.run_folder, *options, "--calibrations", RECORDS, "--out", tmp_path / "out")
    ended = cells.here(*asked)
    assert ended.code == 2
    assert "its rig names no spectrum of the LEDs" in " ".join(ended.err.split())
    assert cells.here(*asked, "--shots", "led0000/*", "--led-spectrum", tmp_path / "led.csv").code == 0
    (path,) = (tmp_path / "out").iterdir()
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == np.uint16
    blue, green, red = picture[picture.min(axis=2) > 20000].mean(axis=0)
    assert red > green > blue
