"""Three sessions of a run and its archive, without devices: what the test of `write_cuts` records.

    python recorded_session.py FOLDER

The first session ends as kill -9 ends one: in the middle, nothing closed.
"""

from __future__ import annotations

import mmap
import sys
from pathlib import Path
from typing import Literal

import numpy as np

from coupole.acquisition.conclusion import conclude, open_for_session
from coupole.acquisition.recorder import RunRecorder, ViewStart
from coupole.devices import ArmState, Frame, FrameFormat
from coupole.plan.shot_id import ShotId
from coupole.storage.archive import archive_run
from coupole.storage.bitshuffle import codec_of
from coupole.storage.journal_events import SessionResumed, SessionStarted, SessionStopped, ViewBegun
from coupole.storage.run import Run
from coupole.storage.run_inputs import Inputs
from coupole.viewing.terminal import make_console

FORMAT = FrameFormat(height_px=32, width_px=64, bit_depth=12, bayer_pattern="GBRG", black_dn=64, white_dn=4095)
VIEWS = ("top", "side")
JOINTS_DEG = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
LABELS = tuple(f"led{number:04d}/e0" for number in range(5))
METADATA = {"sample": "relief", "simulated": True, "pixel_pitch_um": 5.5, "focal_length_mm": 35.0}
ABOUT = {"views": list(VIEWS), "labels": list(LABELS), "simulated": True, "object": None}


def inputs_in(folder: Path) -> Inputs:
    """The plan and what it names; the test writes them."""
    return Inputs(folder / "plan.yaml", folder / "rig.yaml", (folder / "dome.csv",))


def picture(number: int) -> Frame:
    memory = np.frombuffer(mmap.mmap(-1, FORMAT.frame_bytes), np.uint16).reshape(FORMAT.height_px, FORMAT.width_px)
    memory[:] = np.random.default_rng(number).integers(0, 4096, memory.shape)
    return Frame(frame_id=number, timestamp_ns=1000 * number, pixels=memory)


def begin_view(recorder: RunRecorder, view: str) -> None:
    arm = ArmState(JOINTS_DEG, np.eye(4), 7, moving=False)
    collections = {"shadow": {"leds": np.arange(5)}}
    recorder.begin_view(ViewStart(view, len(LABELS), FORMAT, arm, np.eye(4), collections))


def take(recorder: RunRecorder, shot: str) -> None:
    """One frame that is proven, and one that is not and gives its slot back."""
    number = sum(shot.encode())
    recorder.free(recorder.store(picture(number + 1000), 8000))
    slot = recorder.store(picture(number), 8000)
    led = LABELS.index(shot.partition("/")[2])
    recorder.prove(slot, ShotId.parse(shot), {"led": led, "step": 2, "t_trigger_ns": 3})


def main(folder: Path) -> None:
    run = Run.create(folder / "runs", "recorded", inputs_in(folder), ABOUT)
    open_for_session(run)
    first = RunRecorder(run, METADATA)
    first.note(SessionStarted(simulated=True))
    first.note(ViewBegun(view="top"))
    begin_view(first, "top")
    for label in LABELS[:2]:
        take(first, f"top/{label}")
        first.commit(now=True)
    take(first, f"top/{LABELS[2]}")  # and then it is killed

    go_on(run, LABELS[:4], "interrupted")
    go_on(run, LABELS, "done")
    archive_run(run, codec_of("lz4"), keep=True)


def go_on(run: Run, labels: tuple[str, ...], outcome: Literal["interrupted", "done"]) -> None:
    """A later session, which takes these shots of each view and ends in order."""
    open_for_session(run)
    recorder = RunRecorder(run, METADATA)
    recorder.note(SessionResumed(simulated=True))
    for view in VIEWS:
        recorder.note(ViewBegun(view=view))
        begin_view(recorder, view)
        for label in labels:
            if ShotId.parse(f"{view}/{label}") not in recorder.proven():
                take(recorder, f"{view}/{label}")
                recorder.commit(now=True)
        recorder.end_view()
    recorder.note(SessionStopped(outcome=outcome))
    recorder.close_quietly()
    recorder.close()
    (run.folder / f"trace-{outcome}.txt").write_text("as an unexpected error leaves one, not synced")
    conclude(run, make_console(quiet=True))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
