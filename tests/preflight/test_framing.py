"""The object in the cell and in the pictures, against figures reckoned by hand and textbook formulas."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
import trimesh
from cells import TOP, CellFolder
from numpy.typing import NDArray
from places import REPO

from coupole.geometry import look_at
from coupole.motion.occlusion import ray_mesh, sight_of
from coupole.plan.rig import Rig
from coupole.plan.yamlfile import read_document
from coupole.preflight.framing import (
    SHARP_PX,
    Framing,
    depth_of_field_mm,
    framing_of,
    placement_of,
    surface_samples,
)

RIG, _ = read_document(REPO / "configs/rigs/sim.yaml").problems(Rig)
ABOVE = {**TOP, "target_mm": [0, 0, 0], "azimuth_deg": 0, "elevation_deg": 90}


def seen_of(corners: NDArray[np.float64], *, distance_mm: float, target: tuple[float, float, float]) -> Framing:
    """Framing of a mesh seen by the simulated cell's camera from straight above a target."""
    assert RIG is not None
    sight = sight_of(RIG, look_at(target, distance_mm, -90.0, 90.0))
    sharp_mm = depth_of_field_mm(RIG.lens, RIG.sensor.pixel_pitch_um)
    return framing_of("top", sight, sharp_mm, ray_mesh(corners), surface_samples(corners))


def corners_of(mesh: Any) -> NDArray[np.float64]:
    found: NDArray[np.float64] = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    return found


def slab(width: float, depth: float, z_mm: float = 0.0, x_mm: float = 0.0) -> NDArray[np.float64]:
    """A thin plate."""
    mesh = trimesh.creation.box(extents=(width, depth, 1.0))
    return corners_of(mesh) + np.array((x_mm, 0.0, z_mm - 0.5))


# -- geometry --------------------------------------------------------------------------------------------------


def test_a_sphere_fills_as_much_of_the_field_as_its_tangent_cone() -> None:
    """Radius 40 mm at 335 mm: its outline is a circle of radius c tan(asin(r / d)), c the image distance."""
    seen = seen_of(corners_of(trimesh.creation.icosphere(4, 40.0)), distance_mm=335.0, target=(0, 0, 0))
    image_mm = 35.0 * 335.0 / (335.0 - 35.0)
    radius_mm = image_mm * np.tan(np.arcsin(40.0 / 335.0))
    assert seen.fills == pytest.approx(np.pi * radius_mm**2 / (512 * 0.044 * 384 * 0.044), rel=0.02)
    assert seen.in_field == 1.0
    assert seen.nearest_mm == pytest.approx(295.0, abs=0.5)
    assert 320.0 < seen.farthest_mm < 335.0  # the outline of a sphere lies before its centre
    assert seen.px_per_mm[1] == pytest.approx(image_mm / 0.044 / seen.nearest_mm)


def test_half_a_plate_beside_the_field_is_half_in_the_field() -> None:
    """The field at 335 mm is 193 mm wide: a plate from its middle to as far beyond its edge."""
    half_mm = 0.5 * 512 * 0.044 * 335.0 / (35.0 * 335.0 / 300.0)
    seen = seen_of(slab(2 * half_mm, 60.0, x_mm=0.0), distance_mm=335.0, target=(half_mm, 0, 0))
    assert seen.in_field == pytest.approx(0.5, abs=0.03)


def test_what_another_part_hides_counts_neither_in_nor_out_of_the_field() -> None:
    """A lid over a smaller plate, and another lid beside the field: half of what is visible is in it."""
    parts = slab(100, 80, z_mm=100.0), slab(90, 70, z_mm=50.0), slab(100, 80, z_mm=100.0, x_mm=400.0)
    seen = seen_of(np.concatenate(parts), distance_mm=435.0, target=(0, 0, 0))
    assert seen.in_field == pytest.approx(0.5, abs=0.02)


def test_the_field_is_that_of_the_paper() -> None:
    """Lucat et al. 2025: 14.5 x 19.3 cm at 47 um per pixel; the simulated sensor has an eighth of the pixels."""
    seen = seen_of(slab(400, 400), distance_mm=335.0, target=(0, 0, 0))
    assert seen.fills == 1.0
    assert seen.px_per_mm[0] == pytest.approx(1.0 / (8 * 0.047), rel=0.01)
    assert seen.in_field == pytest.approx(193.0 * 145.0 / 400.0**2, rel=0.08)


