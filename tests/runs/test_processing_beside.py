"""`coupole acquire --reflectance`: the result that `coupole reflectance` makes afterwards, whatever happens to the
process that makes it, and never at the cost of the run."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from beside_runs import begun, cell_of_three_views, files, is_beside, result_of, same_result
from cells import CellFolder
from PIL import Image

from coupole.acquisition.processing_beside import ProcessingBeside
from coupole.reflectance.beside.beforehand import reasons_against
from coupole.storage.growing_pictures import PICTURES, file_so_far, read_growing
from coupole.viewing.terminal import make_console

pytestmark = [pytest.mark.timeout(900), pytest.mark.usefixtures("hurried")]
NICE_OF_THE_END = 10
LITTLE_BYTES = 300_000_000
NOT_USED_UP_BYTES = 2_450_000_000
"""Less than a plan needs, and more than the modules take."""
WORDS_UNDER_A_LIMIT = f"""
import resource
from coupole.reflectance.beside.follower import _words_on
print(_words_on(TypeError("int()")))
for limit_bytes in ({NOT_USED_UP_BYTES}, {LITTLE_BYTES}):
    resource.setrlimit(resource.RLIMIT_AS, (limit_bytes, resource.RLIM_INFINITY))
    print(_words_on(TypeError("int()")))
resource.setrlimit(resource.RLIMIT_AS, ({NOT_USED_UP_BYTES}, resource.RLIM_INFINITY))
try:
    raise ValueError("x") from MemoryError("1 GiB")
except ValueError as error:
    print(_words_on(error))
