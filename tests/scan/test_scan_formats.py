"""PTX, PTS and E57 as scanners write them: points, poses that are not trusted, colours up to the merged mesh."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pye57
import pytest
import trimesh
from ray_scanner import RayScan, RayScanner, tower
from typer.testing import CliRunner

from coupole.commands.cli import app
from coupole.errors import InputError
from coupole.scan.registration.scan_files import read_scan, sources_of

WRONG_BY_MM = 300.0
TOWER = tower(700.0, 1200.0, 40, 240, 5)


def painted(world_mm: np.ndarray) -> np.ndarray:
    """[n, 3] colours of the tower: red below, blue above, in between both."""
    red = np.clip(np.round(127.5 - world_mm[:, 2] / 5), 0, 255)
    return np.stack([red, np.full(len(red), 80.0), 255 - red], axis=1).astype(np.uint8)


@dataclass(frozen=True)
class Seen:
    scans: list[RayScan]
    colours: list[np.ndarray]


@pytest.fixture(scope="module")
def seen() -> Seen:
    scanner = RayScanner(TOWER, noise_mm=0.5, seed=1)
    scans = []
    for degrees in (0, 30):
        way = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.15])
        scans.append(scanner.scan(2500.0 * way, np.zeros(3), 36.0, 110))
    return Seen(
        scans, [painted(s.points_mm @ s.world_from_scan[:3, :3].T + s.world_from_scan[:3, 3]) for s in scans]
    )


def ptx_text(scan: RayScan, colours: np.ndarray, pose: np.ndarray) -> str:
    """As Leica's Cyclone writes it, in m, with a ray that did not come back in front of each hundred points."""
    metres = pose.copy()
    metres[:3, 3] /= 1000
    lines = []
    for k, (point, (r, g, b)) in enumerate(zip(scan.points_mm / 1000, colours, strict=True)):
        if k % 100 == 0:
            lines.append("0 0 0 0.5 0 0 0")
        lines.append("{:.6f} {:.6f} {:.6f} 0.7 {} {} {}".format(*point, r, g, b))
    place = ["0 0 0", "1 0 0", "0 1 0", "0 0 1"]
    matrix = [" ".join(f"{value:.9f}" for value in row) for row in metres.T]
    return "\n".join([str(len(lines)), "1", *place, *matrix, *lines]) + "\n"


def moved(pose: np.ndarray) -> np.ndarray:
    wrong = pose.copy()
    wrong[:3, 3] += [0.0, WRONG_BY_MM, 0.0]
    return wrong


def write_e57(path: Path, seen: Seen) -> None:
    with pye57.E57(str(path), mode="w") as file:
        for scan, colours in zip(seen.scans, seen.colours, strict=True):
            turn = scan.world_from_scan[:3, :3]
            w, x, y, z = trimesh.transformations.quaternion_from_matrix(scan.world_from_scan)
            assert np.allclose(trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3], turn)
            columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), scan.points_mm.T / 1000, strict=True))
            columns |= dict(zip(("colorRed", "colorGreen", "colorBlue"), colours.T, strict=True))
            columns = {name: np.ascontiguousarray(values) for name, values in columns.items()}
            columns["cartesianInvalidState"] = (np.arange(len(colours)) % 50 == 0).astype(np.int8)
            file.write_scan_raw(
                columns, rotation=np.array([w, x, y, z]), translation=scan.world_from_scan[:3, 3] / 1000
            )


def test_a_ptx_with_wrong_poses_is_registered_by_shape_and_its_mesh_is_painted(seen: Seen, tmp_path: Path) -> None:
    poses = [seen.scans[0].world_from_scan, moved(seen.scans[1].world_from_scan)]
    texts = [ptx_text(*one) for one in zip(seen.scans, seen.colours, poses, strict=True)]
    (tmp_path / "hall.ptx").write_text("".join(texts))
    out = tmp_path / "out"
    arguments = [
        "register",
        str(tmp_path / "hall.ptx"),
        "--unit",
        "m",
        "--mesh-mm",
        "25",
        "--levels",
        "100",
        "--json",
    ]
    ran = CliRunner().invoke(app, [*arguments, "--out", str(out)])
    assert ran.exit_code == 0, ran.output
    told = json.loads(ran.stdout)
    assert set(told["poses"]) == {"hall.ptx", "hall.ptx#2"}
    assert told["stated_poses_off_mm"]["hall.ptx#2"] == pytest.approx(WRONG_BY_MM, rel=0.02)
    page = (out / "report.html").read_text()
    assert "<h1>out: 2 of 2 scans registered</h1>" in page
    assert "<code>out/mesh.ply</code>" in page
    first = seen.scans[0].world_from_scan
    true = np.linalg.inv(first) @ seen.scans[1].world_from_scan
    points = seen.scans[1].points_mm
    off = points @ (np.array(told["poses"]["hall.ptx#2"]) - true)[:3, :3].T
    off += (np.array(told["poses"]["hall.ptx#2"]) - true)[:3, 3]
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 2.0
    for name in ("mesh.ply", "points-100mm.ply"):
        loaded = trimesh.load(out / name, process=False)  # a foreign reader
        shown = np.asarray(loaded.visual.vertex_colors if name == "mesh.ply" else loaded.colors)[:, :3].astype(int)
        expected = painted(np.asarray(loaded.vertices) @ first[:3, :3].T + first[:3, 3]).astype(int)
        assert np.median(np.abs(shown - expected).max(axis=1)) < 6


