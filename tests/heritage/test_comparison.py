"""Two states compared: a dent and a patch of another colour are found, and nothing where nothing changed."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import coupole
from coupole.commands.cli import app
from coupole.errors import InputError
from coupole.heritage.comparison.significance import discoveries
from coupole.heritage.comparison.state_comparison import Comparison, compare, de00_of
from coupole.heritage.comparison.state_files import lab_of, read_state
from coupole.viewing import comparison_page
from coupole.viewing.comparison_page import remarks

NOISE_MM, DENT_MM, DENT_ACROSS_MM = 0.03, 0.2, 10.0


def silent(*_: object) -> None: ...


@dataclass
class Head:
    """A bumpy ball of 80 mm, whose vertices are about 1 mm apart."""

    mesh: trimesh.Trimesh
    dent: np.ndarray
    patch: np.ndarray

    def write(
        self, path: Path, seed: int, *, dented: bool = False, painted: bool = False, moved: bool = False
    ) -> Path:
        rng = np.random.default_rng(seed)
        points, normals = np.array(self.mesh.vertices), np.array(self.mesh.vertex_normals)
        points += normals * rng.normal(0, NOISE_MM, (len(points), 1))
        if dented:
            points -= normals * (DENT_MM * self.dent)[:, None]
        srgb = 130 + 15 * np.sin(points / 11) + rng.normal(0, 1.5, points.shape)
        if painted:
            srgb[self.patch] += [9.0, 0.0, -3.0]
        if moved:
            points = points @ Rotation.from_rotvec([0.4, -1.1, 0.3]).as_matrix().T + [30, -90, 12]
        colours = np.clip(srgb, 0, 255).round().astype(np.uint8)
        trimesh.Trimesh(points, self.mesh.faces, vertex_colors=colours, process=False).export(path)
        return path


@pytest.fixture(scope="module")
def head() -> Head:
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=40.0)
    unit = np.array(mesh.vertices) / 40.0
    bumps = 1 + 0.09 * np.sin(unit @ [3.1, 1.2, 4.4]) + 0.06 * np.sin(unit @ [-5.0, 4.1, 1.3] + 1)
    bumps += 0.08 * np.exp(-30 * np.sum((unit - [0.6, 0.64, 0.48]) ** 2, axis=1))
    mesh.vertices = unit * (40 * bumps)[:, None]
    points = np.array(mesh.vertices)
    dent = np.linalg.norm(points - points[300], axis=1) < DENT_ACROSS_MM / 2
    patch = np.linalg.norm(points - points[5000], axis=1) < 6.0
    return Head(mesh, dent, patch)


@pytest.fixture(scope="module")
def before(head: Head, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return head.write(tmp_path_factory.mktemp("states") / "before.ply", 1)


@pytest.fixture(scope="module")
def changed(head: Head, before: Path) -> Comparison:
    after = head.write(before.with_name("after.ply"), 2, dented=True, painted=True, moved=True)
    return compare(before, after, "mm", None, is_aligned=False, say=silent)


def test_a_dent_of_a_fifth_of_a_millimetre_is_found(head: Head, changed: Comparison) -> None:
    assert changed.moved_points[head.dent].mean() > 0.5
    assert len(changed.shape_regions) == 1
    region = changed.shape_regions[0]
    assert np.linalg.norm(region.middle_mm - np.array(head.mesh.vertices)[head.dent].mean(axis=0)) < 1.0
    assert region.distance_mm == pytest.approx(-DENT_MM, abs=0.06)  # inwards
    turn = Rotation.from_rotvec([0.4, -1.1, 0.3]).as_matrix()
    assert region.middle_in_after_mm == pytest.approx(turn @ region.middle_mm + [30, -90, 12], abs=0.02)


def test_the_largest_region_and_single_points_are_told(changed: Comparison) -> None:
    told = list(remarks(changed))
    region = changed.shape_regions[0]
    single = int(changed.moved_points.sum()) - region.points
    of_shape = f"{region.points:,} of them in 1 region" + (f", {single:,} scattered" if single else "")
    assert of_shape in told[0]
    assert re.search(r"is 0\.\d+ mm lower in after\.ply; its middle is at .* in the frame of before\.ply", told[1])


def test_pictures_stand_as_a_mesh_of_the_site_does(head: Head, before: Path, tmp_path: Path) -> None:
    """A mesh that `register --control` merged has z up; the other state, turned, is drawn by these axes."""
    changed = compare(
        before, written_by_register(head, tmp_path, "site"), "mm", None, is_aligned=False, say=silent
    )
    turn = Rotation.from_rotvec([0.4, -1.1, 0.3]).as_matrix()
    assert changed.upright_axes == pytest.approx(turn.T, abs=1e-3)
    comparison_page.write(changed, tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert "from -y, from +y, from above, by the axes of mesh.ply, in which z is up" in page


@pytest.mark.parametrize("record", ["", "{", '{"mesh": null}', '{"mesh": {"frame": "scan-1.ply"}}', "[]"])
def test_otherwise_nobody_knows_what_is_up(head: Head, before: Path, tmp_path: Path, record: str) -> None:
    after = written_by_register(head, tmp_path, "scan-1.ply")
    (tmp_path / "registration.json").write_text(record)
    assert read_state(after, "mm").is_upright is False


def written_by_register(head: Head, folder: Path, frame: str) -> Path:
    (folder / "registration.json").write_text(json.dumps({"mesh": {"frame": frame}}))
    return head.write(folder / "mesh.ply", 2, dented=True, moved=True)


def test_a_patch_of_another_colour_is_found(head: Head, changed: Comparison) -> None:
    assert changed.recoloured_points is not None
    assert changed.recoloured_points[head.patch].mean() > 0.6
    assert changed.colour_regions[0].de00 == pytest.approx(3.0, abs=1.0)


def test_of_what_is_marked_little_is_unchanged(head: Head, changed: Comparison) -> None:
    assert changed.recoloured_points is not None
    for marked, true in ((changed.moved_points, head.dent), (changed.recoloured_points, head.patch)):
        middle = np.array(head.mesh.vertices)[true].mean(axis=0)
        far = np.linalg.norm(np.array(head.mesh.vertices) - middle, axis=1) > 9.0  # local fits reach over the rim
        assert (marked & far).sum() <= 0.1 * marked.sum()  # 5 % on average
        assert (marked & far).sum() < 0.001 * far.sum()


def test_the_changed_part_does_not_pull_the_alignment(changed: Comparison) -> None:
    turn = Rotation.from_rotvec([0.4, -1.1, 0.3]).as_matrix()
    after_from_before = np.eye(4)
    after_from_before[:3, :3], after_from_before[:3, 3] = turn, [30, -90, 12]
    there_and_back = changed.alignment.before_from_after @ after_from_before
    points = changed.before.points_mm
    off = np.linalg.norm(points @ there_and_back[:3, :3].T + there_and_back[:3, 3] - points, axis=1)
    assert off.max() < 0.02


def test_nothing_is_marked_where_nothing_changed(head: Head, before: Path, tmp_path: Path) -> None:
    same = tmp_path / "same.ply"
    same.write_bytes(before.read_bytes())
    again = head.write(tmp_path / "again.ply", 9)
    for after, most in ((same, 0), (again, 3)):
        found = compare(before, after, "mm", None, is_aligned=False, say=silent)
        assert found.recoloured_points is not None
        assert found.moved_points.sum() + found.recoloured_points.sum() <= most
    assert np.nanmedian(np.abs(found.distance_mm) / found.u_mm) == pytest.approx(0.674, abs=0.12)


def test_uncertainties_hold_by_a_stated_noise(head: Head, before: Path, tmp_path: Path) -> None:
    again = head.write(tmp_path / "again.ply", 9)
    stated = coupole.compare(before, again, noise_mm=NOISE_MM, is_aligned=True)
    spread = stated.distance_mm[np.isfinite(stated.distance_mm)].std()
    assert np.nanmedian(stated.u_mm) == pytest.approx(spread, rel=0.25)


def test_colour_differences_are_those_of_another_library() -> None:
    import colour

    srgb = np.random.default_rng(0).integers(0, 256, (200, 2, 3)).astype(np.uint8)
    mine = de00_of(lab_of(srgb[:, 0]), lab_of(srgb[:, 1]))
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    labs = [colour.XYZ_to_Lab(colour.sRGB_to_XYZ(srgb[:, k] / 255.0), white) for k in range(2)]
    assert mine == pytest.approx(colour.delta_E(*labs, method="CIE 2000"), abs=0.05)
    sharma = np.array([[50.0, 2.6772, -79.7751]]), np.array([[50.0, 0.0, -82.7485]])
    assert de00_of(*sharma) == pytest.approx([2.0425], abs=1e-4)  # Sharma, Wu, Dalal 2005, table 1, pair 1


def test_false_discoveries_are_as_rare_as_stated() -> None:
    rng = np.random.default_rng(3)
    shares = []
    for _ in range(40):
        p = np.concatenate([rng.uniform(size=4000), rng.uniform(size=300) * 1e-4])
        marked = discoveries(p)
        shares.append(marked[:4000].sum() / max(1, marked.sum()))
    assert 0.02 < np.mean(shares) < 0.06
    assert not discoveries(np.full(5, np.nan)).any()


def test_the_command_writes_maps_that_a_foreign_reader_reads(head: Head, before: Path, tmp_path: Path) -> None:
    after = head.write(tmp_path / "after.ply", 2, dented=True)
    run = CliRunner().invoke(app, ["compare", str(before), str(after), "--out", str(tmp_path / "out"), "--json"])
    assert run.exit_code == 0, run.output
    told = json.loads((tmp_path / "out/comparison.json").read_text())
    loaded = trimesh.load(tmp_path / "out/maps.ply", process=False)
    maps = loaded.metadata["_ply_raw"]["vertex"]["data"]
    assert maps["shape_changed"].sum() == told["shape"]["changed"] > 0
    assert np.median(maps["distance_mm"][head.dent & (maps["shape_changed"] > 0)]) == pytest.approx(-0.2, abs=0.06)
    assert "<img" in (tmp_path / "out/report.html").read_text()


def test_other_objects_and_units_are_refused(head: Head, before: Path, tmp_path: Path) -> None:
    points = np.array(head.mesh.vertices)
    trimesh.Trimesh(points / 25.4, head.mesh.faces, process=False).export(tmp_path / "inches.ply")
    trimesh.creation.box((90, 70, 12)).subdivide_to_size(1.5).export(tmp_path / "box.ply")
    for name, said in (("inches.ply", "another unit"), ("box.ply", "no motion brings")):
        with pytest.raises(InputError, match=said):
            compare(before, tmp_path / name, "mm", None, is_aligned=False, say=silent)


# -- hollows ----------------------------------------------------------------------------------------------------

DEEP_MM, SEEN_TO_MM = 5.0, 3.0


def grooved_plate(
    path: Path, seed: int, *, half_mm: float = 1.5, seen_to_mm: float = 99.0, lower_mm: float = 0.0
) -> Path:
    """A plate of 40 mm, whose points are 0.5 mm apart, with a groove of twice `half_mm`. Of its walls and its
    ground only what is less deep than `seen_to_mm` was seen. A part of the ground is lower by `lower_mm`."""
    down = np.arange(0.5, DEEP_MM, 0.5)
    along = np.arange(-20.0, 20.1, 0.5)
    left = [*((x, 0.0) for x in np.arange(-20.0, 0.1 - half_mm, 0.5)), *((-half_mm, -z) for z in down)]
    ground = [(x, -DEEP_MM) for x in np.arange(-half_mm, half_mm + 0.1, 0.5)]
    profile = np.array([*left, *ground, *((-x, z) for x, z in left[::-1])])
    points = np.stack(
        [np.repeat(profile[:, 0], len(along)), np.tile(along, len(profile)), np.repeat(profile[:, 1], len(along))],
        axis=1,
    )
    points[(points[:, 2] == -DEEP_MM) & (np.abs(points[:, 1]) < 4.0), 2] -= lower_mm
    points += np.random.default_rng(seed).normal(0, NOISE_MM, points.shape)
    corner = (np.arange(len(profile) - 1)[:, None] * len(along) + np.arange(len(along) - 1)).ravel()
    other = corner + len(along)
    faces = np.concatenate([np.stack(f, 1) for f in ((corner, other, other + 1), (corner, other + 1, corner + 1))])
    mesh = trimesh.Trimesh(points, faces[(points[faces, 2] > -seen_to_mm).all(axis=1)], process=False)
    mesh.remove_unreferenced_vertices()
    mesh.export(path)
    return path


def test_the_ground_of_a_groove_that_one_scan_has_not_seen_is_not_compared(tmp_path: Path) -> None:
    before = grooved_plate(tmp_path / "before.ply", 1)
    after = grooved_plate(tmp_path / "after.ply", 2, seen_to_mm=SEEN_TO_MM)
    compared = compare(before, after, "mm", None, is_aligned=True, say=silent)
    assert compared.shape_regions == ()
    is_ground = np.abs(compared.before.points_mm[:, 2] + DEEP_MM) < 0.2
    assert np.isnan(compared.distance_mm[is_ground]).all()
    assert np.isfinite(compared.distance_mm[np.abs(compared.before.points_mm[:, 0]) > 3.0]).mean() > 0.99
    assert any("for example in hollows that were not seen" in words for words in remarks(compared))


def test_a_change_of_the_ground_of_a_groove_that_both_scans_have_seen_is_found(tmp_path: Path) -> None:
    before = grooved_plate(tmp_path / "before.ply", 1, half_mm=4.0)
    after = grooved_plate(tmp_path / "after.ply", 2, half_mm=4.0, lower_mm=0.5)
    compared = compare(before, after, "mm", None, is_aligned=True, say=silent)
    region = compared.shape_regions[0]
    assert abs(region.middle_mm[2] + DEEP_MM) < 0.5
    assert region.distance_mm == pytest.approx(-0.5, abs=0.2)
