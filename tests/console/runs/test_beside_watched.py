"""What the console says of the process beside a run: that it is stopped, and that it shows no sign of life."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cells
import pytest
from cells import CellFolder

from coupole.console.runs import run_watch
from coupole.console.runs.run_files import RunFiles
from coupole.console.runs.run_watch import RunWatch
from coupole.console.screens.growing_panel import basis_in_words, state_in_words
from coupole.errors import InputError
from coupole.storage.growing_pictures import ViewPictures
from coupole.storage.line_file import utc_now
from coupole.storage.processing import Processing, Progress, tell

HANGS = """
import sys, time
from pathlib import Path
from coupole.storage.processing import hold_result
with hold_result(Path(sys.argv[1])):
    print("held", flush=True)
    if sys.argv[2] == "hangs":
        time.sleep(600)
    while True:
        pass
"""
"""A process that holds a result: one that hangs, and one that computes."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cell = CellFolder(tmp_path_factory.mktemp("watched"))
    cell.write(lights={"kind": "every", "every": 200})
    assert cell.acquire().code == 0
    return cell.run_folder


@pytest.fixture
def result(run: Path, tmp_path: Path) -> Iterator[Path]:
    """The folder of its result, which the journal names."""
    journal, folder = run / "journal.jsonl", tmp_path / "result"
    before = journal.read_text()
    journal.write_text(before + f'{{"t": "{utc_now()}", "event": "processing", "result": "{folder}"}}\n')
    yield folder
    journal.write_text(before)


def begun(result: Path, kind: str) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-c", HANGS, str(result), kind], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    tell(result, Progress(step="extracting", views=3))
    return process


@pytest.mark.parametrize("kind", ["hangs", "computes"])
def test_a_process_that_hangs_is_told_and_one_that_computes_is_not(
    run: Path, result: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(run_watch, "SILENT_S", 1.5)
    monkeypatch.setattr(run_watch, "_NO_OFTENER_S", 0.0)
    watch = RunWatch(RunFiles(run.parent, run.parent / "notes"))
    process = begun(result, kind)
    try:
        end_s = time.monotonic() + 4.0
        whys = set()
        while time.monotonic() < end_s:
            processing = watch.of(run.name).processing
            assert processing is not None
            whys.add(processing.why.split(" for ")[0])
            time.sleep(0.1)
        if kind == "computes":
            assert whys == {""}
            return
        assert whys == {"", f"its process {process.pid} reported nothing and computed nothing"}
        words, sign = state_in_words(run, processing, is_acquired=True)
        assert sign == "warm"
        assert "it hangs" in words
        assert f"`kill {process.pid}` ends this process alone" in words
        os.kill(process.pid, signal.SIGSTOP)
        cells.wait_until(lambda: "is stopped" in why_of(watch, run), "that it is stopped")
        process.kill()
        process.wait()
        cells.wait_until(lambda: "ended before" in why_of(watch, run), "its end")
    finally:
        process.kill()
        process.communicate()


def why_of(watch: RunWatch, run: Path) -> str:
    processing = watch.of(run.name).processing
    assert processing is not None
    return processing.why


def test_a_run_without_processing_has_no_result_to_look_at(run: Path) -> None:
    watch = RunWatch(RunFiles(run.parent, run.parent / "notes"))
    watched = watch.of(run.name)
    assert watched.processing is None
    assert watched.growing.of_views == ()
    with pytest.raises(InputError, match="is not processed during its acquisition"):
        watch.result_of(run.name)


@pytest.mark.parametrize(
    ("state", "is_acquired", "remedy", "words", "sign"),
    [
        ("waiting", True, "", "waits for the next complete view; 1 of 3 views extracted", ""),
        ("extracting", True, "", "takes the samples of a complete view", ""),
        ("growing", True, "", "fits the views so far", ""),
        ("fitting", True, "", "All frames are there", ""),
        ("done", True, "", "The result is complete: /r", "good"),
        ("failed", True, "", "failed: MemoryError. 1 of 3 views extracted. No frame is lost", "bad"),
        ("ended", True, "", "coupole reflectance /runs/a --out /r", "bad"),
        ("ended", False, "", "Resume the run", "warm"),
        ("ended", False, "do this", "This continues: do this", "bad"),
    ],
)
def test_each_state_has_words(state: str, is_acquired: bool, remedy: str, words: str, sign: str) -> None:
    why = "MemoryError" if state in ("failed", "ended") else ""
    processing = Processing("/r", state, 1, 3, why=why, remedy=remedy)  # type: ignore[arg-type]
    told, kind = state_in_words(Path("/runs/a"), processing, is_acquired=is_acquired)
    assert words in told
    assert kind == sign


def test_a_look_at_a_view_whose_frames_arrive_says_how_many_it_has() -> None:
    shown = ViewPictures(
        view="top", kind="first-look", fitted_views=1, views=3, frames=43, arrived_frames=128, triangles=5,
        pictures=(), t="2026-01-01T10:20:30.000Z",
    )  # fmt: skip
    words = basis_in_words(shown, is_simulated=False)
    assert "this view alone (43 frames of the 128 that have arrived; 5 triangles in this view)" in words
    assert "arrive" not in basis_in_words(shown.model_copy(update={"arrived_frames": 0}), is_simulated=False)
