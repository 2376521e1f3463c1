"""Bodies and distances, against shapes that can be reckoned by hand and against an independent checker."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from arms import KR10, KR10_R1100_SIXX
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from places import SHARED_DATA

from coupole.geometry import apply, inverse, transform
from coupole.kinematics import forward, link_frames
from coupole.motion.bodies import Capsule, capsules_of
from coupole.motion.collisions import CellBodies, Clearances, Surroundings
from coupole.motion.sphere_tree import MESH_STEP_MM, spheres_of, surface_points

LINK_MESHES = SHARED_DATA / "robot/kr10r1100sixx"
BASE_FROM_SUPPORT = transform((200, 0, 1450), (0, 0, 180))
TOOL = (Capsule("camera", 7, (0, 0, 20), (0, 0, 100), 60),)
LOW, HIGH = np.array(KR10_R1100_SIXX.limits_deg).T
STRETCHED = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
ANYWHERE = st.tuples(*(st.floats(low, high) for low, high in KR10_R1100_SIXX.limits_deg)).map(np.array)


@cache
def cell(
    box_mm: tuple[float, float, float] | None = None, *, link_meshes: bool = False, **clearances: float
) -> CellBodies:
    """The simulated cell with a box in the middle of the support, and two keep-out volumes."""
    points = surface_points(box_corners(box_mm)) if box_mm else np.zeros((0, 3))
    around = Surroundings(
        BASE_FROM_SUPPORT,
        740.0,
        1500.0,
        74.0,
        points,
        (("sphere", (300.0, 200.0, 100.0), 120.0),),
        (("block", (-600.0, -500.0, 0.0), (-400.0, -300.0, 200.0)),),
    )
    return CellBodies(KR10, around, TOOL, Clearances(**clearances), LINK_MESHES if link_meshes else None)


def box_corners(size_mm: tuple[float, float, float]) -> NDArray[np.float64]:
    """A box on the support, centred, as triangles."""
    import trimesh

    mesh = trimesh.creation.box(extents=size_mm)
    corners: NDArray[np.float64] = mesh.vertices[mesh.faces] + np.array((0, 0, size_mm[2] / 2))
    return corners


@given(ANYWHERE)
def test_the_last_link_frame_is_the_flange(joints: NDArray[np.float64]) -> None:
    assert np.abs(link_frames(KR10_R1100_SIXX, joints)[7] - forward(KR10_R1100_SIXX, joints)).max() < 1e-9


@pytest.mark.skipif(not LINK_MESHES.is_dir(), reason="the vendor's link meshes are not at hand")
@pytest.mark.parametrize("link", range(7))
def test_the_capsules_of_a_link_enclose_its_mesh(link: int) -> None:
    import trimesh

    name = "base_link" if link == 0 else f"link_{link}"
    mesh = trimesh.load(LINK_MESHES / f"{name}.stl", process=False, force="mesh")
    points = 1000 * np.concatenate([mesh.vertices, trimesh.sample.sample_surface(mesh, 5000, seed=1)[0]])
    outside = np.full(len(points), np.inf)
    for capsule in (c for c in capsules_of(KR10) if c.link == link):
        start, end = np.array(capsule.start_mm, float), np.array(capsule.end_mm, float)
        along = end - start
        share = np.clip((points - start) @ along / max(along @ along, 1e-9), 0, 1)
        outside = np.minimum(
            outside, np.linalg.norm(points - start - share[:, None] * along, axis=1) - capsule.radius_mm
        )
    assert outside.max() <= 0.5


def test_surface_points_lie_dense_on_the_surface() -> None:
    corners = box_corners((100.0, 60.0, 40.0))
    points = surface_points(corners)
    random = np.random.default_rng(1)
    weights = random.dirichlet((1, 1, 1), 1500)
    somewhere = np.einsum("nk,nkj->nj", weights, corners[random.integers(0, len(corners), 1500)])
    nearest = np.min(np.linalg.norm(somewhere[:, None] - points[None], axis=2), axis=1)
    assert nearest.max() <= MESH_STEP_MM


def test_the_camera_above_a_box_is_as_far_as_geometry_says() -> None:
    bodies = cell((100.0, 100.0, 50.0), object_mm=50.0)
    pose = BASE_FROM_SUPPORT @ transform((0, 0, 420), (0, 0, 180))  # flange 420 mm above the disk, looking down
    from coupole.kinematics import inverse as solve

    joints = solve(KR10_R1100_SIXX, pose)[0]
    margin = bodies.margins(joints)[("camera", "the object")][0]
    true = 420 - 100 - 60 - 50 - 50  # axis end, radius, box height, what must be kept
    assert true - MESH_STEP_MM - 1 <= margin <= true


def test_an_arm_through_the_support_is_named() -> None:
    contacts = cell().contacts((0.0, -90.0, 0.0, 0.0, 0.0, 0.0))
    assert any(contact.other_name == "the support" and contact.distance_mm < 0 for contact in contacts)


def test_a_keep_out_box_that_only_link_1_enters_is_named_with_it() -> None:
    """Link 1 turns with axis 1: its capsule sweeps a ring round the axis that no other link comes near."""
    home_deg = (0.0, -170.0, 150.0, 0.0, -70.0, 0.0)
    (capsule,) = (c for c in capsules_of(KR10) if c.link == 1 and c.start_mm[1] < -50)
    middle = apply(link_frames(KR10_R1100_SIXX, home_deg)[1], capsule.start_mm)
    outwards = middle - link_frames(KR10_R1100_SIXX, home_deg)[1][:3, 3]
    middle = middle + outwards / np.linalg.norm(outwards) * (capsule.radius_mm - 15.0)
    at_mm = apply(inverse(BASE_FROM_SUPPORT), middle)
    box = ("shelf", tuple(at_mm - 10.0), tuple(at_mm + 10.0))
    around = Surroundings(BASE_FROM_SUPPORT, 740.0, 1500.0, 74.0, np.zeros((0, 3)), (), (box,))
    bodies = CellBodies(KR10, around, TOOL, Clearances())
    touching = [contact.body for contact in bodies.contacts(home_deg) if contact.other_name == "keep-out `shelf`"]
    assert touching == ["link 1"]
    turned_deg = np.array((60.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    swept = bodies.contact_on_the_way(np.array(home_deg) - turned_deg, np.array(home_deg) + turned_deg)
    assert swept is not None
    assert swept.body == "link 1"


def test_an_arm_through_the_dome_is_named() -> None:
    contacts = cell().contacts(STRETCHED)
    around = apply(inverse(BASE_FROM_SUPPORT), link_frames(KR10_R1100_SIXX, STRETCHED)[7][:3, 3])
    assert np.linalg.norm(around) > 1300
    assert any(contact.other_name == "the dome" for contact in contacts)


def test_a_message_names_both_bodies_the_distance_and_what_must_be_kept() -> None:
    contact = cell().contacts((0.0, -90.0, 0.0, 0.0, 0.0, 0.0))[0]
    assert str(contact).startswith(f"{contact.body} would be ")
    assert f"{contact.required_mm:g} mm must be kept" in str(contact)


@settings(max_examples=60, deadline=None)
@given(ANYWHERE, ANYWHERE)
def test_a_motion_that_is_called_clear_is_clear_at_every_place(
    start: NDArray[np.float64], end: NDArray[np.float64]
) -> None:
    bodies = cell((300.0, 200.0, 200.0))
    end = start + 0.2 * (end - start)
    if bodies.contact_on_the_way(start, end) is None:
        places = start + np.linspace(0, 1, 400)[:, None] * (end - start)
        assert bodies.tightest_mm(places).min() >= 0


@settings(max_examples=60, deadline=None)
@given(ANYWHERE, st.integers(0, 5), st.floats(-3, 3))
def test_no_margin_changes_faster_than_the_arm_can_move(joints: NDArray[np.float64], axis: int, by: float) -> None:
    bodies = cell((300.0, 200.0, 200.0))
    moved = joints.copy()
    moved[axis] += by
    before, after = bodies.margins(joints), bodies.margins(moved)
    for pair, margin in before.items():
        assert abs(float(after[pair][0] - margin[0])) <= np.radians(abs(by)) * bodies.reach_mm[axis] + 1e-6


@pytest.mark.skipif(not LINK_MESHES.is_dir(), reason="the vendor's link meshes are not at hand")
@pytest.mark.parametrize("meshes", [False, True])
def test_margins_never_exceed_the_distance_that_an_independent_checker_finds(meshes: bool) -> None:
    import fcl
    import trimesh

    corners = box_corners((300.0, 200.0, 250.0))
    bodies = cell((300.0, 200.0, 250.0), link_meshes=meshes, object_mm=0.0)
    taken_closer_mm = []
    box = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners))
    box_object = fcl.CollisionObject(_fcl_mesh(box.vertices, box.faces))
    links = {}
    for link in range(2, 7):
        mesh = trimesh.load(LINK_MESHES / f"link_{link}.stl", process=False, force="mesh")
        links[link] = fcl.CollisionObject(_fcl_mesh(1000 * mesh.vertices, mesh.faces))
    random = np.random.default_rng(4)
    for _ in range(60):
        joints = random.uniform(LOW, HIGH)
        frames = inverse(BASE_FROM_SUPPORT) @ link_frames(KR10_R1100_SIXX, joints)
        margins = bodies.margins(joints)
        for link, moving in links.items():
            moving.setTransform(fcl.Transform(frames[link][:3, :3], frames[link][:3, 3]))
            distance = fcl.distance(moving, box_object, fcl.DistanceRequest(), fcl.DistanceResult())
            margin = float(margins[(f"link {link}", "the object")][0])
            if margin > 0:
                assert distance >= margin
                taken_closer_mm.append(distance - margin)
    assert len(taken_closer_mm) > 50
    assert np.median(taken_closer_mm) < (20.0 if meshes else 60.0)


@given(ANYWHERE)
def test_solids_are_as_far_as_an_independent_reckoning_says(joints: NDArray[np.float64]) -> None:
    bodies = cell(support_mm=0.0, dome_mm=0.0)
    support_from_flange = inverse(BASE_FROM_SUPPORT) @ forward(KR10_R1100_SIXX, joints)
    axis = apply(support_from_flange, np.linspace((0, 0, 20), (0, 0, 100), 200))
    out, height, away = np.hypot(*axis[:, :2].T), axis[:, 2], np.linalg.norm(axis, axis=1)
    beyond = np.maximum(np.array((-600, -500, 0)) - axis, axis - (-400, -300, 200))
    true_mm = {
        "keep-out `sphere`": np.linalg.norm(axis - (300, 200, 100), axis=1) - 120,
        "keep-out `block`": np.where(
            beyond.max(axis=1) > 0, np.linalg.norm(np.maximum(beyond, 0), axis=1), beyond.max(axis=1)
        ),
        "the support": np.where(height > 0, np.hypot(np.maximum(out - 740, 0), height), np.nan),
        "the dome": np.where((away < 1500) & (height < np.tan(np.radians(74)) * out), 1500 - away, np.nan),
    }
    margins = bodies.margins(joints)
    for other, distance_mm in true_mm.items():
        if not np.isnan(distance_mm).any():
            least = distance_mm.min() - TOOL[0].radius_mm
            assert least - 1.0 <= margins[("camera", other)][0] <= least + 0.01


@given(st.integers(0, 2**32 - 1))
def test_the_dome_and_the_support_never_jump(seed: int) -> None:
    from coupole.motion.distances import DISK, DOME, _to_solid

    random = np.random.default_rng(seed)
    figures = np.zeros((1, 13))
    figures[0, 7:10] = (1500.0, np.sin(np.radians(74)), np.cos(np.radians(74)))
    here = random.uniform(-2500, 2500, 3)
    there = here + random.normal(size=3) * 10 ** random.uniform(-2, 2.5)
    for kind in (DISK, DOME):
        change = _to_solid(kind, figures, 0, *there) - _to_solid(kind, figures, 0, *here)
        assert abs(change) <= np.linalg.norm(there - here) + 1e-9


@given(st.integers(0, 2**32 - 1))
def test_balls_cover_the_capsule_that_they_stand_for(seed: int) -> None:
    random = np.random.default_rng(seed)
    ends, radius = random.uniform(-300, 300, (2, 3)), random.uniform(5, 150)
    spheres = spheres_of(ends[None], np.array([radius]))
    along = random.uniform(0, 1, (500, 1))
    directions = random.normal(size=(500, 3))
    outward = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    points = ends[0] + along * (ends[1] - ends[0]) + radius * outward
    inside = np.linalg.norm(points[:, None] - spheres.centers_mm, axis=2) - spheres.radii_mm
    assert inside.min(axis=1).max() <= 1e-9
    assert spheres.radii_mm.max() <= radius + 1.0


def test_what_is_far_away_may_be_said_to_be_no_farther_than_asked() -> None:
    bodies = cell((300.0, 200.0, 200.0))
    joints = np.array((0.0, -170.0, 150.0, 0.0, -70.0, 0.0))
    whole, capped = bodies.margins(joints), bodies.margins(joints, far_mm=30.0)
    for pair, margin in whole.items():
        assert capped[pair][0] == pytest.approx(min(margin[0], 30.0))


def test_a_camera_folded_onto_the_forearm_is_named() -> None:
    contacts = cell(self_mm=10.0).contacts((0.0, -90.0, 60.0, 0.0, 119.0, 0.0))
    assert ("camera", "the arm's link 4") in [(contact.body, contact.other_name) for contact in contacts]


def _fcl_mesh(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> object:
    import fcl

    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(np.ascontiguousarray(vertices), np.ascontiguousarray(faces))
    model.endModel()
    return model
