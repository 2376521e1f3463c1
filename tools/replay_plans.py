"""Random plans, checked by preflight; each accepted one is replayed every 4 ms by an independent checker.

    python tools/replay_plans.py [--arm ur10e] [--plans 500] [--seed 1] [--meshes DIR] [--check-meshes]

`--meshes` is a folder with the links' meshes (base_link.stl, link_1.stl to link_6.stl); without it the replay uses
meshes of the arm's capsules. With `--check-meshes` preflight uses those meshes too. Prints one JSON line: number
of accepted plans, reasons for the refusal of the others, number of replayed postures, and collisions. Exits with 1
if there was a collision.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from coupole.motion.itinerary import Itinerary, arm_of, bodies_of, plan_itinerary
from coupole.plan.plan import Plan
from coupole.plan.rig import Rig
from coupole.preflight.job import Job, motion_of, read_job, schedule_of
from replay_cell import ReplayCell, Touch, motion
from smallest import add_smallest

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "configs/plans/demo.yaml"
RELIEF = ROOT / "configs/objects/relief.ply"
RIGS = {"kr10": "sim", "ur5e": "sim-ur5e", "ur10e": "sim-ur"}
AROUND_DEG = {
    "simulated-cell": (0.0, -120.0, 110.0, 0.0, -60.0, 0.0),
    "simulated-cell-ur": (0.0, -90.0, 90.0, -90.0, -90.0, 0.0),
    "simulated-cell-ur5e": (0.0, -90.0, 90.0, -90.0, -90.0, 0.0),
}
"""Joint angles about which views by joints are drawn, for each rig."""
REASONS = {
    "touches the object": "the object;",
    "touches the dome": "the dome;",
    "touches the support": "the support;",
    "touches a keep-out volume": "keep-out",
    "touches itself": "the arm's",
    "beyond a limit": "its limits are",
    "out of reach": "out of reach",
    "near a singularity": "singularity",
}
"""Reasons by which refusals are counted, by a phrase of the message."""


def random_object(random: np.random.Generator) -> tuple[NDArray[np.float64], list[float]]:
    """Triangles [n, 3, 3] of one of four kinds of objects at a random place on the support, and its place, mm."""
    kind = random.choice(["relief", "box", "sphere", "bunny"])
    if kind == "relief":
        mesh: Any = trimesh.load(RELIEF, process=False, force="mesh")
    elif kind == "box":
        mesh = trimesh.creation.box(extents=random.uniform(40, 300, 3))
    elif kind == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=random.uniform(30, 150))
    else:
        mesh = bunny(random, float(random.uniform(40, 90)))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(random.uniform(-np.pi, np.pi), (0, 0, 1)))
    at_mm = [*random.uniform(-150, 150, 2).tolist(), float(mesh.extents[2] / 2)]
    mesh.apply_translation(np.array((*at_mm[:2], 0.0)) - (0.0, 0.0, mesh.bounds[0][2]))
    return np.asarray(mesh.vertices)[np.asarray(mesh.faces)], at_mm


def bunny(random: np.random.Generator, body_mm: float) -> Any:
    """Return a mesh like a rabbit: a dented body, a head, two ears."""
    body = trimesh.creation.icosphere(subdivisions=3, radius=body_mm)
    body.vertices *= 1.0 + 0.1 * np.sin(body.vertices @ random.normal(size=(3, 1)) * 0.1)
    head = trimesh.creation.icosphere(subdivisions=3, radius=0.6 * body_mm)
    head.apply_translation((0.8 * body_mm, 0, 1.2 * body_mm))
    ears = [trimesh.creation.capsule(height=body_mm, radius=0.15 * body_mm) for _ in range(2)]
    for side, ear in zip((-1, 1), ears, strict=True):
        ear.apply_translation((0.7 * body_mm, side * 0.3 * body_mm, 1.6 * body_mm))
    return trimesh.util.concatenate([body, head, *ears])


def random_view(random: np.random.Generator, name: str, target_mm: list[float], rig: Rig) -> dict[str, Any]:
    """Return a view of any kind: mostly of the object, sometimes of another place, or given by joints."""
    limits_deg, around_deg = np.array(arm_of(rig).limits_deg).T, np.array(AROUND_DEG[rig.name])
    kind = random.choice(["look_at", "grid", "joints"], p=[0.6, 0.25, 0.15])
    if kind == "joints":
        joints_deg = np.clip(around_deg + random.uniform(-70, 70, 6), limits_deg[0] - 1, limits_deg[1] + 1)
        return {"kind": "joints", "name": name, "joints_deg": joints_deg.tolist()}
    looks = {
        "kind": str(kind),
        "name": name,
        "target_mm": (np.array(target_mm) + random.uniform(-40, 40, 3)).tolist(),
        "distance_mm": float(random.uniform(220, 450)),
        "roll_deg": float(random.choice([0.0, random.uniform(-180, 180)])),
    }
    azimuth_deg, elevation_deg = float(random.uniform(-180, 180)), float(random.uniform(25, 89))
    if kind == "look_at":
        return {**looks, "azimuth_deg": azimuth_deg, "elevation_deg": elevation_deg}
    azimuths_deg = [azimuth_deg, azimuth_deg + float(random.uniform(10, 60))]
    return {**looks, "azimuths_deg": azimuths_deg, "elevations_deg": [elevation_deg]}


def random_job(random: np.random.Generator, demo: Job) -> Job:
    """Return a job with 3 to 6 views (more if one is a grid) of an object in the demo's cell."""
    corners_mm, at_mm = random_object(random)
    plan = Plan.model_validate(
        {
            "schema_version": 1,
            "name": "replay",
            "rig": demo.plan.rig,
            "views": [random_view(random, f"v{k}", at_mm, demo.cell.rig) for k in range(random.integers(3, 7))],
            "order": str(random.choice(["fastest", "as_written"])),
            "lights": {"kind": "none"},
            "exposure": {"kind": "fixed", "exposure_us": 8000},
        }
    )
    shape = replace(demo.shape, corners_mm=corners_mm)
    schedule = schedule_of(plan, demo.cell)
    motion = motion_of(plan, demo.cell, shape, schedule)
    return replace(demo, plan=plan, shape=shape, schedule=schedule, motion=motion)


