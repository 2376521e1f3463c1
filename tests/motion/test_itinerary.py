"""From views to ways: what is refused, with the view, the two bodies or the axis, and the figure."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arms import KR10, KR10_R1100_SIXX
from places import REPO, SHARED_DATA

from coupole.errors import InputError
from coupole.geometry import look_at
from coupole.motion.bodies import link_corners
from coupole.motion.collisions import CellBodies
from coupole.motion.itinerary import Itinerary, arm_of, bodies_of, plan_itinerary
from coupole.motion.path_deviation import PATH_TOLERANCE_MM, deviation_at_rest_mm
from coupole.motion.singularities import SINGULARITY_MARGIN
from coupole.plan.led_table import read_led_table
from coupole.plan.rig import Rig
from coupole.plan.schedule import ViewPose
from coupole.plan.yamlfile import read_document
from coupole.preflight.job import read_job

ROOT = REPO
LINK_MESHES = SHARED_DATA / "robot/kr10r1100sixx"
RIG = read_document(ROOT / "configs/rigs/sim.yaml").validate(Rig)
DOME = read_led_table(ROOT / "configs/domes/coupole.csv")
HOME_DEG = RIG.motion.home_joints_deg


def rig_of(**changes: Any) -> Rig:
    return Rig.model_validate({**RIG.model_dump(), **changes})


def bodies(rig: Rig = RIG, box_mm: tuple[float, float, float] = (160.0, 120.0, 60.0)) -> CellBodies:
    """The cell with a box in the middle of the support."""
    import trimesh

    box = trimesh.creation.box(extents=box_mm)
    return bodies_of(rig, DOME, box.vertices[box.faces] + (0, 0, box_mm[2] / 2))


def looking(name: str, distance_mm: float, azimuth_deg: float, elevation_deg: float) -> ViewPose:
    pose = look_at((0, 0, 30), distance_mm, azimuth_deg, elevation_deg)
    return ViewPose(name, pose, None, (0, 0, 30))


def standing(name: str, *joints_deg: float) -> ViewPose:
    return ViewPose(name, None, joints_deg, None)


def planned(*views: ViewPose, rig: Rig = RIG, order: Any = "fastest") -> Itinerary:
    return plan_itinerary(views, rig, bodies(rig), HOME_DEG, order)


def refusal(*views: ViewPose, rig: Rig = RIG) -> str:
    (only,) = planned(*views, rig=rig).refusals
    return only


def test_a_view_that_grazes_the_object_is_refused_with_both_bodies_and_the_distance() -> None:
    said = refusal(looking("fine", 335, -90, 70), looking("close", 120, -90, 60))
    assert (
        found := re.fullmatch(r"view close: camera would be (\d+) mm from the object; 50 mm must be kept", said)
    )
    assert 0 < float(found[1]) < 50


def test_a_view_through_the_dome_is_refused_with_both_bodies_and_the_distance() -> None:
    said = refusal(standing("out", 0, -10, 10, 0, 60, 0))
    assert re.fullmatch(r"view out: \w+( \d)? would be (inside|\d+ mm from) the dome; 20 mm must be kept", said)


def test_a_view_through_a_limit_is_refused_with_axis_and_value() -> None:
    assert refusal(standing("bent", 0, -170, 150, 0, -130, 0)) == (
        "view bent: A5 would be -130.000 deg, its limits are -120 to 120 deg"
    )


def test_a_view_that_folds_the_elbow_onto_the_upper_arm_is_refused() -> None:
    low, high = KR10.posture_limits_deg[2]
    said = refusal(standing("folded", 0, -170, 155.5, 0, -70, 0))
    assert said == f"view folded: A3 would be 155.500 deg, its limits are {low:g} to {high:g} deg"


@pytest.mark.parametrize(
    ("joints_deg", "phrase"),
    [
        (
            (0, -170, 150, 0, -3, 0),
            f"A5 3.0 deg from its singularity; {SINGULARITY_MARGIN.wrist_deg:g} deg must be kept",
        ),
        (
            (0, -90, 5, 0, 60, 0),
            f"A3 1.1 deg from its singularity; {SINGULARITY_MARGIN.elbow_deg:g} deg must be kept",
        ),
        (
            (0, -140, 105.5, 0, -70, 0),
            f"axis 1, the shoulder's singularity; {SINGULARITY_MARGIN.shoulder_mm:g} mm must be",
        ),
    ],
)
def test_a_view_at_a_singularity_is_refused_with_the_figure(joints_deg: tuple[float, ...], phrase: str) -> None:
    itinerary = plan_itinerary([standing("odd", *joints_deg)], RIG, None, HOME_DEG)
    (said,) = itinerary.refusals
    assert said.startswith("view odd: ")
    assert phrase in said


def test_a_view_with_postures_at_a_singularity_and_others_takes_another() -> None:
    itinerary = planned(looking("low", 335, 0, 45))
    assert itinerary.refusals == ()
    assert itinerary.visits[0] is not None
    assert abs(itinerary.visits[0].joints_deg[4]) >= SINGULARITY_MARGIN.wrist_deg


def test_refused_views_are_left_out_of_the_order_and_the_others_chained() -> None:
    views = [looking("a", 335, -90, 70), standing("bent", 0, -170, 150, 0, -130, 0), looking("b", 335, -60, 50)]
    itinerary = planned(*views)
    assert sorted(itinerary.order) == [0, 2]
    assert [visit is None for visit in itinerary.visits] == [False, True, False]


@pytest.mark.parametrize("order", ["fastest", "as_written"])
def test_a_view_that_is_hemmed_in_is_refused_alone_and_says_by_what(order: str) -> None:
    plates = [
        {"kind": "box", "name": name, "min_mm": (540, y, 590), "max_mm": (940, y + 20, 810)}
        for name, y in (("left", -141), ("right", 121))
    ]
    rig = rig_of(keep_out=plates)
    itinerary = planned(
        looking("a", 335, -90, 60),
        standing("hemmed", 0, -60, 60, 0, 60, 0),
        looking("b", 335, -60, 50),
        rig=rig,
        order=order,
    )
    assert sorted(itinerary.order) == [0, 2]
    (said,) = itinerary.refusals
    assert re.match(
        r"view hemmed: no path to it was found from [\w ]+: \w+ would be .* keep-out `(left|right)`;", said
    )


def test_each_leg_begins_where_the_one_before_it_in_the_order_ends() -> None:
    views = [looking(f"v{k}", 335, azimuth, 50) for k, azimuth in enumerate((-60, 60, -30, 30))]
    itinerary = planned(*views)
    cell, here = bodies(), np.array(HOME_DEG)
    for index in itinerary.order:
        visit = itinerary.visits[index]
        assert visit is not None
        for there in visit.leg.waypoints:
            assert cell.contact_on_the_way(here, there) is None
            here = there
        assert np.array_equal(here, visit.joints_deg)


def test_views_are_visited_as_written_where_the_plan_says_so() -> None:
    views = [looking(f"v{k}", 335, azimuth, 50) for k, azimuth in enumerate((-60, 60, -30))]
    assert planned(*views, order="as_written").order == (0, 1, 2)


def test_a_home_beyond_a_limit_is_refused() -> None:
    motion = {**RIG.motion.model_dump(), "home_joints_deg": (0, -200, 150, 0, -70, 0)}
    said = refusal(looking("a", 335, -90, 70), rig=rig_of(motion=motion))
    assert said == "rig: at home A2 would be -200.000 deg, its limits are -190 to 45 deg"


def test_the_watch_over_the_way_reaches_as_far_as_the_tool() -> None:
    pole = {"name": "pole", "from_mm": (0, 0, 0), "to_mm": (0, 0, 360), "radius_mm": 5}
    short, long = bodies().reach_mm, bodies(rig_of(tool=[pole])).reach_mm
    assert np.all(long[:5] > short[:5] + 200.0)
    off_mm = deviation_at_rest_mm([np.zeros(6)], np.array([0, 0, 0, 0, 0.1, 0]), np.zeros(6), long, 0.0)
    assert off_mm > np.radians(0.1) * (360 + 80)


def test_no_clearance_is_less_than_what_the_watch_over_the_way_lets_pass() -> None:
    nothing_kept = rig_of(clearances=dict.fromkeys(("object_mm", "support_mm", "dome_mm"), 0.0))
    kept, wide = bodies(nothing_kept), bodies(RIG)
    joints = np.array(HOME_DEG)
    for pair in (("camera", "the support"), ("camera", "the object")):
        given_up = float(kept.margins(joints)[pair][0] - wide.margins(joints)[pair][0])
        required = {"the support": 10.0, "the object": 50.0}[pair[1]]
        assert 0 < required - given_up <= PATH_TOLERANCE_MM


def test_the_arms_limits_lie_within_the_data_sheets() -> None:
    for (low, high), (lowest, highest) in zip(arm_of(RIG).limits_deg, KR10_R1100_SIXX.limits_deg, strict=True):
        assert lowest <= low < high <= highest


def test_a_folder_without_the_links_meshes_is_an_input_error_that_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"base_link\.stl: expected the mesh of link 0"):
        link_corners(tmp_path, 0)


@pytest.mark.skipif(not LINK_MESHES.is_dir(), reason="the vendor's link meshes are not at hand")
def test_meshes_of_the_links_let_a_view_pass_that_the_capsules_round_them_refuse() -> None:
    no_object = np.zeros((0, 3, 3))
    beside_a_lamp = standing("beside a lamp", *HOME_DEG)
    room_mm = bodies().margins(HOME_DEG)[("link 2", "the dome")][0] + RIG.clearances.dome_mm
    tight = rig_of(clearances={**RIG.clearances.model_dump(), "dome_mm": float(room_mm) + 5.0})
    for link_meshes, refused in ((None, True), (LINK_MESHES, False)):
        cell = bodies_of(tight, DOME, no_object, link_meshes)
        assert bool(plan_itinerary([beside_a_lamp], tight, cell, HOME_DEG).refusals) is refused


@pytest.mark.skipif(not LINK_MESHES.is_dir(), reason="the vendor's link meshes are not at hand")
def test_the_rig_names_the_folder_of_link_meshes(tmp_path: Path) -> None:
    shipped = (ROOT / "configs/rigs/sim.yaml").read_text().replace("../", f"{ROOT}/configs/")
    (tmp_path / "rig.yaml").write_text(f"link_meshes: {LINK_MESHES}\n{shipped}")
    with_meshes = read_job(ROOT / "configs/plans/demo.yaml", tmp_path / "rig.yaml").motion.bodies
    with_capsules = read_job(ROOT / "configs/plans/demo.yaml").motion.bodies
    pair = ("link 2", "the dome")
    assert with_meshes.margins(HOME_DEG)[pair][0] > with_capsules.margins(HOME_DEG)[pair][0]


def test_a_rig_that_names_a_folder_without_link_meshes_is_refused_at_that_line(tmp_path: Path) -> None:
    shipped = (ROOT / "configs/rigs/sim.yaml").read_text().replace("../", f"{ROOT}/configs/")
    (tmp_path / "rig.yaml").write_text(f"link_meshes: {tmp_path}\n{shipped}")
    with pytest.raises(
        InputError, match=r"rig\.yaml:1:\d+: link_meshes: expected the links' meshes.*base_link\.stl"
    ):
        read_job(ROOT / "configs/plans/demo.yaml", tmp_path / "rig.yaml")
