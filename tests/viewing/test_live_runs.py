"""What `live RUN` says of a run that nobody acquires any more."""

from __future__ import annotations

import json
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cells
import pytest
from archives import make_run

from coupole.errors import FrameDiscarded
from coupole.storage.discarding import append_to_journal, discard
from coupole.storage.given_back import why_not
from coupole.storage.journal_events import FramesDiscarded
from coupole.storage.run import Run
from coupole.viewing.live import Choice, RunSource, Studio


def test_the_last_frame_of_a_killed_run_is_not_passed_off_as_live(tmp_path: Path) -> None:
    run = make_run(tmp_path, shots=2, missing=("side/led0001/e0",)).run
    lines = run.journal_path.read_text().splitlines(keepends=True)
    run.journal_path.write_text("".join(line for line in lines if '"stop"' not in line))
    with watched(run) as studio:
        shown = cells.wait_until(lambda: studio.shown_frame, "the last frame")
        assert shown.run == "interrupted, 3 of 4 shots proven"
        assert studio.remark == "the run is not being acquired (interrupted): this is its last frame"


@pytest.mark.skipif(bool(why_not(Path(tempfile.gettempdir()))), reason="the disk cannot give back parts of files")
def test_of_a_run_whose_frames_were_discarded_the_newest_that_is_kept_is_shown(tmp_path: Path) -> None:
    run = discarding_run(tmp_path)
    discard_shots(run, "side", ("side/led0001/e0", "side/led0002/e0", "side/led0003/e0"))
    with watched(run) as studio:
        shown = cells.wait_until(lambda: studio.shown_frame, "a frame that is kept")
        assert shown.title == "side/led0000/e0"
        assert studio.remark.endswith("(done): this is its newest frame that was not discarded")


@pytest.mark.skipif(bool(why_not(Path(tempfile.gettempdir()))), reason="the disk cannot give back parts of files")
def test_of_a_run_that_keeps_no_frame_it_is_said_what_shows_it(tmp_path: Path) -> None:
    run = discarding_run(tmp_path)
    for view in ("top", "side"):
        discard_shots(run, view, tuple(f"{view}/led{led:04d}/e0" for led in range(4)))
    with pytest.raises(FrameDiscarded, match=f"`coupole show {tmp_path / 'result'} --out FILE.html`"):
        RunSource(run.folder).frames(Studio(Choice(None, 0)))


@contextmanager
def watched(run: Run) -> Iterator[Studio]:
    """The studio into which a run's frames come."""
    studio = Studio(Choice(None, 0))
    source = threading.Thread(target=RunSource(run.folder).frames, args=(studio,))
    source.start()
    try:
        yield studio
    finally:
        studio.closing.set()
        source.join()


def discarding_run(folder: Path) -> Run:
    run = make_run(folder).run
    description = run.folder / "run.json"
    description.write_text(json.dumps({**json.loads(description.read_text()), "discard": "after_fit"}))
    return Run(run.folder)


def discard_shots(run: Run, view: str, shots: tuple[str, ...]) -> None:
    frames = tuple((shot, frame.xxh3) for shot, frame in run.proven().items() if str(shot) in shots)
    assert len(frames) == len(shots)
    result = str(run.folder.parent / "result")
    event = FramesDiscarded(view=view, frames=frames, result=result, samples=f"samples/{view}.h5", digest="0" * 64)
    discard(run, event, append_to_journal(run))
