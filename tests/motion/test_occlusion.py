"""Robot shadow: patches, what hides an LED from them, and what the camera sees; against closed forms, against an
independent checker, and against dense sampling."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from cells import REPO, CellFolder
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from coupole.geometry import apply, inverse, look_at
from coupole.motion.itinerary import plan_itinerary
from coupole.motion.occlusion import (
    AWAY,
    BY_ARM,
    BY_OBJECT,
    BY_TOOL,
    RAY_START_MM,
    REACHED,
    Occlusion,
    Occlusions,
    Sight,
    blocked_segments,
    hidden_by,
    occlusions_of,
    own_codes,
    ray_mesh,
    ray_starts,
    segment_distance_mm,
)
from coupole.motion.patches import patches_at, patches_of
from coupole.preflight.job import Job, read_job

Points = NDArray[np.float64]
POINT = st.tuples(*[st.floats(-1000, 1000)] * 3).map(np.array)
DOWN = np.array((0.0, 0.0, -1.0))
NO_MESH = np.zeros((0, 3, 3))


def corners_of(mesh: trimesh.Trimesh) -> Points:
    return np.asarray(mesh.vertices, float)[mesh.faces]


def sphere(radius_mm: float) -> Points:
    return corners_of(trimesh.creation.icosphere(subdivisions=4, radius=radius_mm))


def floor_with_wall() -> Points:
    """A floor of 400 mm square at z = 0, and on it a wall of 100 mm in the plane x = 0."""
    y, z = 200.0, 100.0
    quads = [
        [(-200, -y, 0), (200, -y, 0), (200, y, 0), (-200, y, 0)],
        [(0, -y, 0), (0, y, 0), (0, y, z), (0, -y, z)],
    ]
    return np.array([[q[i] for i in turn] for q in quads for turn in ((0, 1, 2), (0, 2, 3))], float)


@pytest.fixture(scope="module")
def demo() -> Job:
    return read_job(REPO / "configs/plans/demo.yaml")


@pytest.fixture(scope="module")
def demo_shadows(demo: Job) -> Occlusions:
    return occlusions_of(demo.cell.rig, demo.cell.leds, demo.shape.corners_mm, demo.shape.dose_points_mm)


# -- patches --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("corners", [sphere(50.0), floor_with_wall()], ids=["sphere", "floor with wall"])
def test_patches_share_the_surface_evenly(corners: Points) -> None:
    patches = patches_of(corners, 200)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert len(patches.areas_mm2) == 200
    assert patches.areas_mm2.sum() == pytest.approx(np.linalg.norm(across, axis=1).sum() / 2)
    assert patches.areas_mm2.max() < 2 * patches.areas_mm2.min()


def test_a_patch_faces_outwards_and_its_point_lies_on_the_surface() -> None:
    patches = patches_of(sphere(50.0), 300)
    assert np.abs(np.linalg.norm(patches.points_mm, axis=1) - 50).max() < 0.2
    assert np.einsum("pk,pk->p", patches.points_mm / 50, patches.normals).min() > 0.98


def test_a_patch_is_as_compact_as_its_area_allows() -> None:
    corners = floor_with_wall()
    patches = patches_of(corners, 200)
    width_mm = np.sqrt(patches.areas_mm2.mean())
    somewhere = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners)).triangles_center
    assert np.isin(np.arange(200), patches.piece_patch).all()
    nearest = np.linalg.norm(somewhere[:, None] - patches.points_mm, axis=2).min(axis=1)
    assert nearest.max() < 1.5 * width_mm


def test_the_two_sides_of_a_thin_plate_are_different_patches() -> None:
    plate = corners_of(trimesh.creation.box(extents=(200.0, 200.0, 1.0)))
    flat = patches_of(plate, 200).normals[:, 2]
    assert np.mean(np.abs(flat) > 0.99) > 0.9
    assert np.mean(flat > 0.99) == pytest.approx(np.mean(flat < -0.99), abs=0.1)


def test_the_same_mesh_gives_the_same_patches() -> None:
    first, again = patches_of(sphere(30.0), 100), patches_of(sphere(30.0), 100)
    assert np.array_equal(first.points_mm, again.points_mm)
    assert np.array_equal(first.piece_patch, again.piece_patch)


def test_triangles_without_area_belong_to_no_patch() -> None:
    corners = np.concatenate([np.ones((1, 3, 3)), sphere(30.0)])
    patches = patches_of(corners, 50)
    assert patches.of_triangles(len(corners))[0] == -1
    assert patches.of_triangles(len(corners))[1:].min() >= 0
    assert len(patches_of(np.ones((4, 3, 3)), 50).points_mm) == 0


# -- the object's own shadow --------------------------------------------------------------------------------------


def test_a_sphere_is_lit_up_to_the_circle_where_the_leds_rays_graze_it() -> None:
    radius_mm, led_mm = 50.0, np.array((0.0, 300.0, 0.0))
    corners = sphere(radius_mm)
    patches = patches_of(corners, 400)
    codes = own_codes(patches, ray_mesh(corners), led_mm[None], -led_mm[None] / 300)[:, 0]
    height = patches.points_mm @ led_mm / 300  # a point is lit where its height is more than r^2 / d
    sure = np.abs(height - radius_mm**2 / 300) > 1.0
    assert np.array_equal((codes == REACHED)[sure], (height > radius_mm**2 / 300)[sure])


def test_a_walls_shadow_ends_where_the_line_over_its_edge_meets_the_floor() -> None:
    corners = floor_with_wall()
    patches = patches_of(corners, 600)
    led_mm = np.array((-300.0, 0.0, 400.0))
    codes = own_codes(patches, ray_mesh(corners), led_mm[None], DOWN[None])[:, 0]
    x = patches.points_mm[:, 0]
    floor = (patches.points_mm[:, 2] < 1e-6) & (np.abs(patches.points_mm[:, 1]) < 100)
    edge_mm = 300 * 100 / (400 - 100)  # similar triangles
    behind = floor & (x > 1) & (x < edge_mm - 1)
    assert behind.sum() > 20
    assert set(codes[behind]) == {BY_OBJECT}
    assert set(codes[floor & ((x < -1) | (x > edge_mm + 1))]) == {REACHED}
    assert set(codes[patches.normals[:, 0] > 0.99]) == {AWAY}  # the wall's front


def test_nothing_is_lit_from_behind_an_led() -> None:
    patches = patches_at([(0, 0, 0)])
    codes = own_codes(
        patches, ray_mesh(NO_MESH), np.array([(0.0, 0, 500), (0.0, 0, 500)]), np.array([DOWN, -DOWN])
    )
    assert codes.tolist() == [[REACHED, AWAY]]


# -- arm and tool -------------------------------------------------------------------------------------------------


@settings(max_examples=200, deadline=None)
@given(POINT, POINT, POINT, POINT)
def test_segments_are_as_far_apart_as_their_nearest_samples(p: Points, q: Points, a: Points, b: Points) -> None:
    share = np.linspace(0, 1, 101)[:, None]
    sampled = np.linalg.norm((p + share * (q - p))[:, None] - (a + share * (b - a)), axis=2).min()
    between = (np.linalg.norm(q - p) + np.linalg.norm(b - a)) / 200
    found = segment_distance_mm(p, q, a, b)
    assert sampled - between - 1e-5 <= found <= sampled + 1e-5  # 10 nm, of lines that are almost parallel


@settings(max_examples=200, deadline=None)
@given(POINT, POINT, POINT, POINT)
def test_a_segments_distance_does_not_depend_on_the_order_of_ends(
    p: Points, q: Points, a: Points, b: Points
) -> None:
    found = segment_distance_mm(p, q, a, b)
    for other in ((q, p, a, b), (p, q, b, a), (a, b, p, q)):
        assert segment_distance_mm(*other) == pytest.approx(found, abs=1e-5)


@settings(max_examples=100, deadline=None)
@given(POINT, POINT, st.floats(0.01, 1), st.floats(-3, 3), st.floats(0, 500))
def test_parallel_segments_and_points_are_as_far_apart_as_reckoned(
    p: Points, q: Points, length: float, offset: float, apart_mm: float
) -> None:
    along = q - p
    if np.linalg.norm(along) < 1:
        return
    aside = np.cross(along, np.roll(along, 1) + np.array((0, 0, 1.0)))
    aside = aside / np.linalg.norm(aside) * apart_mm if np.linalg.norm(aside) > 1e-3 else np.zeros(3)
    a, b = p + offset * along + aside, p + (offset + length) * along + aside
    gap = max(0.0, offset - 1, -(offset + length)) * np.linalg.norm(along)
    assert segment_distance_mm(p, q, a, b) == pytest.approx(np.hypot(gap, np.linalg.norm(aside)), abs=1e-3)
    to_point = max(0.0, offset - 1, -offset) * np.linalg.norm(along)
    assert segment_distance_mm(p, q, a, a) == pytest.approx(np.hypot(to_point, np.linalg.norm(aside)), abs=1e-3)


def test_a_capsule_between_patch_and_led_hides_it_as_far_as_its_radius_reaches() -> None:
    start, leds = np.zeros((1, 3)), np.array([(0.0, y, 1000) for y in range(-300, 301, 10)])
    axis = np.array([[(-200.0, 0, 500), (200, 0, 500)]])
    hidden = hidden_by(start, leds, axis, np.array([60.0]), np.ones((1, len(leds)), bool))[0] >= 0
    # the ray to (0, y, 1000) passes the axis at 500 sin(its angle) mm
    expected = 500 * np.abs(leds[:, 1]) / np.hypot(leds[:, 1], 1000) <= 60
    assert np.array_equal(hidden, expected)
    assert 0 < hidden.sum() < len(leds)


def test_shadows_are_those_that_an_independent_checker_finds(
    demo: Job, demo_shadows: Occlusions, scale: Callable[[int, int], int]
) -> None:
    import fcl
    from arms import KR10, KR10_R1100_SIXX

    from coupole.kinematics import link_frames
    from coupole.motion.bodies import capsules_of

    rig, patches, leds_mm = demo.cell.rig, demo_shadows.patches, demo_shadows.leds_mm
    view = demo.schedule.views[1]
    visit = plan_itinerary([view], rig, demo.motion.bodies, rig.motion.home_joints_deg).visits[0]
    assert visit is not None
    shadow = demo_shadows.at(visit.joints_deg)
    frames = inverse(rig.support.base_from_support.matrix()) @ link_frames(KR10_R1100_SIXX, visit.joints_deg)
    arm = [(c.link, c.start_mm, c.end_mm, c.radius_mm) for c in capsules_of(KR10)]
    tool = [(7, body.from_mm, body.to_mm, body.radius_mm) for body in rig.tool]

    def capsule(link: int, start: Points, end: Points, radius_mm: float) -> object:
        start, end = apply(frames[link], start), apply(frames[link], end)
        return _standing(fcl.Capsule(radius_mm, max(float(np.linalg.norm(end - start)), 1e-9)), start, end)

    bodies = {BY_ARM: [capsule(*body) for body in arm], BY_TOOL: [capsule(*body) for body in tool]}
    corners = demo.shape.corners_mm.astype(np.float32).astype(float)
    model = fcl.BVHModel()
    model.beginModel(3 * len(corners), len(corners))
    model.addSubModel(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    model.endModel()
    bodies[BY_OBJECT] = [fcl.CollisionObject(model)]

    random, starts_mm, compared = np.random.default_rng(3), ray_starts(patches), dict.fromkeys(range(5), 0)
    for code in range(5):
        at, of = np.nonzero(shadow.codes == code)
        for k in random.choice(len(at), scale(60, 2000)):
            start, led = starts_mm[at[k]], leds_mm[of[k]]
            ray = _standing(fcl.Cylinder(1e-4, float(np.linalg.norm(led - start))), start, led)
            hits = {
                by: any(fcl.collide(ray, o, fcl.CollisionRequest(), fcl.CollisionResult()) for o in objects)
                for by, objects in bodies.items()
            }
            expected = next((by for by in (BY_OBJECT, BY_ARM, BY_TOOL) if hits[by]), REACHED)
            if (led - start) @ patches.normals[at[k]] <= 0:
                expected = AWAY
            assert code == expected, (at[k], of[k])
            compared[code] += 1
    assert min(compared.values()) >= 60


def _standing(shape: object, start: Points, end: Points) -> object:
    """A shape along z, moved to stand from one point to the other."""
    import fcl

    turn = np.eye(3)
    if np.linalg.norm(end - start) > 0:
        turn = trimesh.geometry.align_vectors((0, 0, 1), end - start)[:3, :3]
    return fcl.CollisionObject(shape, fcl.Transform(turn, (start + end) / 2))


# -- what the camera sees, and what follows -----------------------------------------------------------------------


def test_a_point_on_the_axis_lies_in_the_middle_and_the_support_s_z_points_up() -> None:
    sight = Sight(look_at((0, 0, 30), 335, 40, 45), 850.0, 512, 384)
    pixels, depth_mm = sight.project([(0, 0, 30), (0, 0, 60)])
    assert pixels[0] == pytest.approx((255.5, 191.5))
    assert depth_mm[0] == pytest.approx(335)
    assert pixels[1, 0] == pytest.approx(255.5)
    assert pixels[1, 1] < 191.5


def test_of_a_sphere_the_camera_sees_the_cap_that_its_rays_graze(demo: Job) -> None:
    radius_mm, distance_mm = 30.0, 335.0
    rig, view = demo.cell.rig, demo.schedule.views[0]
    assert view.support_from_camera is not None
    center_mm = np.array(view.target_mm)
    found = occlusions_of(rig, demo.cell.leds, sphere(radius_mm) + center_mm, [])
    visit = plan_itinerary([view], rig, None, rig.motion.home_joints_deg).visits[0]
    assert visit is not None
    towards = (view.support_from_camera[:3, 3] - center_mm) / distance_mm
    height = (found.patches.points_mm - center_mm) @ towards
    sure = np.abs(height - radius_mm**2 / distance_mm) > 1.0
    assert np.array_equal(found.at(visit.joints_deg).is_seen[sure], (height > radius_mm**2 / distance_mm)[sure])


def test_what_is_out_of_the_picture_is_not_seen(demo: Job) -> None:
    rig, view = demo.cell.rig, demo.schedule.views[0]
    assert view.support_from_camera is not None
    visit = plan_itinerary([view], rig, None, rig.motion.home_joints_deg).visits[0]
    assert visit is not None
    far_right = apply(view.support_from_camera, [(x, 0, 335) for x in (-110, -90, 0, 90, 110)])
    seen = occlusions_of(rig, demo.cell.leds, NO_MESH, far_right).at(visit.joints_deg).is_seen
    assert seen.tolist() == [False, True, True, True, False]  # 512 x 44 um at 39.1 mm: 193 mm wide


def test_the_share_of_an_led_counts_only_what_the_camera_sees() -> None:
    codes = np.array([[REACHED, AWAY, BY_ARM], [BY_ARM, BY_TOOL, REACHED], [REACHED, REACHED, REACHED]], np.uint8)
    shadow = Occlusion(codes, np.array([True, True, False]), np.array([3.0, 1.0, 10.0]))
    assert shadow.share() == pytest.approx([0.75, 0.0, 0.25])
    assert shadow.share(BY_ARM) == pytest.approx([0.25, 0.0, 0.75])
    assert shadow.occluded_leds().tolist() == [False, True, False]


def test_no_led_is_useless_to_a_camera_that_sees_nothing() -> None:
    shadow = Occlusion(np.full((2, 3), AWAY, np.uint8), np.zeros(2, bool), np.ones(2))
    assert not shadow.occluded_leds().any()
    assert not shadow.share().any()


def test_without_a_mesh_the_targets_stand_for_the_object(cell: CellFolder) -> None:
    cell.write(object={"id": "no-mesh"})
    job = read_job(cell.plan)
    shadows = occlusions_of(job.cell.rig, job.cell.leds, job.shape.corners_mm, job.shape.dose_points_mm)
    rig = job.cell.rig
    visit = plan_itinerary(job.schedule.views, rig, None, rig.motion.home_joints_deg).visits[0]
    assert visit is not None
    shadow = shadows.at(visit.joints_deg)
    assert shadow.is_seen.tolist() == [True]
    assert set(np.unique(shadow.codes)) <= {REACHED, BY_ARM, BY_TOOL}
    assert shadow.share().mean() > 0.8


def test_what_is_stored_of_a_shadow_reads_back_as_plain_arrays(demo_shadows: Occlusions, tmp_path: Path) -> None:
    shadow = demo_shadows.at(np.array((0.0, -120, 120, 0, -90, 0)))
    with h5py.File(tmp_path / "shadow.h5", "w") as file:
        for name, values in shadow.arrays(demo_shadows.patches).items():
            file.create_dataset(name, data=values)
    with h5py.File(tmp_path / "shadow.h5") as file:
        assert file["codes"].dtype == np.uint8
        assert file["codes"].shape == (400, 1080)
        assert file["seen"].shape == (400,)
        assert np.array_equal(file["codes"][()], shadow.codes)
        assert np.linalg.norm(file["normals"][()], axis=1) == pytest.approx(1.0, abs=1e-6)


def test_a_step_of_the_surface_hides_what_is_higher_than_the_rays_start() -> None:
    wall = np.array([[(5.0, -50, 0), (5, 50, 0), (5, 0, 20)]])
    led = np.array([(1000.0, 0, 0.2)])
    low = patches_at([(0, 0, 0)])
    assert ray_starts(low)[0, 2] == RAY_START_MM
    assert blocked_segments(ray_mesh(wall), ray_starts(low), led).tolist() == [True]
    assert blocked_segments(ray_mesh(wall - (0, 0, 20.0)), ray_starts(low), led).tolist() == [False]