def test_trusted_poses_are_a_first_guess_that_is_still_adjusted(seen: Seen, tmp_path: Path) -> None:
    nearly = seen.scans[1].world_from_scan.copy()
    nearly[:3, 3] += 5.0
    poses = [seen.scans[0].world_from_scan, nearly]
    texts = [ptx_text(*one) for one in zip(seen.scans, seen.colours, poses, strict=True)]
    (tmp_path / "hall.ptx").write_text("".join(texts))
    arguments = ["register", str(tmp_path / "hall.ptx"), "--unit", "m", "--no-mesh", "--trust-poses", "--json"]
    ran = CliRunner().invoke(app, [*arguments, "--out", str(tmp_path / "out")])
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout)["stated_poses_off_mm"]["hall.ptx#2"] == pytest.approx(5 * 3**0.5, abs=2.0)


def test_an_e57_gives_each_scan_with_pose_and_colours_without_invalid_points(seen: Seen, tmp_path: Path) -> None:
    write_e57(tmp_path / "hall.e57", seen)
    sources = sources_of([tmp_path / "hall.e57"])
    assert [source.name for source in sources] == ["hall.e57", "hall.e57#2"]
    for source, scan, colours in zip(sources, seen.scans, seen.colours, strict=True):
        found = read_scan(source, "mm", colours=True)  # the standard's metres count, not the unit stated
        valid = np.arange(len(colours)) % 50 != 0
        assert np.allclose(found.mesh.vertices, scan.points_mm[valid], atol=1e-3)
        assert found.stated_pose is not None
        assert np.allclose(found.stated_pose, scan.world_from_scan, atol=1e-3)
        assert found.srgba is not None
        assert np.array_equal(found.srgba[:, :3], colours[valid])


def test_a_pts_has_a_count_before_its_points_and_black_is_no_colour(seen: Seen, tmp_path: Path) -> None:
    points, colours = seen.scans[0].points_mm, seen.colours[0].copy()
    colours[5] = 0
    lines = ["{} {} {} -1200 {} {} {}".format(*p, *c) for p, c in zip(points, colours, strict=True)]
    (tmp_path / "one.pts").write_text("\n".join([str(len(lines)), *lines]))
    found = read_scan(sources_of([tmp_path / "one.pts"])[0], "mm", colours=True)
    assert np.allclose(found.mesh.vertices, points, rtol=1e-6)
    assert found.srgba is not None
    assert np.flatnonzero(found.srgba[:, 3] == 0).tolist() == [5]


def spoilt_word(text: str) -> str:
    lines = text.splitlines()
    lines[40] = lines[40].replace(" 0.7 ", " x ")
    return "\n".join(lines)


BROKEN = {
    "cut off": (lambda text: "\n".join(text.splitlines()[:300]), r"broken.ptx: (expected|the file ends in)"),
    "a word": (spoilt_word, r"broken.ptx:41: expected x, y and z"),
    "header": (
        lambda text: text.replace("1 0 0", "1 0", 1),
        r"broken.ptx:4: expected 3 numbers of the header of scan 1",
    ),
    "count": (
        lambda text: "-3\n" + text,
        r"broken.ptx:1: expected a number of points, found -3|broken.ptx:3: expected 3",
    ),
    "mirrored": (lambda text: text.replace(text.splitlines()[6], "-9 0 0 0"), r"broken.ptx:7: .*rigid motion"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_ptx_is_refused_with_its_line(seen: Seen, tmp_path: Path, kind: str) -> None:
    edit, said = BROKEN[kind]
    path = tmp_path / "broken.ptx"
    path.write_text(edit(ptx_text(seen.scans[0], seen.colours[0], seen.scans[0].world_from_scan)))
    with pytest.raises(InputError, match=said):
        read_scan(sources_of([path])[0], "m")


def test_what_is_no_e57_or_has_no_stated_unit_is_refused(seen: Seen, tmp_path: Path) -> None:
    write_e57(tmp_path / "whole.e57", seen)
    cut = (tmp_path / "whole.e57").read_bytes()
    (tmp_path / "cut.e57").write_bytes(cut[: len(cut) // 2])
    with pytest.raises(InputError, match=r"cut\.e57: expected an E57 file"):
        sources_of([tmp_path / "cut.e57"])
    (tmp_path / "a.ptx").write_text("1\n")
    ran = CliRunner().invoke(app, ["register", str(tmp_path / "a.ptx"), "--out", str(tmp_path / "out")])
    assert ran.exit_code != 0
    assert "state --unit" in str(ran.exception)
