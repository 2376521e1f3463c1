"""What commands import, and when: as little as they want, and nothing while devices are open."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import cells
import pytest
from cells import CellFolder
from places import REPO

from coupole.commands import cli

OURS = ("coupole", "drivers", "sim")
HEAVY = {"PIL", "cv2", "embreex", "h5py", "matplotlib", "numba", "numpy", "rich", "ruamel", "scipy", "trimesh"}
OF_PLANS = {"rich", "numpy", "ruamel"}
OF_RECORDS = {"rich", "numpy", "h5py", "ruamel"}
"""What describes a calibration's record: some tenths of a second."""
LATE = {"pwd", "encodings.ascii"}
"""Python's own, that tell who acquires and spell a name: nothing that a stop or a safe end waits for."""
REPORT = {"PIL", "jinja2", "markupsafe", "encodings"}
"""Write the report's pictures and its page, when the cell is safe; `encodings.unicode_escape` is the
template's."""


def watched(file: Path, *arguments: str | Path) -> subprocess.Popen[str]:
    """The command, in an interpreter of its own that has imported nothing yet."""
    program = [sys.executable, REPO / "tests/watched_imports.py", file, *arguments]
    return subprocess.Popen(
        [*map(str, program)], cwd=REPO, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def modules(file: Path, when: str) -> set[str]:
    return set(json.loads(file.read_text())[when])


def ours(names: set[str]) -> int:
    return sum(name.split(".")[0] in OURS for name in names)


def heavy(names: set[str]) -> set[str]:
    return HEAVY & {name.split(".")[0] for name in names}


def test_help_imports_the_commands_alone(tmp_path: Path) -> None:
    ended = cells.finish(watched(tmp_path / "seen", "--help"))
    assert ended.code == 0, ended.err
    names = modules(tmp_path / "seen", "end")
    assert heavy(names) == {"rich"}
    assert ours(names) <= 86


@pytest.mark.parametrize(
    ("words", "said", "libraries"),
    [
        ("reflectance nosuch --out x --texels 0", "--texels: expected auto", {"rich"}),
        ("reflectance nosuch --out x --memory much", "--memory: expected a size", {"rich"}),
        ("plan suggest nosuch.ply", "nosuch.ply: no such file", OF_PLANS),
        ("plan suggest README.md --budget soon", "--budget: expected a time", OF_PLANS),
        ("calibrate check-artefact nosuch", "give one of --board and --tile", OF_RECORDS),
        ("calibrate check-artefact nosuch --board b", "nosuch: no such folder", OF_RECORDS),
        ("calibrate check-artefact . --board b --mpe-um x", "--mpe-um x: expected A+L/K", OF_RECORDS),
        ("calibrate check-artefact . --tile t --mpe-um 5", "--mpe-um: is for --board", OF_RECORDS),
        ("calibrate check-artefact . --tile t --tile u", "expected one description, or one for each", OF_RECORDS),
        ("calibrate check-artefact . --tile nosuch", "--tile: nosuch: no such file", OF_RECORDS),
        ("calibrate check-artefact . --tile README.md", "a record of the kind `led-power`", OF_RECORDS),
        ("calibrate check-artefact . --tile t --emission x", "--emission: expected lambertian", OF_RECORDS),
    ],
)
def test_wrong_options_are_refused_before_what_takes_seconds_to_import(
    tmp_path: Path, words: str, said: str, libraries: set[str]
) -> None:
    ended = cells.finish(watched(tmp_path / "seen", *words.split()))
    assert ended.code == 2, ended.err
    assert said in ended.err
    assert heavy(modules(tmp_path / "seen", "end")) <= libraries


def test_a_result_of_runs_imports_nothing_of_comparisons_and_registration(tmp_path: Path) -> None:
    """They want scipy.stats: half a second."""
    ended = cells.finish(watched(tmp_path / "seen", "reflectance", "nosuch", "--out", tmp_path / "out"))
    assert ended.code == 2, ended.err
    names = modules(tmp_path / "seen", "end")
    assert "coupole.reflectance.run_fits" in names
    unwanted = ("scipy.stats", "coupole.heritage", "coupole.scan.registration")
    assert [name for name in names if name.startswith(unwanted)] == []


def test_each_command_is_found_where_the_table_has_it() -> None:
    for command in cli.COMMANDS:
        found = cells.here(command, "--help")
        assert found.code == 0, found.err
        assert f" {command} [OPTIONS]" in found.out


def test_an_acquisition_that_is_stopped_imports_nothing_while_its_devices_are_open(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.write(views=[cells.TOP, cells.SIDE], repeats=4)
    process = watched(tmp_path / "seen", "acquire", cell.plan, "--yes", "--json")
    run = cell.run_folder
    cells.wait_until(lambda: cells.frame_lines(run) > 0, "proven frames")
    process.send_signal(signal.SIGINT)
    ended = cells.finish(process)
    assert ended.code == 130, ended.err
    opened, safe, end = (modules(tmp_path / "seen", when) for when in ("opened", "safe", "end"))
    assert safe - opened <= LATE
    assert {name.split(".")[0] for name in end - safe} <= REPORT
    assert ours(opened) <= 304
    compiled = json.loads((tmp_path / "seen").read_text())["kernels"]
    assert compiled["safe"] == compiled["opened"], "on a fresh machine arm and lamps would wait for a compiler"
    assert any("_first_met" in name for name in compiled["opened"])
    assert heavy(opened) == {"embreex", "h5py", "numba", "numpy", "rich", "ruamel", "scipy"}

    asked = cells.finish(watched(tmp_path / "seen by status", "status", run))
    assert asked.code == 0, asked.err
    names = modules(tmp_path / "seen by status", "end")
    assert heavy(names) == {"numpy", "rich", "ruamel"}
    assert ours(names) <= 66


def test_a_stop_is_sent_before_anything_is_imported_that_only_its_outcome_wants(tmp_path: Path) -> None:
    ended = cells.finish(watched(tmp_path / "seen", "stop", tmp_path))
    assert ended.code == 2, ended.err
    names = modules(tmp_path / "seen", "asked")
    assert heavy(names) == set()
    assert ours(names) <= 29
