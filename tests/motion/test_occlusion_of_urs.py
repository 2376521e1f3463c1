"""What a Universal Robots arm hides of the LEDs: against python-fcl, and against what the simulated arm hides."""

from __future__ import annotations

from functools import cache

import fcl
import numpy as np
import pytest
from places import REPO
from ur_checker import Checker

from coupole.geometry import apply
from coupole.motion.occlusion import AWAY, BY_ARM, BY_OBJECT, BY_TOOL, REACHED, Occlusion, ray_starts
from coupole.preflight.job import Job, read_job
from sim.devices import ur_arm
from sim.devices.arm_bodies import ToolBody, tool_capsules, ur_capsules
from sim.render.arm_shadow import distance_mm


@cache
def job() -> Job:
    return read_job(REPO / "configs/plans/demo.yaml", REPO / "configs/rigs/sim-ur.yaml")


@cache
def view(number: int) -> tuple[np.ndarray, Occlusion]:
    """Posture and shadows of one of the demo's views on a UR10e."""
    visit = job().motion.itinerary(job().schedule.views, job().cell.rig.motion.home_joints_deg).visits[number]
    assert visit is not None
    return visit.joints_deg, job().motion.occlusions.at(visit.joints_deg)


@pytest.mark.parametrize("number", range(3))
def test_the_arm_itself_hides_leds_and_not_its_tool_alone(number: int) -> None:
    _, shadow = view(number)
    assert shadow.share(BY_TOOL).sum() > 1.0
    assert shadow.share(BY_ARM).sum() > 1.0


@pytest.mark.parametrize("number", range(3))
def test_shadows_of_the_arm_are_those_that_an_independent_checker_finds(number: int) -> None:
    joints_deg, shadow = view(number)
    checker, patches = Checker("ur10e"), job().motion.occlusions.patches
    checker.place(joints_deg)
    tools = ("camera", "cables")
    solids = {
        BY_ARM: [s for name, parts in checker.bodies.items() if name not in tools for *_, s in parts],
        BY_TOOL: [s for name in tools for *_, s in checker.bodies[name]],
    }
    starts_mm, random = ray_starts(patches), np.random.default_rng(3)
    for code in (REACHED, BY_ARM, BY_TOOL):
        at, of = np.nonzero(shadow.codes == code)
        for k in random.choice(len(at), 100):
            start, led = starts_mm[at[k]], job().motion.occlusions.leds_mm[of[k]]
            ray = fcl.CollisionObject(fcl.Cylinder(1e-4, float(np.linalg.norm(led - start))), standing(start, led))
            hit = {
                by: any(fcl.collide(ray, s, fcl.CollisionRequest(), fcl.CollisionResult()) for s in of_it)
                for by, of_it in solids.items()
            }
            expected = next((by for by in (BY_ARM, BY_TOOL) if hit[by]), REACHED)
            assert code == expected, (at[k], of[k])


@pytest.mark.parametrize("number", range(3))
def test_what_the_simulated_arm_hides_the_mask_hides_and_most_of_the_other_way_round(number: int) -> None:
    joints_deg, shadow = view(number)
    rig, occlusions = job().cell.rig, job().motion.occlusions
    base_from_support = rig.support.base_from_support.matrix()
    tool = [ToolBody(from_mm=t.from_mm, to_mm=t.to_mm, radius_mm=t.radius_mm) for t in rig.tool]
    arm = np.vstack(
        [
            ur_capsules("ur10e", joints_deg.tolist()),
            tool_capsules(ur_arm.flange_pose("ur10e", joints_deg.tolist()), tool),
        ]
    )
    starts_mm = apply(base_from_support, ray_starts(occlusions.patches))[::7]
    leds_mm = apply(base_from_support, occlusions.leds_mm)[::3]
    codes = shadow.codes[::7, ::3]
    theirs = np.array(
        [[any(distance_mm(p, led, c[:3], c[3:6]) < c[6] for c in arm) for led in leds_mm] for p in starts_mm]
    )
    asked = (codes != AWAY) & (codes != BY_OBJECT)
    ours = (codes == BY_ARM) | (codes == BY_TOOL)
    assert theirs[asked].sum() > 100
    assert np.mean(ours[asked & theirs]) > 0.99
    assert np.mean(theirs[asked & ours]) > 0.7
    by_arm = asked & (codes == BY_ARM)
    assert np.mean(theirs[by_arm]) > 0.5


def standing(start: np.ndarray, end: np.ndarray) -> fcl.Transform:
    """What brings a shape along z to stand from one point to the other."""
    along = (end - start) / np.linalg.norm(end - start)
    aside = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
    aside /= np.linalg.norm(aside)
    return fcl.Transform(np.column_stack([aside, np.cross(along, aside), along]), (start + end) / 2)
