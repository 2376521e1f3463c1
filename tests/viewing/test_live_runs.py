"""What `live RUN` says of a run that nobody acquires any more."""

from __future__ import annotations

import threading
from pathlib import Path

import cells
from archives import make_run

from coupole.viewing.live import Choice, RunSource, Studio


def test_the_last_frame_of_a_killed_run_is_not_passed_off_as_live(tmp_path: Path) -> None:
    run = make_run(tmp_path, shots=2, missing=("side/led0001/e0",)).run
    lines = run.journal_path.read_text().splitlines(keepends=True)
    run.journal_path.write_text("".join(line for line in lines if '"stop"' not in line))
    studio = Studio(Choice(None, 0))
    source = threading.Thread(target=RunSource(run.folder).frames, args=(studio,))
    source.start()
    try:
        shown = cells.wait_until(lambda: studio.shown_frame, "the last frame")
        assert shown.run == "interrupted, 3 of 4 shots proven"
        assert studio.remark == "the run is not being acquired (interrupted): this is its last frame"
    finally:
        studio.closing.set()
        source.join()
