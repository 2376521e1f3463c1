"""Inputs of a run: plan, rig and the files that they name, kept in the run's folder `inputs/`.

::

    inputs/plan.yaml  rig.yaml      as they were, but with the paths of the copies
           dome/                    LED table
           object/                  mesh
           arm/                     description of the arm, meshes of its links
           calibrations/NAME/       a record and its files

Paths that do not name readable files (the storage folder, a joined world) become absolute. `run.json` has the hash
and the unchanged text of plan and rig, and the hash of every other file.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from coupole.errors import InputError
from coupole.intake.input_files import InputFiles
from coupole.plan import yamlfile
from coupole.plan.arm_description import ArmDescription
from coupole.plan.link_meshes import LINKS, link_mesh_path
from coupole.plan.plan import Plan
from coupole.plan.rewriting import differences, named_paths, rewritten
from coupole.plan.rig import Rig
from coupole.plan.validation_messages import KeyPath
from coupole.plan.yamlfile import Document
from coupole.storage.durable import make_folder, sync_folder, write_synced

FOLDER = "inputs"
PLAN, RIG = f"{FOLDER}/plan.yaml", f"{FOLDER}/rig.yaml"
MOST_COPIED_BYTES = 100_000_000
"""A larger file is only named by its hash. It is copied on request."""
_SLOWEST_BYTES_S = 5e6


@dataclass(frozen=True)
class Inputs:
    """Files that a run depends on; a run can be resumed only with files that mean the same."""

    plan: Path
    rig: Path
    other_files: tuple[Path, ...]
    """LED table, mesh, calibration records."""
    arm: ArmDescription | None = None
    """The arm in force, from wherever it is named."""
    copy_large: bool = False
    """Copy files of more than MOST_COPIED_BYTES, too."""
    files: InputFiles = field(default_factory=InputFiles)
    """The files' bytes that the job was made of. These bytes are hashed, compared and kept, even if the disk has
    others now."""


def copied_s(inputs: Inputs) -> float:
    """Return the time for the copies of a new run on a slow disk."""
    return sum(path.stat().st_size for path in inputs.other_files if path.is_file()) / _SLOWEST_BYTES_S


def keep(inputs: Inputs, run: Path) -> dict[str, Any]:
    """Write the inputs, as they were read, into a run's folder; return their description for `run.json`. All is on
    the disk afterwards."""
    keeper = _Keeper(run, inputs.files, inputs.copy_large)
    make_folder(run / FOLDER)
    plan_and_rig = {
        kind: {**_path_and_hash(path, inputs.files), "text": _text(path, inputs.files), "stored": copy}
        for kind, path, copy in (("plan", inputs.plan, PLAN), ("rig", inputs.rig, RIG))
    }
    write_synced(run / PLAN, keeper.plan_text(inputs))
    write_synced(run / RIG, keeper.rig_text(inputs))
    other_paths = {path.absolute() for path in inputs.other_files}
    files = [
        {**_path_and_hash(path, inputs.files), "stored": keeper.file(path, "others")}
        for path in inputs.other_files
    ]
    files += [
        {**_path_and_hash(path, inputs.files), "stored": copy}
        for path, copy in keeper.stored_places.items()
        if path not in other_paths and path in inputs.files
    ]
    for folder in {run / FOLDER, *((run / copy).parent for copy in keeper.stored_places.values() if copy)}:
        sync_folder(folder)
    arm = {} if inputs.arm is None else {"arm_sha256": _arm_sha256(inputs.arm)}
    return {**plan_and_rig, **arm, "files": files}


def _arm_sha256(arm: ArmDescription) -> str:
    """Return the hash of the whole description. The meshes of its links are compared as files."""
    return hashlib.sha256(arm.model_dump_json(exclude={"link_meshes"}).encode()).hexdigest()


def _path_and_hash(path: Path, files: InputFiles) -> dict[str, str]:
    return {"path": str(path), "sha256": files.sha256(path)}


def _text(path: Path, files: InputFiles) -> str:
    return files.read_bytes(path).decode("utf-8").replace("\r\n", "\n")


def _read_model(path: Path, files: InputFiles, model: type[Plan] | type[Rig]) -> tuple[Document, BaseModel] | None:
    """Return a plan or rig and its model; None if the file is neither."""
    try:
        document = yamlfile.read_document(path, files)
        return document, document.validate(model)
    except InputError:
        return None


@dataclass
class _Keeper:
    """Writes the bytes that were read into a run, each file once."""

    run: Path
    files: InputFiles
    copy_large: bool
    stored_places: dict[Path, str | None] = field(default_factory=dict)
    """Place in the run, by absolute path; None for a file that is too large or missing."""

    def plan_text(self, inputs: Inputs) -> str:
        plan_file = _read_model(inputs.plan, self.files, Plan)
        if plan_file is None:
            return _text(inputs.plan, self.files)
        return self._with_copies(*plan_file, {("rig",): Path(RIG).name})

    def rig_text(self, inputs: Inputs) -> str:
        rig_file = _read_model(inputs.rig, self.files, Rig)
        if rig_file is None:
            return _text(inputs.rig, self.files)
        changes: dict[KeyPath, str] = {}
        document, rig = rig_file
        if inputs.arm is not None and not isinstance(document.data.get("arm"), dict):
            changes[("arm",)] = self._arm(document, inputs.arm)
        return self._with_copies(document, rig, changes)

    def _with_copies(self, document: Document, model: BaseModel, changes: dict[KeyPath, str]) -> str:
        for at, named_path in named_paths(model):
            if at not in changes:
                path = document.resolve(named_path)
                copy = self._copy(at, path)
                changes[at] = str(path) if copy is None else str(Path(copy).relative_to(FOLDER))
        return rewritten(document, document.text, changes)

    def _copy(self, at: KeyPath, path: Path) -> str | None:
        """Copy the file at this key path; return the place of the copy, None if it is not copied."""
        match at:
            case ("dome", _):
                return self.file(path, "dome")
            case ("object", "mesh"):
                return self.file(path, "object")
            case ("calibrations", _):
                return self._record(path)
            case ("link_meshes",) | ("arm", "link_meshes"):
                return self._link_meshes(path)
        return None

    def file(self, path: Path, folder: str) -> str | None:
        """Copy a file into a folder of `inputs`; None if it is too large or missing."""
        path = path.absolute()
        if path not in self.stored_places:
            if not self.files.there(path) or (
                len(self.files.read_bytes(path)) > MOST_COPIED_BYTES and not self.copy_large
            ):
                self.stored_places[path] = None
            else:
                name = re.sub(r"[^A-Za-z0-9._-]", "_", path.name)
                self.stored_places[path] = self._new_place(f"{FOLDER}/{folder}", name)
                self._write(path, str(self.stored_places[path]))
        return self.stored_places[path]

    def _write(self, path: Path, place: str) -> None:
        make_folder((self.run / place).parent)
        write_synced(self.run / place, self.files.read_bytes(path))

    def _new_place(self, folder: str, name: str) -> str:
        taken_places = set(self.stored_places.values())
        places = (
            f"{folder}/{name}" if n == 1 else f"{folder}/{n}/{name}" for n in range(1, len(taken_places) + 2)
        )
        return next(place for place in places if place not in taken_places)

    def _record(self, path: Path) -> str | None:
        """Copy a calibration record, and beside it the files that it names."""
        folder = f"calibrations/{re.sub(r'[^A-Za-z0-9._-]', '_', path.stem)}"
        copy = self.file(path, folder)
        if copy is not None:
            for name in _files_of_record(path, self.files):
                beside = self.run / Path(copy).with_name(name)
                if not beside.exists():
                    self.stored_places[(path.parent / name).absolute()] = str(Path(copy).with_name(name))
                    self._write(path.parent / name, str(Path(copy).with_name(name)))
        return copy

    def _link_meshes(self, folder: Path) -> str | None:
        places = [self.file(link_mesh_path(folder, link), "arm/link_meshes") for link in range(LINKS)]
        return str(Path(places[0]).parent) if all(places) and places[0] else None

    def _arm(self, document: Document, arm: ArmDescription) -> str:
        """Write the arm's file, or a new file for the arm that comes with Coupole for the robot's driver."""
        arm_name = document.data.get("arm")
        place = f"{FOLDER}/arm/{Path(arm_name).name if arm_name else 'arm.yaml'}"
        meshes = self._link_meshes(arm.link_meshes) if arm.link_meshes else None
        beside = None if meshes is None else str(Path(meshes).relative_to(f"{FOLDER}/arm"))
        make_folder(self.run / FOLDER / "arm")
        if arm_name:
            source = yamlfile.read_document(document.resolve(Path(arm_name)), self.files)
            link_meshes = beside or (str(arm.link_meshes) if arm.link_meshes else None)
            changes: dict[KeyPath, str] = {("link_meshes",): link_meshes} if link_meshes else {}
            text = rewritten(source, source.text, changes)
            self.stored_places[source.path.absolute()] = place
        else:
            shipped_arm = arm.model_copy(update={"link_meshes": Path(beside) if beside else arm.link_meshes})
            text = shipped_arm.model_dump_json(indent=1, exclude_none=True) + "\n"
        write_synced(self.run / place, text)
        return str(Path(place).relative_to(FOLDER))


def _files_of_record(path: Path, files: InputFiles) -> Iterator[str]:
    try:
        entries = yamlfile.read_document(path, files).data.get("files", [])
    except InputError:
        return
    for entry in entries if isinstance(entries, list) else []:
        name = entry.get("name") if isinstance(entry, dict) else None
        if isinstance(name, str) and Path(name).name == name and files.there(path.parent / name):
            yield name


# -- what may not change --------------------------------------------------------------------------------------


def changes_since(about: Mapping[str, Any], run: Path, now: Inputs) -> list[str]:
    """List how plan, rig and the files that they name differ in meaning from those that a run began with.

    Comments, the order of keys, the place of a file, and the plan's budget of light do not count as changes. Any
    changed byte of a mesh or a record counts.
    """
    arm_known = now.arm is not None and "arm_sha256" in about
    changes = [
        *_changes_of(about["plan"], now.plan, now.files, Plan, "plan"),
        *_changes_of(about["rig"], now.rig, now.files, Rig, "rig", {"arm"} if arm_known else set()),
    ]
    before = {entry["sha256"] for entry in about["files"]}
    kept_files = InputFiles()
    copies = [(run / entry["stored"], entry["sha256"]) for entry in about["files"] if entry.get("stored")]
    before |= {
        _meaning(path, kept_files)
        for path, digest in copies
        if path.is_file() and kept_files.sha256(path) == digest
    }
    changes += [
        f"{path} is another file"
        for path in now.other_files
        if now.files.sha256(path) not in before and _meaning(path, now.files) not in before
    ]
    if now.arm is not None and arm_known and about["arm_sha256"] != _arm_sha256(now.arm):
        changes.append("the description of the arm")
    return changes


def _changes_of(
    before: Mapping[str, str],
    path: Path,
    files: InputFiles,
    model: type[Plan] | type[Rig],
    kind: str,
    apart: Set[str] = frozenset(),
) -> Iterator[str]:
    if files.sha256(path) == before["sha256"]:
        return
    try:
        then = yamlfile.parse(Path(before["path"]), _plain(before["text"])).validate(model)
    except InputError:
        yield f"the {kind} {path} has changed, and this version cannot read the run's copy to compare them"
        return
    now = yamlfile.read_document(path, files).validate(model)
    if isinstance(then, Plan) and isinstance(now, Plan):
        then = _with_budget_of(now, then)
    if changes := differences(then, now, apart):
        yield f"the {kind} {path}: {'; '.join(changes)}"


def _with_budget_of(now: Plan, then: Plan) -> Plan:
    """Return the plan `then` with the budget of light of the plan `now`: a run may be resumed with another
    budget."""
    if then.object is None or now.object is None:
        return then
    budget = {"dose_budget_lux_h": now.object.dose_budget_lux_h}
    return then.model_copy(update={"object": then.object.model_copy(update=budget)})


def _plain(text: str) -> str:
    return text.removeprefix("\ufeff").replace("\r\n", "\n")


def _meaning(path: Path, files: InputFiles) -> str:
    """Return the hash of the content that counts: for a table, its lines without comments; for another file, all
    bytes."""
    if path.suffix.lower() != ".csv":
        return files.sha256(path)
    lines = [line.strip() for line in files.read_bytes(path).splitlines()]
    return hashlib.sha256(b"\n".join(line for line in lines if line and not line.startswith(b"#"))).hexdigest()