def planned(job: Job, meshes: Path | None) -> Itinerary:
    """The paths that preflight checks, starting from home."""
    bodies = bodies_of(job.cell.rig, job.cell.leds, job.shape.corners_mm, meshes) if meshes else job.motion.bodies
    home_deg = job.cell.rig.motion.home_joints_deg
    return plan_itinerary(job.schedule.views, job.cell.rig, bodies, home_deg, job.plan.order)


def replay(job: Job, itinerary: Itinerary, cell: ReplayCell) -> tuple[int, list[Touch]]:
    """Return the number of replayed postures, and the collisions."""
    here_deg = np.array(job.cell.rig.motion.home_joints_deg)
    places, touches = 0, []
    for index in itinerary.order:
        visit = itinerary.visits[index]
        assert visit is not None
        for start_deg, goal_deg in pairwise([here_deg, *visit.leg.waypoints]):
            course_deg = motion(job, start_deg, goal_deg)
            places += len(course_deg)
            touches += cell.touches(course_deg)
        here_deg = visit.joints_deg
    return places, touches


def reason(refusal: str) -> str:
    """The reason by which a refusal is counted."""
    name_of_reason = next((name for name, phrase in REASONS.items() if phrase in refusal), "something else")
    return f"no way: {name_of_reason}" if "no way to it" in refusal else name_of_reason


def run(
    plans: int,
    seed: int,
    meshes: Path | None,
    rig: Path | None = None,
    *,
    check_meshes: bool = False,
    tell: bool = False,
) -> dict[str, Any]:
    """Results of a whole replay; `touches` lists plan, bodies and joint angles of each collision found."""
    demo = read_job(DEMO, rig)
    pass_count, places = 0, 0
    refusals: Counter[str] = Counter()
    touches: list[dict[str, Any]] = []
    for number in range(plans):
        job = random_job(np.random.default_rng([seed, number]), demo)
        itinerary = planned(job, meshes if check_meshes else None)
        if itinerary.refusals:
            refusals[reason(itinerary.refusals[0])] += 1
            continue
        pass_count += 1
        looked_at, touches_of_plan = replay(job, itinerary, ReplayCell(job, meshes))
        places += looked_at
        touches += [{"plan": number, **vars(touch)} for touch in touches_of_plan]
        if tell:
            print(f"plan {number}: {pass_count} passed, {len(touches)} touches", file=sys.stderr, flush=True)
    return {
        "plans": plans,
        "passed": pass_count,
        "refused": dict(refusals.most_common()),
        "places": places,
        "meshes": "links" if meshes else "capsules",
        "touches": touches,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--plans", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--meshes", type=Path)
    parser.add_argument("--check-meshes", action="store_true", help="preflight uses the links' meshes as well")
    parser.add_argument("--arm", choices=RIGS, default="kr10", help="arm of the simulated cell")
    add_smallest(parser, plans=1)
    options = parser.parse_args()
    rig = ROOT / f"configs/rigs/{RIGS[options.arm]}.yaml"
    report = run(options.plans, options.seed, options.meshes, rig, check_meshes=options.check_meshes, tell=True)
    print(json.dumps(report))
    return 1 if report["touches"] else 0


if __name__ == "__main__":
    sys.exit(main())
