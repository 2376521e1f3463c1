"""Scans with unknown poses: found as an independent caster of rays made them, and the bunny as bun.conf has it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cells
import numpy as np
import pytest
import trimesh
from places import SHARED_DATA
from ray_scanner import RayScan, RayScanner, tower
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from coupole.errors import InputError
from coupole.scan.mesh_defects import find_defects
from coupole.scan.mesh_files import read_mesh
from coupole.scan.registration.control import TargetTables
from coupole.scan.registration.joining import join
from coupole.scan.registration.merging import Merged, merge
from coupole.scan.registration.pair_matching import PairMotion
from coupole.scan.registration.registering import Registration, register
from coupole.scan.registration.small_motions import moved_points
from coupole.scan.registration.summary import about
from coupole.scan.registration.viewpoint import DepthPicture, Viewpoint, choose_viewpoints, folds

BUNNY = SHARED_DATA / "scans/bunny"
NOISE_MM = 0.5
TOWER = tower(700.0, 1200.0, 40, 240, 5)


def silent(*_: object) -> None: ...


@dataclass(frozen=True)
class Surveyed:
    """Scans of the tower from four sides, one of another object, and what became of them."""

    scans: dict[str, RayScan]
    paths: list[Path]
    found: Registration
    merged: Merged
    folder: Path


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> Surveyed:
    folder = tmp_path_factory.mktemp("scans")
    scanner = RayScanner(TOWER, noise_mm=NOISE_MM, seed=1)
    scans = {}
    for k, degrees in enumerate((0, 30, 60, 85)):
        way = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.15])
        scans[f"side{k}.ply"] = scanner.scan(2500.0 * way, np.zeros(3), 36.0, 110)
    other = RayScanner(tower(700.0, 1200.0, 40, 240, 77), noise_mm=NOISE_MM, seed=2)
    scans["other.ply"] = other.scan(np.array([0.0, -2600.0, 200.0]), np.zeros(3), 36.0, 110)
    order = ["side2.ply", "other.ply", "side0.ply", "side3.ply", "side1.ply"]
    paths = [scans[name].write(folder / name) for name in order]
    found = register(paths, "mm", processes=1, say=silent)
    (folder / "merged").mkdir()
    placed = [found.scans[k] for k in found.placed_numbers]
    poses = [found.first_from_scan[k] for k in found.placed_numbers]
    merged = merge(placed, poses, "mm", 16.0, (50.0, 250.0), folder / "merged", silent)
    return Surveyed(scans, paths, found, merged, folder)


def true_pose(surveyed: Surveyed, number: int) -> np.ndarray:
    first = surveyed.scans[surveyed.found.names[surveyed.found.placed_numbers[0]]].world_from_scan
    return np.linalg.inv(first) @ surveyed.scans[surveyed.found.names[number]].world_from_scan


def off_mm(one: np.ndarray, other: np.ndarray, points: np.ndarray) -> float:
    apart = points @ (one - other)[:3, :3].T + (one - other)[:3, 3]
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))


def test_poses_are_those_of_the_scanner(surveyed: Surveyed) -> None:
    found = surveyed.found
    assert [found.names[k] for k in found.unplaced_numbers] == ["other.ply"]
    for number in found.placed_numbers:
        points = surveyed.scans[found.names[number]].points_mm
        assert off_mm(found.first_from_scan[number], true_pose(surveyed, number), points) < 2.0
    assert len(found.loops) >= 1


def test_the_truth_lies_in_the_stated_regions(surveyed: Surveyed) -> None:
    found = surveyed.found
    for k, number in enumerate(found.placed_numbers[1:], start=1):
        pose, true = found.first_from_scan[number], true_pose(surveyed, number)
        pivot = found.fit.pivots_mm[k]
        turn = true[:3, :3] @ pose[:3, :3].T
        moved = true[:3, 3] - pivot - turn @ (pose[:3, 3] - pivot)
        step = np.concatenate([moved, Rotation.from_matrix(turn).as_rotvec()])
        squared = step @ np.linalg.solve(found.covariance[number], step)
        assert 0.05 < squared < 22.5  # 99.9 % of six degrees of freedom


def test_scanners_are_seen_to_stand_in_the_origin(surveyed: Surveyed) -> None:
    assert {scan.viewpoint.stand for scan in surveyed.found.scans} == {"origin"}


def test_the_merged_mesh_lies_on_the_object_and_is_a_surface(surveyed: Surveyed) -> None:
    path = surveyed.folder / "merged/mesh.ply"
    mesh = read_mesh(path)
    defects = find_defects(mesh)
    assert defects.non_manifold_edges == defects.flipped_edges == 0
    first = surveyed.scans[surveyed.found.names[surveyed.found.placed_numbers[0]]].world_from_scan
    vertices = mesh.vertices @ first[:3, :3].T + first[:3, 3]
    true, faces = trimesh.sample.sample_surface(TOWER, 400_000, seed=0)
    away, nearest = cKDTree(true).query(vertices)
    along = np.abs(np.sum((vertices - true[nearest]) * TOWER.face_normals[faces[nearest]], axis=1))
    assert np.median(along[away < 10.0]) < 2.0
    assert np.mean(away < 12.0) > 0.97
    loaded = trimesh.load(path, process=False)  # a foreign reader
    assert len(loaded.faces) == surveyed.merged.triangles == len(mesh.triangles)
    outward = loaded.face_normals @ first[:3, :3].T
    assert np.mean(np.sum(outward * TOWER.face_normals[faces[cKDTree(true).query(loaded.triangles_center
        @ first[:3, :3].T + first[:3, 3])[1]]], axis=1) > 0) > 0.95  # fmt: skip


def test_thinner_clouds_have_one_point_in_each_cell(surveyed: Surveyed) -> None:
    for name, count in surveyed.merged.levels.items():
        cloud = np.asarray(trimesh.load(surveyed.folder / "merged" / name).vertices)
        pitch = float(name.removeprefix("points-").removesuffix("mm.ply"))
        assert len(cloud) == count == len(np.unique(np.floor(cloud / pitch), axis=0))
    assert not (surveyed.folder / "merged/blocks").exists()


def test_what_is_told_can_be_read_back(surveyed: Surveyed) -> None:
    told = json.loads(json.dumps(about(surveyed.found, surveyed.merged)))
    assert told["frame"] == "side2.ply"
    assert np.allclose(told["poses"]["side2.ply"], np.eye(4))
    assert told["unplaced"] == ["other.ply"]
    assert told["rms_mm"] > 0.0


def test_a_wrong_motion_is_rejected_by_the_others(surveyed: Surveyed) -> None:
    found = surveyed.found
    wrong = found.motions[0].first_from_second.copy()
    wrong[:3, 3] += 400.0
    first, second = found.motions[0].first, found.motions[0].second
    false = PairMotion(first, second, wrong, found.motions[0].fit, "features")
    groups = join(found.scans, [*found.motions[1:], false])
    assert groups.rejected_motions == [false]
    assert len(groups.members[groups.group_of[first]]) == len(found.placed_numbers)


def test_a_scan_in_the_space_that_another_saw_through_contradicts_it(surveyed: Surveyed) -> None:
    """Alone, without others that would outvote it."""
    found = surveyed.found
    motion = found.motions[0]
    before = motion.first_from_second.copy()
    before[:3, 3] *= 0.8  # nearer to the first scanner
    groups = join(found.scans, [PairMotion(motion.first, motion.second, before, motion.fit, "features")])
    assert len(groups.rejected_motions) == 1


def test_control_points_place_the_scans_in_the_site(surveyed: Surveyed, tmp_path: Path) -> None:
    spheres = {"s1": (900.0, 0.0, -300.0), "s2": (600.0, 700.0, 100.0), "s3": (100.0, 950.0, 400.0)}
    rng = np.random.default_rng(0)
    lines, known = ["scan,name,x,y,z,u_mm"], ["name,x,y,z,u_mm"]
    for name in ("side0.ply", "side1.ply", "side2.ply"):
        scan_from_world = np.linalg.inv(surveyed.scans[name].world_from_scan)
        for sphere, place in spheres.items():
            x, y, z = scan_from_world[:3, :3] @ place + scan_from_world[:3, 3] + rng.normal(0, 0.2, 3)
            lines.append(f"{name},{sphere},{x},{y},{z},0.2")
    known += [f"{sphere},{x},{y},{z},0.1" for sphere, (x, y, z) in spheres.items()]
    (tmp_path / "targets.csv").write_text("\n".join(lines))
    (tmp_path / "control.csv").write_text("\n".join(known))
    paths = [surveyed.folder / f"side{k}.ply" for k in range(3)]
    targets, control = tmp_path / "targets.csv", tmp_path / "control.csv"
    found = register(paths, "mm", tables=TargetTables(targets, control), processes=1, say=silent)
    assert found.site_from_first is not None
    for number, name in enumerate(found.names):
        site_from_scan = found.site_from_first @ found.first_from_scan[number]
        points = surveyed.scans[name].points_mm
        assert off_mm(site_from_scan, surveyed.scans[name].world_from_scan, points) < 1.0
    merged_from_scan = found.merged_from_scan(cell_mm=3.0)
    assert np.allclose(merged_from_scan[0], found.site_from_first @ found.first_from_scan[0])
    national_grid = found.site_from_first.copy()
    national_grid[:3, 3] += 5e8  # 32 bits are 32 mm there
    far = replace(found, site_from_first=national_grid)
    assert np.allclose(far.merged_from_scan(cell_mm=3.0)[0], found.first_from_scan[0])


def test_with_control_points_the_command_writes_the_mesh_in_their_frame(
    surveyed: Surveyed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spheres = {"s1": (900.0, 0.0, -300.0), "s2": (600.0, 700.0, 100.0), "s3": (100.0, 950.0, 400.0)}
    lines = ["scan,name,x,y,z,u_mm"]
    for name in ("side0.ply", "side1.ply"):
        scan_from_world = np.linalg.inv(surveyed.scans[name].world_from_scan)
        for sphere, place in spheres.items():
            x, y, z = scan_from_world[:3, :3] @ place + scan_from_world[:3, 3]
            lines.append(f"{name},{sphere},{x},{y},{z},0.2")
    (tmp_path / "targets.csv").write_text("\n".join(lines))
    known = [f"{sphere},{x + 2000},{y},{z},0.1" for sphere, (x, y, z) in spheres.items()]
    (tmp_path / "control.csv").write_text("\n".join(known))
    monkeypatch.chdir(tmp_path)
    scans = [str(surveyed.folder / f"side{k}.ply") for k in range(2)]
    tables = ["--targets", "targets.csv", "--control", "control.csv", "--mesh-mm", "16", "--out", "on-site"]
    ended = cells.here("register", *scans, *tables)
    assert ended.code == 0, ended.err
    assert "frame: site" in ended.err.replace("\n", " ")
    assert json.loads((tmp_path / "on-site/registration.json").read_text())["mesh"]["frame"] == "site"
    mesh = trimesh.load(tmp_path / "on-site/mesh.ply")
    of_sides = [surveyed.scans[f"side{k}.ply"] for k in range(2)]
    world = np.concatenate([moved_points(scan.world_from_scan, scan.points_mm) for scan in of_sides])
    nearest = cKDTree(np.add(world, (2000.0, 0.0, 0.0))).query(mesh.vertices)[0]
    assert np.median(nearest) < 10.0


def test_a_view_along_an_axis_is_told_from_one_out_of_the_origin() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-50, 50, (2, 20_000))
    z = 8 * np.sin(x / 9) * np.cos(y / 7) + 20
    chosen = choose_viewpoints([folds(np.stack([x, y, z], 1), None, 0.5)])
    assert chosen[0].stand == "+z"
    closed = rng.normal(size=(20_000, 3))
    closed = 50 * closed / np.linalg.norm(closed, axis=1, keepdims=True) + [3, 2, 1]
    assert choose_viewpoints([folds(closed[:, :], None, 0.9)])[0].stand != "+z"


def test_only_points_before_the_surface_contradict() -> None:
    x, y = np.meshgrid(np.arange(-20, 20, 0.5), np.arange(-20, 20, 0.5))
    wall = np.stack([x.ravel(), y.ravel(), np.full(x.size, 100.0)], axis=1)
    picture = DepthPicture(Viewpoint("origin"), wall, 0.5)
    seen, before = picture.in_front(np.array([[0, 0, 90.0], [0, 0, 110.0], [0, 0, 99.9], [80.0, 0, 90]]), 1.0)
    assert seen.tolist() == [True, True, True, False]
    assert before.tolist() == [True, False, False, False]


def edit_nan(points: np.ndarray) -> np.ndarray:
    points[7, 1] = np.nan
    return points


BROKEN: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "not finite": (edit_nan, "point 7: expected finite coordinates"),
    "too few": (lambda points: points[:20], "expected 200 points or more, found 20"),
    "another unit": (lambda points: points * 1e-3, "mixed units"),
    "too small": (lambda points: points * 1e-6, "mm in size if it is in mm.*--unit"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_scans_are_refused(surveyed: Surveyed, tmp_path: Path, kind: str) -> None:
    edit, said = BROKEN[kind]
    points = surveyed.scans["side0.ply"].points_mm
    np.savetxt(tmp_path / "broken.xyz", edit(points[:2000].copy()))
    paths = [surveyed.folder / "side1.ply", surveyed.folder / "side3.ply", tmp_path / "broken.xyz"]
    with pytest.raises(InputError, match=said):
        register(paths, "mm", processes=1, say=silent)


def test_scans_named_twice_empty_or_apart_are_refused(surveyed: Surveyed, tmp_path: Path) -> None:
    one, other = surveyed.folder / "side0.ply", surveyed.folder / "other.ply"
    (tmp_path / "again.ply").write_bytes(one.read_bytes())
    (tmp_path / "empty.ply").touch()
    for paths, said in (
        ([one, tmp_path / "again.ply"], "same bytes"),
        ([one, tmp_path / "empty.ply"], "the file is empty"),
        ([one], "two scans or more"),
        ([one, other], "no two of the 2 scans overlap.*side0.ply, other.ply"),
    ):
        with pytest.raises(InputError, match=said):
            register(paths, "mm", processes=1, say=silent)


def bunny_poses() -> dict[str, np.ndarray]:
    """bun.conf, whose quaternions are conjugated, in mm."""
    poses = {}
    for line in (BUNNY / "bun.conf").read_text().splitlines():
        words = line.split()
        if words and words[0] == "bmesh":
            x, y, z, i, j, k, real = map(float, words[2:])
            poses[words[1]] = np.eye(4)
            poses[words[1]][:3, :3] = Rotation.from_quat([-i, -j, -k, real]).as_matrix()
            poses[words[1]][:3, 3] = 1000 * np.array([x, y, z])
    return poses


@pytest.mark.full
@pytest.mark.skipif(not BUNNY.is_dir(), reason="the real scans are not here")
@pytest.mark.parametrize("seed", range(3))
def test_the_ten_scans_of_the_bunny_lie_as_published(seed: int) -> None:
    published = bunny_poses()
    order = [sorted(published)[k] for k in np.random.default_rng(seed).permutation(len(published))]
    found = register([BUNNY / name for name in order], "m", say=silent)
    assert found.unplaced_numbers == () == found.rejected_motions
    points = {scan.name: scan.fine.points_mm for scan in found.scans}
    first = np.linalg.inv(published[order[0]])
    for number, name in enumerate(order):
        assert off_mm(found.first_from_scan[number], first @ published[name], points[name]) < 0.5
    mine = {name: found.first_from_scan[number] for number, name in enumerate(order)}
    assert median_overlap_mm(points, mine) < 1.02 * median_overlap_mm(points, published)


def median_overlap_mm(points: dict[str, np.ndarray], poses: dict[str, np.ndarray]) -> float:
    """Of each point to the nearest one of any other scan, where that is within 2 mm."""
    placed = {name: cloud @ poses[name][:3, :3].T + poses[name][:3, 3] for name, cloud in points.items()}
    away = []
    for name, cloud in placed.items():
        others = cKDTree(np.concatenate([other for other_name, other in placed.items() if other_name != name]))
        nearest, _ = others.query(cloud)
        away.append(nearest[nearest < 2.0])
    return float(np.median(np.concatenate(away)))
