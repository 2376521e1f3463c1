"""A run and a result as crates, read by the community's own library."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import cells
import pytest
from archives import MadeRun, make_run
from checkers import crate_issues, needs_checkers
from lazily import lazily
from relight_cases import waves, write_result

rocrate: Any = lazily("rocrate.rocrate")

CC_BY = "https://creativecommons.org/licenses/by/4.0/"
AUTHOR = "A. Person <https://orcid.org/0000-0002-1825-0097> at Some House"


@pytest.fixture
def made(tmp_path: Path) -> MadeRun:
    return make_run(tmp_path / "runs", views=("top",), shots=2)


def export(source: Path, *options: str | Path) -> None:
    ended = cells.here("export", source, "--to", "rocrate", "--author", AUTHOR, *options, "--json")
    assert ended.code == 0, ended.err


def test_a_run_in_a_crate_has_all_its_files_with_their_hashes(made: MadeRun, tmp_path: Path) -> None:
    folder, out = made.run.folder, tmp_path / "crate"
    export(folder, "--licence", CC_BY, "--publisher", "Some House", "--identifier", "doi:10.1/x", "--out", out)
    crate = rocrate.ROCrate(out)
    found = {Path(unquote(file.id)).relative_to("data").as_posix(): file for file in crate.data_entities}
    assert set(found) == {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    for name, file in found.items():
        digest = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        assert file["identifier"] == f"sha256:{digest}"
        assert (out / unquote(file.id)).read_bytes() == (folder / name).read_bytes()
        assert (out / unquote(file.id)).samefile(folder / name) is name.endswith(".h5")
        assert file["contentSize"] == str((folder / name).stat().st_size)
    root = crate.root_dataset
    assert (root["license"].id, root["identifier"]) == (CC_BY, "doi:10.1/x")
    assert root["author"]["affiliation"]["name"] == root["publisher"]["name"] == "Some House"
    assert "simulated" in root["description"]
    action = crate.dereference("#made")
    assert action.type == "CreateAction"
    assert action["result"].id == "./"
    assert action["instrument"]["name"] == "coupole"


def test_a_result_says_of_which_frames_it_was_made_and_may_be_described_in_place(tmp_path: Path) -> None:
    result = write_result(tmp_path / "result", waves(12)).folder
    about = json.loads((result / "result.json").read_text())
    about["runs"] = {"waves": {"waves/run.json": "ab" * 32, "waves/views/top.h5": "cd" * 32}}
    (result / "result.json").write_text(json.dumps(about))
    before = {path for path in result.rglob("*") if path.is_file()}
    export(result, "--licence", "ask the museum", "--in-place")
    assert {path for path in result.rglob("*") if path.is_file()} - before == {result / "ro-crate-metadata.json"}
    crate = rocrate.ROCrate(result)
    used = {one["name"]: one["identifier"] for one in crate.dereference("#made")["object"]}
    assert used == {"waves/run.json": f"sha256:{'ab' * 32}", "waves/views/top.h5": f"sha256:{'cd' * 32}"}
    assert crate.root_dataset["license"]["name"] == "ask the museum"
    assert len(crate.data_entities) == len(before)


@needs_checkers
def test_a_crate_is_valid_to_the_communitys_validator(made: MadeRun, tmp_path: Path) -> None:
    out = tmp_path / "crate"
    export(made.run.folder, "--licence", CC_BY, "--publisher", "Some House", "--out", out)
    assert crate_issues(out, tmp_path) == []


def test_people_and_files_of_any_name_have_ids_of_their_own_that_are_addresses(
    made: MadeRun, tmp_path: Path
) -> None:
    names = ("Иван", "Анна", "made", "A B", "A-B")
    odd = "notes/où? #1 100%[a].txt"
    (made.run.folder / "notes").mkdir()
    (made.run.folder / odd).write_text("odd")
    options = [word for name in names for word in ("--author", f"{name} at {name}")]
    export(made.run.folder, "--licence", CC_BY, *options, "--out", tmp_path / "crate")
    graph = json.loads((tmp_path / "crate/ro-crate-metadata.json").read_text())["@graph"]
    ids = [entity["@id"] for entity in graph]
    assert len(ids) == len(set(ids))
    assert all(re.fullmatch(r"[\w./:#%~-]+", one, re.ASCII) for one in ids), ids
    assert {entity["name"] for entity in graph if entity["@type"] == "Person"} == {"A. Person", *names}
    crate = rocrate.ROCrate(tmp_path / "crate")
    assert unquote(next(file.id for file in crate.data_entities if "notes" in file.id)) == f"data/{odd}"
    assert crate.dereference("#made").type == "CreateAction"


@pytest.mark.parametrize("out", ["runs", "runs/made"])
def test_a_crate_around_its_own_source_is_refused(made: MadeRun, tmp_path: Path, out: str) -> None:
    folder = made.run.folder if out == "runs/made" else made.run.folder.parent
    before = sorted(tmp_path.rglob("*"))
    options = ("--to", "rocrate", "--licence", CC_BY, "--author", AUTHOR, "--out", folder, "--overwrite")
    ended = cells.here("export", made.run.folder, *options)
    assert ended.code == 2
    assert "holds SOURCE" in " ".join(ended.err.split())
    assert sorted(tmp_path.rglob("*")) == before


def test_a_crate_that_is_written_over_keeps_no_file_of_the_old_one(made: MadeRun, tmp_path: Path) -> None:
    other, out = make_run(tmp_path / "others", views=("side",), shots=2).run.folder, tmp_path / "crate"
    export(other, "--licence", CC_BY, "--out", out)
    (out / "mine.txt").write_text("mine")
    export(made.run.folder, "--licence", CC_BY, "--out", out, "--overwrite")
    told = {unquote(file.id) for file in rocrate.ROCrate(out).data_entities}
    assert {path.relative_to(out).as_posix() for path in (out / "data").rglob("*") if path.is_file()} == told
    assert (out / "mine.txt").exists()
    (out / "ro-crate-metadata.json").unlink()
    options = ("--to", "rocrate", "--licence", CC_BY, "--author", AUTHOR, "--out", out, "--overwrite")
    ended = cells.here("export", other, *options)
    assert ended.code == 2
    assert "data: belongs to no crate" in " ".join(ended.err.split())
    assert (out / "data/run.json").exists()


def test_authors_are_read_before_anything_is_written(made: MadeRun, tmp_path: Path) -> None:
    options = ("--to", "rocrate", "--licence", CC_BY, "--author", "A <x>", "--out", tmp_path / "crate")
    assert cells.here("export", made.run.folder, *options).code == 2
    assert not (tmp_path / "crate").exists()


def test_a_run_that_is_being_acquired_is_left_alone(made: MadeRun, tmp_path: Path) -> None:
    options = ("--to", "rocrate", "--licence", CC_BY, "--author", AUTHOR, "--out", tmp_path / "crate")
    with made.run.hold_lock():
        ended = cells.here("export", made.run.folder, *options)
    assert ended.code == 2
    assert "is acquiring into this run" in ended.err
