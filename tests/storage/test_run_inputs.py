"""Copies of what a run depends on: which files, which names, and that they mean the same where they lie."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import pytest
import trimesh
from cells import CellFolder
from places import REPO

from coupole.plan.arm_description import read_arm
from coupole.plan.cell import read_cell
from coupole.plan.link_meshes import LINKS, link_mesh_path
from coupole.plan.plan import Plan
from coupole.plan.rewriting import rewritten
from coupole.plan.yamlfile import parse, read_document
from coupole.preflight.job import read_job
from coupole.storage import run_inputs
from coupole.storage.run_inputs import Inputs, changes_since, keep

RECORD = REPO / "tests/data/version-0.1/records/dark.yaml"


def inputs_of(cell: CellFolder, **more: object) -> Inputs:
    arm = read_cell(cell.rig).rig.arm
    assert not isinstance(arm, Path)
    return Inputs(cell.plan, cell.rig, (Path(cell.rig_data["dome"]["leds"]),), arm, **more)  # type: ignore[arg-type]


def test_comments_stay_in_a_copy_and_only_its_paths_are_others(cell: CellFolder, tmp_path: Path) -> None:
    shutil.copytree(REPO / "configs", tmp_path / "configs")
    plan = tmp_path / "configs/plans/demo.yaml"
    rig = tmp_path / "configs/rigs/sim.yaml"
    about = keep(Inputs(plan, rig, (), read_cell(rig).rig.arm), tmp_path / "run")  # type: ignore[arg-type]
    copied, text = (tmp_path / "run/inputs/plan.yaml").read_text(), plan.read_text()
    other = [(a, b) for a, b in zip(text.splitlines(), copied.splitlines(), strict=True) if a != b]
    assert [key for a, _ in other for key in ("rig:", "mesh:") if key in a] == ["rig:", "mesh:"]
    assert "#" in copied
    assert about["plan"]["text"] == text
    assert read_cell(tmp_path / "run/inputs/rig.yaml").rig.arm == read_cell(rig).rig.arm
    stored = read_cell(tmp_path / "run/inputs/rig.yaml").storage_folder
    assert stored == read_cell(rig).storage_folder


def test_a_mesh_of_more_than_the_limit_is_named_by_hash_and_copied_on_request(
    cell: CellFolder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    mesh = Path(cell.plan_data["object"]["mesh"])
    monkeypatch.setattr(run_inputs, "MOST_COPIED_BYTES", mesh.stat().st_size - 1)
    about = keep(inputs_of(cell), tmp_path / "without")
    assert read_document(tmp_path / "without/inputs/plan.yaml").data["object"]["mesh"] == str(mesh)
    assert str(mesh) not in {entry["path"] for entry in about["files"] if entry["stored"]}
    keep(inputs_of(cell, copy_large=True), tmp_path / "with")
    assert read_document(tmp_path / "with/inputs/plan.yaml").data["object"]["mesh"] == "object/relief.ply"
    assert (tmp_path / "with/inputs/object/relief.ply").read_bytes() == mesh.read_bytes()


def test_the_hash_of_a_large_mesh_is_that_of_the_bytes_that_were_parsed(
    cell: CellFolder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    mesh = Path(shutil.copy(cell.plan_data["object"]["mesh"], tmp_path / "relief.ply"))
    cell.plan_data["object"]["mesh"] = str(mesh)
    cell.write()
    monkeypatch.setattr(run_inputs, "MOST_COPIED_BYTES", mesh.stat().st_size - 1)
    job, parsed = read_job(cell.plan), mesh.read_bytes()
    mesh.write_bytes(parsed[:-1] + b"!")
    about = keep(job.inputs, tmp_path / "run")
    entry = next(entry for entry in about["files"] if entry["path"] == str(mesh))
    assert (entry["sha256"], entry["stored"]) == (hashlib.sha256(parsed).hexdigest(), None)


def test_what_was_read_is_kept_and_not_what_is_there_now(cell: CellFolder, tmp_path: Path) -> None:
    shutil.copytree(REPO / "configs", tmp_path / "configs")
    rig = tmp_path / "configs/rigs/sim.yaml"
    (tmp_path / "configs/meshes").mkdir()
    for link in range(LINKS):
        box = trimesh.creation.box((0.1, 0.1, 0.1 + 0.01 * link))
        box.export(link_mesh_path(tmp_path / "configs/meshes", link))
    rig.write_text(f"link_meshes: ../meshes\n{rig.read_text()}")
    job = read_job(tmp_path / "configs/plans/demo.yaml", rig)
    _ = job.motion.bodies
    was = {path: path.read_bytes() for path in (tmp_path / "configs").rglob("*") if path.is_file()}
    shutil.rmtree(tmp_path / "configs")
    about = keep(job.inputs, tmp_path / "run")
    for entry in about["files"]:
        if Path(entry["path"]) in was and "robots" not in entry["path"]:
            kept = (tmp_path / "run" / entry["stored"]).read_bytes()
            assert kept == was[Path(entry["path"])]
            assert entry["sha256"] == hashlib.sha256(kept).hexdigest()
    assert read_job(tmp_path / "run/inputs/plan.yaml").schedule.frames == job.schedule.frames


def test_records_are_copied_with_the_files_beside_them(cell: CellFolder, tmp_path: Path) -> None:
    records = tmp_path / "records"
    records.mkdir()
    for folder in ("a", "b"):
        (records / folder).mkdir()
        (records / folder / "flat.yaml").write_text(json.dumps({"of": folder, "files": [{"name": "flat.h5"}]}))
        (records / folder / "flat.h5").write_text(folder)
    cell.write(calibrations=[str(RECORD), str(records / "a/flat.yaml"), str(records / "b/flat.yaml")])
    keep(inputs_of(cell), tmp_path / "run")
    inputs = tmp_path / "run/inputs"
    named = [inputs / name for name in read_document(inputs / "plan.yaml").data["calibrations"]]
    assert named[0].read_bytes() == RECORD.read_bytes()
    assert [json.loads(path.read_text())["of"] for path in named[1:]] == ["a", "b"]
    assert [(path.parent / "flat.h5").read_text() for path in named[1:]] == ["a", "b"]


def test_an_arms_file_is_copied_with_the_meshes_of_its_links(cell: CellFolder, tmp_path: Path) -> None:
    arm = read_document(REPO / "configs/robots/kr10_r1100_sixx.yaml").data
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for name in ("base_link", *(f"link_{k}" for k in range(1, 7))):
        (meshes / f"{name}.stl").write_text(name)
    (tmp_path / "my arm.yaml").write_text(json.dumps({**arm, "link_meshes": "meshes"}))
    cell.rig_data["arm"] = "my arm.yaml"
    cell.write()
    inputs = inputs_of(cell)
    keep(inputs, tmp_path / "run")
    shutil.rmtree(meshes)
    copied = read_cell(tmp_path / "run/inputs/rig.yaml")
    assert copied.link_meshes == tmp_path / "run/inputs/arm/link_meshes"
    assert (copied.link_meshes / "link_3.stl").read_text() == "link_3"
    assert inputs.arm is not None
    described = read_arm(REPO / "configs/robots/kr10_r1100_sixx.yaml")
    assert read_arm(tmp_path / "run/inputs/arm/my arm.yaml").joints == described.joints


def test_another_arm_is_a_change(cell: CellFolder, tmp_path: Path) -> None:
    arm = read_document(REPO / "configs/robots/kr10_r1100_sixx.yaml").data
    (tmp_path / "arm.yaml").write_text(json.dumps(arm))
    cell.rig_data["arm"] = "arm.yaml"
    cell.write()
    about = keep(inputs_of(cell), tmp_path / "run")
    assert changes_since(about, tmp_path / "run", inputs_of(cell)) == []
    arm["joints"][2]["limits_deg"][1] -= 1.0
    (tmp_path / "arm.yaml").write_text(json.dumps(arm))
    assert changes_since(about, tmp_path / "run", inputs_of(cell)) == ["the description of the arm"]


@pytest.mark.parametrize(
    "text",
    [
        "name: a # why\nrig: r.yaml  # the rig\nlist: [x, 'y', \"z\"]\n",
        "{name: a, list: [x, y, z], rig: r.yaml}",
        "base: &base {rig: r.yaml}\n<<: *base\nlist: [x, y, z]\n",
        "rig: >\n  r.yaml\nlist:\n- x\n- y\n- z",
        "# caf\u00e9 \U0001f3db\nrig: r.yaml\nlist: [x, y, z]\n",
    ],
)
def test_a_rewritten_text_has_the_wanted_data_whatever_its_form(text: str) -> None:
    document = parse(Path("plan.yaml"), text)
    wanted = "a 'b' \"c\": #d"
    again = parse(document.path, rewritten(document, text, {("rig",): wanted, ("list", 1): "new", ("arm",): "x"}))
    assert again.data == {**document.data, "rig": wanted, "list": ["x", "new", "z"], "arm": "x"}


def test_values_that_are_the_defaults_are_no_change(cell: CellFolder, tmp_path: Path) -> None:
    about = keep(inputs_of(cell), tmp_path / "run")
    cell.write(repeats=1, order="fastest")
    assert isinstance(read_document(cell.plan).validate(Plan), Plan)
    assert changes_since(about, tmp_path / "run", inputs_of(cell)) == []
    cell.write(repeats=2)
    found = changes_since(about, tmp_path / "run", inputs_of(cell))
    assert [line.rpartition(": ")[2] for line in found] == ["repeats was 1, is 2"]
