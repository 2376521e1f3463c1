"""What is made of the result of a run: new light, exports, clusters, other programs' models."""

from __future__ import annotations

import json
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
from lazily import lazily
from relief_cells import DIFFUSE, RECORDS, Made, frame_share, unit, walter
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from coupole.appearance.matter.alta_samples import read_alta
from coupole.kinematics import forward
from coupole.reflectance import ggx
from coupole.reflectance.fits import MATERIALS, RELIT
from coupole.reflectance.new_light.light_kinds import DistantLight
from coupole.reflectance.new_light.shading import coats_of
from coupole.reflectance.relit_uncertainty import uncertainty_of_picture
from coupole.reflectance.run_relighting import materials_of, scene_of_view
from coupole.reflectance.run_result import RunResult

pycolmap: Any = lazily("pycolmap")


@pytest.fixture(scope="module")
def made(glossy: Made) -> Made:
    return glossy


@pytest.mark.parametrize("view", ["top", "side"])
def test_under_an_led_kept_for_the_check_a_view_looks_as_it_was_photographed(made: Made, view: str) -> None:
    """In shares of the camera's range, pixel by pixel of the frame itself."""
    cell, out, document = made
    led, to = document["left_out"][1], out / "led.npy"
    share = frame_share(cell, view, led)
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


@pytest.mark.parametrize("view", ["top", "side"])
def test_an_interval_holds_the_frame_of_an_led_kept_for_the_check(made: Made, tmp_path: Path, view: str) -> None:
    cell, out, document = made
    led, low, high = document["left_out"][1], tmp_path / "low.npy", tmp_path / "high.npy"
    share = frame_share(cell, view, led)
    options = ("--led", led, "--view", view, "--fit", "ggx_normal", "--to", tmp_path / "a.npy")
    bounds = ("--interval", f"{low},{high}", "--uncertainty", tmp_path / "u.npy")
    ended = cells.here("reflectance", "relight", out, *map(str, options), *bounds)
    assert ended.code == 0, ended.err
    picture, lower, upper = np.load(tmp_path / "a.npy"), np.load(low), np.load(high)
    assert np.isnan(lower[picture == 0]).all()
    inside, plain = [], []
    for channel, row, column in ((1, 0, 0), (2, 0, 1), (0, 1, 0)):  # GBRG
        at = np.s_[row::2, column::2, channel]
        seen, frame = picture[at] > 0.05, share[row::2, column::2]
        inside.append(((lower[at] <= frame) & (frame <= upper[at]))[seen])
        plain.append((np.abs(frame - picture[at]) <= 1.96 * np.load(tmp_path / "u.npy")[at])[seen])
    assert 0.9 < np.concatenate(inside).mean() < 0.99
    assert np.concatenate(plain).mean() < np.concatenate(inside).mean()


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
    assert f"expected one of {', '.join(RELIT)}" in " ".join(wrong.err.split())


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
    [
        (("--fit", "sh"), f"sh has none; choose --fit {' or '.join(MATERIALS)}"),
        (("--turn", "4"), "not to a video"),
    ],
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
    record = YAML(typ="safe", pure=True).load(RECORDS / "hand-eye.yaml")
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