@pytest.mark.parametrize(("f_number", "pitch_um"), [(8.0, 5.5), (16.0, 5.5), (8.0, 44.0)])
def test_the_depth_of_field_is_that_of_the_hyperfocal_distance(f_number: float, pitch_um: float) -> None:
    """With H = f^2 / (N c) + f: near = s (H - f) / (H + s - 2 f), far = s (H - f) / (H - s) (any textbook of
    photography)."""
    assert RIG is not None
    lens = RIG.lens.model_copy(update={"f_number": f_number})
    f, s = lens.focal_length_mm, lens.focus_distance_mm
    hyperfocal = f**2 / (f_number * SHARP_PX * pitch_um * 1e-3) + f
    near, far = depth_of_field_mm(lens, pitch_um)
    assert near == pytest.approx(s * (hyperfocal - f) / (hyperfocal + s - 2 * f), rel=1e-9)
    assert far == pytest.approx(s * (hyperfocal - f) / (hyperfocal - s), rel=1e-9)


def test_beyond_the_hyperfocal_distance_everything_is_sharp() -> None:
    assert RIG is not None
    lens = RIG.lens.model_copy(update={"focus_distance_mm": 5000.0, "f_number": 22.0})
    assert depth_of_field_mm(lens, 44.0)[1] == np.inf


def test_a_placement_is_the_meshs_box_and_what_is_over_the_disk() -> None:
    two = np.concatenate([slab(100, 80, z_mm=30.0), slab(20, 20, z_mm=-5.0, x_mm=800.0)])
    placed = placement_of(two, 740.0)
    assert placed.lowest_over_disk_mm == pytest.approx(29.0)
    assert placed.low_mm[2] == pytest.approx(-6.0)
    assert placed.reach_mm == pytest.approx(np.hypot(810.0, 10.0))


# -- what check says --------------------------------------------------------------------------------------------


def checked(cell: CellFolder, code: int) -> dict[str, Any]:
    ended = cells.here("check", cell.plan, "--no-paths", "--json")
    assert ended.code == code, ended.err
    return ended.document


def written(cell: CellFolder, mesh: Any, views: list[dict[str, Any]] | None = None, **about: Any) -> CellFolder:
    mesh.export(cell.folder / "object.ply")
    cell.write(object={"id": "thing", "mesh": "object.ply", **about}, views=views or [ABOVE])
    return cell


def upright_box(size: float = 60.0, scale: float = 1.0) -> Any:
    mesh = trimesh.creation.box(extents=(size, size, size))
    mesh.apply_translation((0, 0, size / 2))
    mesh.apply_scale(scale)
    return mesh


def test_the_document_tells_size_place_and_sharpness(cell: CellFolder) -> None:
    found = checked(written(cell, upright_box()), 0)["object"]
    assert np.allclose(found["low_mm"], (-30, -30, 0), atol=1e-3)
    assert np.allclose(found["high_mm"], (30, 30, 60), atol=1e-3)
    assert found["lowest_over_disk_mm"] == pytest.approx(0.0, abs=1e-3)
    (view,) = found["views"]
    assert view["in_field"] == 1.0
    assert view["nearest_mm"] == pytest.approx(275.0, abs=0.1)


def test_a_mesh_in_metres_read_as_mm_is_refused_with_the_unit_that_fits(cell: CellFolder) -> None:
    ended = cells.here("check", written(cell, upright_box(scale=1e-3)).plan, "--json")
    assert ended.code == 2
    assert "object.mesh_unit: read in mm the object is 0.06 mm large; expected 1 to 2960 mm" in ended.err
    assert "`mesh_unit: m` makes it 60 mm" in ended.err


def test_a_mesh_in_mm_read_as_metres_is_refused_before_it_takes_memory(cell: CellFolder) -> None:
    ended = cells.here("check", written(cell, upright_box(), mesh_unit="m").plan, "--json")
    assert ended.code == 2
    assert "read in m the object is 6e+04 mm large" in ended.err
    assert "`mesh_unit: mm` makes it 60 mm" in ended.err
    assert "plan.yaml:" in ended.err


