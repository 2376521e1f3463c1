"""What is fuzzed: for each kind of file its seeds, and how the program reads it.

To add a kind, add a line to `TARGETS`. `seeds` gives real files as bytes; `read` gets the path of a mutated one
(named as `file` says, in a folder that holds a copy of `configs/`) and returns, or raises an error of
`coupole.errors` whose message names the file. What a run keeps is in `fuzz.kept`, what other programs write in
`fuzz.foreign`, lights are in `fuzz.lit`, paints in `fuzz.painted`, wires in `fuzz.wires`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from fuzz.foreign import FOREIGN
from fuzz.kept import KEPT
from fuzz.lit import LIT
from fuzz.painted import PAINTED
from fuzz.target import Target
from fuzz.wires import WIRES
from places import REPO

CONFIGS = REPO / "configs"


def files(pattern: str) -> Callable[[], list[bytes]]:
    """Seeds from files of `configs/`."""
    return lambda: [path.read_bytes() for path in sorted(CONFIGS.glob(pattern))]


def mesh(suffix: str, *, encoding: str = "binary") -> Callable[[], list[bytes]]:
    """A small sphere, exported by trimesh."""

    def seeds() -> list[bytes]:
        import trimesh

        sphere = trimesh.creation.icosphere(1, 40.0).apply_translation((0, 0, 40.0))
        options = {} if suffix == "obj" else {"file_type": suffix}
        options |= {"encoding": encoding} if suffix == "ply" else {}
        if suffix == "stl" and encoding == "ascii":
            options["file_type"] = "stl_ascii"
        exported = sphere.export(file_type="obj") if suffix == "obj" else sphere.export(**options)
        return [exported if isinstance(exported, bytes) else exported.encode()]

    return seeds


def big_endian() -> list[bytes]:
    """The same sphere as a big-endian PLY."""
    import numpy as np
    import trimesh

    sphere = trimesh.creation.icosphere(1, 40.0).apply_translation((0, 0, 40.0))
    faces = np.zeros(len(sphere.faces), [("corners", "u1"), ("indices", ">i4", (3,))])
    faces["corners"], faces["indices"] = 3, sphere.faces
    header = (
        "ply\nformat binary_big_endian 1.0\n"
        f"element vertex {len(sphere.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return [header.encode() + sphere.vertices.astype(">f4").tobytes() + faces.tobytes()]


# -- how they are read ------------------------------------------------------------------------------------------


def check(plan: Path) -> None:
    """All that `coupole check` does without the disk; refusals are an answer."""
    from coupole.preflight.checking import check_job
    from coupole.preflight.job import read_job
    from coupole.preflight.preflight import StorageFacts

    job = read_job(plan)
    check_job(job, StorageFacts(10**15, 1e9), paths=len(job.schedule.views) < 5)


def check_plan_with(path: Path, **plan: object) -> None:
    """`check` of a small plan that names a mutated file."""
    asked: dict[str, object] = {
        "schema_version": 1,
        "name": "case",
        "rig": "../rigs/sim.yaml",
        "views": [{"kind": "joints", "name": "park", "joints_deg": [0, -170, 150, 0, -70, 0]}],
        "lights": {"kind": "every", "every": 100},
        "exposure": {"kind": "fixed", "exposure_us": 8000},
    }
    beside = path.parents[1] / "plans" / "small.yaml"
    beside.write_text(json.dumps(asked | plan))
    check(beside)


def check_rig(path: Path) -> None:
    check_plan_with(path, rig=f"../rigs/{path.name}")


def check_part_of_rig(key: tuple[str, ...]) -> Callable[[Path], None]:
    """`check` of the simulated rig with one of its paths replaced by the mutated file."""

    def read(path: Path) -> None:
        from ruamel.yaml import YAML

        rig = YAML(typ="safe", pure=True).load(CONFIGS / "rigs/sim.yaml")
        part = rig
        for step in key[:-1]:
            part = part[step]
        part[key[-1]] = f"../{path.parent.name}/{path.name}"
        beside = path.parents[1] / "rigs" / "small.yaml"
        beside.write_text(json.dumps(rig))
        check_rig(beside)

    return read


def check_mesh(path: Path) -> None:
    check_plan_with(path, object={"id": "case", "mesh": f"../objects/{path.name}"})


TARGETS = (
    Target("plan", "plans/case.yaml", files("plans/*.yaml"), check),
    Target("rig", "rigs/case.yaml", files("rigs/sim*.yaml"), check_rig),
    Target("led-table", "domes/case.csv", files("domes/text-dome.csv"), check_part_of_rig(("dome", "leds"))),
    Target("arm", "robots/case.yaml", files("robots/*.yaml"), check_part_of_rig(("arm",))),
    Target("mesh-ply", "objects/case.ply", mesh("ply"), check_mesh),
    Target("mesh-ply-ascii", "objects/case.ply", mesh("ply", encoding="ascii"), check_mesh),
    Target("mesh-ply-big-endian", "objects/case.ply", big_endian, check_mesh),
    Target("mesh-stl", "objects/case.stl", mesh("stl"), check_mesh),
    Target("mesh-stl-ascii", "objects/case.stl", mesh("stl", encoding="ascii"), check_mesh),
    Target("mesh-obj", "objects/case.obj", mesh("obj"), check_mesh),
    *FOREIGN,
    *LIT,
    *PAINTED,
    *KEPT,
    *WIRES,
)
