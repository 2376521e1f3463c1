"""Time of the collision check of one pose of the arm, against python-fcl through trimesh.

Coupole computes the distance of every pair of bodies: arm, camera, object, support, dome, keep-out volumes. The
peer only tests whether a capsule of the arm, as a mesh, touches the object's mesh or the support.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

POSES, SMALLEST_POSES = 100, 4


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    """Yield microseconds per pose, for random poses in the demo's cell."""
    from coupole.preflight.job import read_job

    job = read_job(root / "configs/plans/demo.yaml")
    home_deg = np.array([0.0, -90.0, 90.0, 0.0, 90.0, 0.0])
    poses = SMALLEST_POSES if smallest else POSES
    poses_deg = home_deg + np.random.default_rng(3).uniform(-40.0, 40.0, (poses, 6))

    def run_coupole() -> None:
        for joints_deg in poses_deg:
            job.motion.bodies.contacts(joints_deg)

    works = list(filter(None, (run_coupole, fcl_check(job, poses_deg))))
    times_us: list[list[float]] = [[] for _ in works]
    for _ in range(1 + 5 * rounds):
        for work, times in zip(works, times_us, strict=True):
            start_s = time.perf_counter()
            work()
            times.append((time.perf_counter() - start_s) / poses * 1e6)
    medians_us = [float(np.median(times[1:])) for times in times_us]  # numba compiles in the first round
    name, peer_us = ("trimesh_fcl", medians_us[1]) if len(works) > 1 else ("frame_period_at_100_hz", 10_000.0)
    yield {
        "name": "collision_check_per_pose",
        "value": medians_us[0],
        "unit": "us",
        "peer": name,
        "ratio": peer_us / medians_us[0],
        "peer_value": round(peer_us, 1),
    }


def fcl_check(job: Any, poses_deg: NDArray[np.float64]) -> Callable[[], None] | None:
    """Return a function that does the peer's work on all poses; None if python-fcl is not installed."""
    try:
        import fcl  # noqa: F401  required by trimesh's collision manager
    except ImportError:
        return None
    import trimesh

    from coupole.kinematics import link_frames
    from coupole.motion.bodies import Capsule, capsules_of
    from coupole.plan.rig_devices import described_arm

    rig = job.cell.rig
    tool = tuple(Capsule(t.name, 7, tuple(t.from_mm), tuple(t.to_mm), t.radius_mm) for t in rig.tool)
    arm_description = described_arm(rig)
    assert arm_description is not None, "the demo's rig has an arm that is described"
    capsules = [c for c in (*capsules_of(arm_description), *tool) if c.link]
    arm, around = trimesh.collision.CollisionManager(), trimesh.collision.CollisionManager()
    base_from_support = rig.support.base_from_support.matrix()
    corners = job.shape.corners_mm.reshape(-1, 3) @ base_from_support[:3, :3].T + base_from_support[:3, 3]
    around.add_object("object", trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3)))
    disk = trimesh.creation.cylinder(rig.support.diameter_mm / 2, 50.0, transform=base_from_support)
    around.add_object("support", disk.apply_translation(-25.0 * base_from_support[:3, 2]))
    for number, capsule in enumerate(capsules):
        arm.add_object(str(number), capsule_mesh(capsule))
    places = link_frames(arm_description.arm, poses_deg)

    def check() -> None:
        for frames in places:
            for number, capsule in enumerate(capsules):
                arm.set_transform(str(number), frames[capsule.link])
            arm.in_collision_other(around)

    return check


def capsule_mesh(capsule: Any) -> Any:
    """Return a capsule as a mesh, in its link's frame."""
    import trimesh

    start, end = np.array(capsule.start_mm, dtype=float), np.array(capsule.end_mm, dtype=float)
    length_mm = float(np.linalg.norm(end - start))
    mesh = trimesh.creation.capsule(height=length_mm, radius=capsule.radius_mm, count=[16, 16])
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    if length_mm > 0.0:
        mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], (end - start) / length_mm))
    return mesh.apply_translation((start + end) / 2)