def test_a_mesh_that_may_have_another_unit_is_warned_of(cell: CellFolder) -> None:
    near = {**ABOVE, "distance_mm": 335}
    warnings = checked(written(cell, upright_box(size=1.4), [near]), 0)["warnings"]
    assert any("it is 1.4 mm large. Is its unit right? `mesh_unit: m` makes it 1400 mm." in w for w in warnings)


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ({"translation_mm": [0, 0, -30]}, "object thing: it reaches 30.0 mm into the disk"),
        ({"abc_deg": [0, 0, 180]}, "object thing: it reaches 60.0 mm into the disk"),
        ({"translation_mm": [900, 0, 0]}, "object thing: it is beside the disk"),
        ({"translation_mm": [300, 0, 0]}, "view top: object thing is out of its field"),
        (
            {"translation_mm": [0, 0, 200]},
            "view top: nothing of object thing is in focus: the visible part is 75 ",
        ),
    ],
    ids=["in-the-disk", "upside-down", "beside-the-disk", "out-of-the-field", "out-of-focus"],
)
def test_an_object_that_no_picture_can_be_made_of_is_refused(
    cell: CellFolder, place: dict[str, Any], words: str
) -> None:
    cell = written(cell, upright_box(), support_from_object=place)
    assert any(refusal.startswith(words) for refusal in checked(cell, 3)["refusals"])


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ({"translation_mm": [0, 0, 12]}, "it begins 12.0 mm above the disk; is it on a stand?"),
        ({"translation_mm": [90, 0, 0]}, "1 of 1 views has part of it out of the field"),
        ({"translation_mm": [-15, 0, 0]}, "1 of 1 views has part of it out of focus"),
    ],
    ids=["hovers", "partly-out-of-the-field", "partly-out-of-focus"],
)
def test_what_may_be_meant_is_warned_of(cell: CellFolder, place: dict[str, Any], words: str) -> None:
    tower = trimesh.creation.box(extents=(50, 50, 160)).apply_translation((30, 0, 80))
    steps = trimesh.util.concatenate([upright_box(), tower])
    warnings = checked(written(cell, steps, support_from_object=place), 0)["warnings"]
    assert any(words in warning for warning in warnings), warnings


def test_a_view_that_lights_nothing_or_takes_no_aim_is_only_warned_of(cell: CellFolder) -> None:
    park = {"kind": "joints", "name": "park", "joints_deg": [0, -170, 150, 0, -70, 0]}
    darks = {**ABOVE, "name": "darks", "target_mm": [300, 0, 0], "lights": {"kind": "none"}}
    found = checked(written(cell, upright_box(), [ABOVE, park, darks]), 0)
    assert sum("is out of its field" in warning for warning in found["warnings"]) == 2


def test_plans_without_a_mesh_say_nothing_of_an_object(cell: CellFolder) -> None:
    cell.write(object={"id": "thing"})
    assert checked(cell, 0)["object"] is None


def test_the_table_fits_a_terminal_of_80_columns(cell: CellFolder) -> None:
    ended = cells.here("check", cell.plan, "--no-paths")
    assert ended.code == 0
    (line,) = (line for line in ended.err.splitlines() if line.split()[:1] == ["top"] and "%" in line)
    assert len(line.rstrip()) <= 80
    assert "100%" in line


WITH_OBJECT = sorted(path for path in (REPO / "configs/plans").glob("*.yaml") if "object:" in path.read_text())


@pytest.mark.parametrize("plan", WITH_OBJECT, ids=lambda path: path.stem)
def test_shipped_plans_show_their_object_whole_and_sharp(plan: Path) -> None:
    ended = cells.here("check", plan, "--no-paths", "--json")
    found = json.loads(ended.out)
    assert [refusal for refusal in found["refusals"] if "storage" not in refusal] == []
    for view in found["object"]["views"]:
        assert view["in_field"] > 0.85
        assert view["in_focus"] > 0.85


def test_a_surface_is_sampled_by_area_whatever_its_triangles() -> None:
    fine = corners_of(trimesh.creation.box(extents=(10, 10, 10)).subdivide().subdivide().subdivide())
    coarse = corners_of(trimesh.creation.box(extents=(10, 10, 10))) + np.array((100.0, 0, 0))
    samples = surface_samples(np.concatenate([fine, coarse]))
    assert np.mean(samples[:, 0] > 50) == pytest.approx(0.5, abs=0.02)