"""


def has_samples(cell: CellFolder) -> bool:
    """Of any view."""
    return any((result_of(cell) / "samples").glob("*.json"))


def made_afterwards(cell: CellFolder, folder: Path) -> Path:
    ended = cells.here("reflectance", cell.run_folder, "--out", folder, "--json")
    assert ended.code == 0, ended.err
    return folder


def status(run: Path) -> dict[str, Any]:
    ended = cells.here("status", run, "--json")
    assert ended.code == 0, ended.err
    document: dict[str, Any] = ended.document["processing"] or {}  # none before the session's first line
    return document


def nice_of_threads(pid: int) -> list[int]:
    nice = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # the thread has just ended
            nice.append(os.getpriority(os.PRIO_PROCESS, int(task.name)))
    return nice


def frames_alone_count(ended: cells.Ended) -> dict[str, Any]:
    """The exit code is that of the frames, and all are there; what is said of the result."""
    assert ended.code == 0, ended.err
    assert ended.document["missing"] == 0
    assert ended.document["proven"] == 3 * 45
    document = ended.document["reflectance"]
    assert isinstance(document, dict)
    return document


def test_the_result_is_the_one_that_is_made_afterwards(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path)
    process, worker = begun(cell)
    cells.wait_until(lambda: status(cell.run_folder).get("views_done"), "samples of a view")
    drawn = cells.wait_until(
        lambda: read_growing(result_of(cell)).of_views or not is_beside(worker), "a first look"
    )
    if is_beside(worker):
        assert drawn[0].kind == "first-look"
        pixels = np.asarray(Image.open(result_of(cell) / PICTURES / drawn[0].pictures[0].file))
        assert np.count_nonzero(pixels[..., 3]) > 1000
        refused = cells.here("reflectance", cell.run_folder, "--out", result_of(cell))
        if is_beside(worker):  # it has not ended meanwhile
            assert refused.code == 2
            assert f"process {worker}" in refused.err
    cells.wait_until(lambda: NICE_OF_THE_END in nice_of_threads(worker), "the work after the last frame")
    said = frames_alone_count(cells.finish(process))
    assert said["is_whole"]
    assert said["views"] == 3
    assert 0 < said["samples_after_last_frame_s"] < said["result_after_last_frame_s"]
    assert status(cell.run_folder)["state"] == "done"
    same_result(result_of(cell), made_afterwards(cell, tmp_path / "afterwards"))
    assert cells.here("verify", cell.run_folder).code == 0


def test_a_run_ends_as_it_would_when_the_processing_is_killed_and_what_is_there_is_used(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path)
    process, worker = begun(cell)
    (result_of(cell) / PICTURES).parent.mkdir(parents=True, exist_ok=True)
    (result_of(cell) / PICTURES).write_text("no folder: nothing can be drawn")
    cells.wait_until(lambda: status(cell.run_folder)["undrawn"], "a picture that cannot be drawn")
    assert is_beside(worker), "a picture is no reason to end"
    assert has_samples(cell)
    os.kill(worker, signal.SIGKILL)
    ended = cells.finish(process)
    said = frames_alone_count(ended)
    assert not said["is_whole"]
    assert "killed by signal 9" in said["why"]
    assert "The acquisition continues without it" in ended.err
    told = status(cell.run_folder)
    assert told["state"] == "ended"
    assert "killed by signal 9" in told["why"]
    assert told["remedy"] == f"coupole reflectance {cell.run_folder} --out {result_of(cell)}"
    assert told["remedy"] in ended.err
    kept = {path.name: path.stat().st_mtime_ns for path in (result_of(cell) / "samples").glob("*.json")}
    again = cells.here(*told["remedy"].split()[1:])
    assert again.code == 0, again.err
    for name, mtime_ns in kept.items():
        assert (result_of(cell) / "samples" / name).stat().st_mtime_ns == mtime_ns
    same_result(result_of(cell), made_afterwards(cell, tmp_path / "afterwards"))


def test_a_run_does_not_wait_for_a_processing_that_is_stopped(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path)
    process, worker = begun(cell)
    os.kill(worker, signal.SIGSTOP)
    said = frames_alone_count(cells.finish(process))
    assert not said["is_whole"]
    assert "is stopped (SIGSTOP)" in said["why"]
    assert not cells.alive(worker)


@pytest.mark.parametrize("by", ["Ctrl-C", "coupole stop"])
def test_a_stop_during_the_fits_ends_the_command_and_the_run_stays_complete(tmp_path: Path, by: str) -> None:
    cell = cell_of_three_views(tmp_path)
    process, worker = begun(cell)
    cells.wait_until(lambda: cells.events(cell.run_folder, "stop"), "the end of the session")
    if by == "Ctrl-C":
        process.send_signal(signal.SIGINT)
    else:
        stopped = cells.here("stop", cell.plan)
        assert stopped.code == 0, stopped.err
    ended = cells.finish(process)
    assert ended.code == 130, ended.err
    assert "the frames are complete; their result is not: stopped while it was made" in ended.err
    assert not cells.alive(worker)
    assert cells.events(cell.run_folder, "stop")[-1]["outcome"] == "done"


def test_a_disk_that_fails_at_the_end_hides_no_other_error(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path)
    beside = ProcessingBeside(cell.plan, cell.rig, None, make_console(quiet=True))
    beside._run = tmp_path / "a run whose files are gone"

    def session() -> None:
        with beside:
            raise ValueError("what ended the run")

    with pytest.raises(ValueError, match="what ended the run"):
        session()


def test_a_processing_that_gets_no_more_memory_says_so_and_is_no_defect(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path)
    process, worker = begun(cell)
    cells.wait_until(result_of(cell).is_dir, "the folder in which the reason is left")
    resource.prlimit(worker, resource.RLIMIT_AS, (LITTLE_BYTES, resource.RLIM_INFINITY))
    ended = cells.finish(process)
    said = frames_alone_count(ended)
    assert not said["is_whole"]
    assert f"memory did not suffice: process {worker} may have 0.30 GB of address space" in said["why"]
    assert "defect" not in ended.err
    assert status(cell.run_folder)["why"] == said["why"]


def test_only_a_shortage_of_memory_is_called_so_and_no_error_is_hidden_behind_it() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", WORDS_UNDER_A_LIMIT], capture_output=True, text=True, check=True, cwd=cells.REPO
    )
    unlimited, limited, used_up, of_memory = ended.stdout.splitlines()
    assert unlimited == "TypeError: int(). This is a defect of Coupole: please report it"
    assert limited.startswith(
        "TypeError: int(). Unless the limit of memory is the cause, this is a defect of Coupole"
    )
    assert "may have 2.45 GB of address space" in limited
    for words, error in ((used_up, "TypeError: int()"), (of_memory, "ValueError: x")):
        assert words.startswith("memory did not suffice: process ")
        assert words.endswith(f"({error})")


def test_a_processing_with_too_little_memory_is_refused_before_anything_moves(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path)
    with ProcessingBeside(cell.plan, cell.rig, None, make_console(quiet=True)) as processing:
        (worker,) = [child for child in cells.children(os.getpid()) if is_beside(child)]
        resource.prlimit(worker, resource.RLIMIT_AS, (LITTLE_BYTES, resource.RLIM_INFINITY))
        (refusal,) = processing.refusals()
    assert refusal.startswith(f"--reflectance: memory did not suffice: process {worker} may have 0.30 GB")


@pytest.mark.parametrize("stopped", [False, True])
def test_a_run_that_is_killed_leaves_no_process(tmp_path: Path, *, stopped: bool) -> None:
    cell = cell_of_three_views(tmp_path)
    process, worker = begun(cell)
    if stopped:
        os.kill(worker, signal.SIGSTOP)
    process.kill()
    cells.finish(process)
    end_s = time.monotonic() + 5.0
    while is_beside(worker) and time.monotonic() < end_s:
        time.sleep(0.02)
    assert not is_beside(worker)
    cells.wait_until(lambda: status(cell.run_folder)["state"] == "ended", "the end of what held the run")
    assert status(cell.run_folder)["remedy"] == ""  # the run goes on first, and the processing with it


def test_a_resumed_run_goes_on_with_what_was_asked(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path)
    process, worker = begun(cell)
    cells.wait_until(lambda: len(cells.events(cell.run_folder, "view")) == 2, "the second view")
    assert cells.here("pause", cell.run_folder).code == 0  # the third is not begun
    cells.wait_until(lambda: read_growing(result_of(cell)).of_views, "pictures of a view")
    process.send_signal(signal.SIGINT)
    ended = cells.finish(process)
    assert ended.code == 130, ended.err
    assert not is_beside(worker)
    drawn = read_growing(result_of(cell))
    assert drawn.of_views
    assert all(file_so_far(result_of(cell), name) for name in drawn.files), "they stay until others replace them"
    assert ended.document["reflectance"]["why"] == "the processing ended with the run, which is not complete"
    kept = {path.name: path.stat().st_mtime_ns for path in (result_of(cell) / "samples").glob("*.json")}
    resumed = cells.here("acquire", "--resume", cell.run_folder, "--yes", "--json")
    assert frames_alone_count(resumed)["is_whole"]
    for name, mtime_ns in kept.items():
        assert (result_of(cell) / "samples" / name).stat().st_mtime_ns == mtime_ns
    same_result(result_of(cell), made_afterwards(cell, tmp_path / "afterwards"))
    shutil.rmtree(result_of(cell))
    assert status(cell.run_folder)["state"] == "ended"
    whole = cells.here("acquire", "--resume", cell.run_folder, "--yes", "--json")
    assert whole.document["reflectance"]["is_whole"], whole.err


def test_what_cannot_be_made_is_refused_before_anything_moves(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path)
    cell.write(calibrations="none")
    ended = cell.acquire("--reflectance", "--result", tmp_path / "plan.yaml/result")
    assert ended.code == 3, ended.err
    assert "expected calibration records of the kinds hand-eye, leds, led-power" in ended.err
    assert "expected a folder that can be made" in ended.err
    assert not (tmp_path / "storage").exists() or not list((tmp_path / "storage").glob("2*"))


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        ({"object": {"id": "nobody"}}, "expected the object's mesh"),
        ({"gain_db": 6.0}, "is valid for a gain of"),
        ({"lights": {"kind": "panels", "panels": [1]}}, "expected single LEDs"),
    ],
)
def test_what_is_lacking_is_told(tmp_path: Path, plan: dict[str, Any], words: str) -> None:
    cell = cell_of_three_views(tmp_path)
    assert reasons_against(cell.plan, None, None, None) == []
    cell.write(**plan)
    (reason,) = reasons_against(cell.plan, None, None, None)
    assert words in reason


@pytest.mark.parametrize(("result", "words"), [("/proc/no/result", "/proc: "), ("plan.yaml/result", "is a file")])
def test_a_result_folder_that_cannot_be_made_is_told(tmp_path: Path, result: str, words: str) -> None:
    (reason,) = reasons_against(cell_of_three_views(tmp_path).plan, None, tmp_path / result, None)
    assert "expected a folder that can be made" in reason
    assert words in reason


def test_the_result_of_another_run_is_neither_touched_nor_taken_for_this_ones(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path)
    assert cell.acquire("--reflectance", "--result", tmp_path / "first").code == 0
    first = {name: path.read_bytes() for name, path in files(tmp_path / "first").items()}
    refused = cell.acquire("--reflectance", "--result", tmp_path / "first")
    assert refused.code == 3, refused.err
    assert "expected a new folder, or the folder of this run's result" in refused.err
    assert cell.acquire().code == 0
    second = sorted((tmp_path / "storage").glob("2*/run.json"))[-1].parent
    refused = cells.here("acquire", "--resume", second, "--result", tmp_path / "first", "--yes")
    assert refused.code == 3, refused.err
    journal = second / "journal.jsonl"  # as an older version, or a hand, might have left it
    line = json.dumps(
        {"t": "2026-01-01T00:00:00.000000Z", "event": "processing", "result": str(tmp_path / "first")}
    )
    journal.write_text(journal.read_text() + line + "\n")
    assert status(second)["state"] == "ended"
    assert {name: path.read_bytes() for name, path in files(tmp_path / "first").items()} == first


def test_a_folder_with_other_content_is_refused(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("dear all")
    ended = cell.acquire("--reflectance", "--result", tmp_path / "mine")
    assert ended.code == 3, ended.err
    assert "found other content" in ended.err
    assert (tmp_path / "mine/letter.txt").exists()
    refused = cells.here("acquire", cell.plan, "--reflectance", "--dry-run")
    assert refused.code == 2
