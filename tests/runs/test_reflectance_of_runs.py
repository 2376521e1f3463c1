"""`coupole reflectance RUN`: a glossy relief in the shipped cell, its material found with the shipped records."""

from __future__ import annotations

import json
from pathlib import Path

import cells
import cv2
import h5py
import numpy as np
import pytest
import trimesh
from relief_cells import DIFFUSE, F0, RECORDS, ROUGHNESS, SIDE, Made, shipped_cell, unit, walter

from coupole.calibration.light.frames import open_light_frames
from coupole.reflectance.fits import FITS, MATERIALS
from coupole.reflectance.light_files import read_lights
from coupole.reflectance.normal_fit import fit_materials
from coupole.reflectance.picture_set import read_pictures
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.sample_uncertainty import Places, Sources, bounds
from coupole.reflectance.triangle_fit import fit_triangles
from coupole.reflectance.uncalibrated import FILES, write_pictures


@pytest.fixture(scope="module")
def made(glossy: Made) -> Made:
    return glossy


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
    assert set(document["mae"]) == set(FITS)
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
    second.write(lights={"kind": "ids", "ids": [0]})
    moved = second.acquire()
    assert moved.code == 0
    ended = cells.here(
        "reflectance", runs[0], moved.document["run"], "--calibrations", RECORDS, "--out", tmp_path / "b"
    )
    assert ended.code == 2
    assert "shows another object, or the object in another place" in ended.err


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
    sources = Sources(
        noise, own, 0 * same, 0 * same, u_led[led], u_leds[led], 30.0 * same, led_mm * same, 0 * same
    )
    return truth / f[triangle, led], Places(corners, leds[led], axes[led]), sources


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
    assert {name: few[name] == many[name] for name in few} == {name: name in MATERIALS for name in FITS}
    page = (out / "ablation.html").read_text()
    assert "Share of the LEDs" in page
    assert "At 60 there were not enough samples" in page
