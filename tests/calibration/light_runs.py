"""Small runs with frames of the tests' own sensor: what the commands of radiometric calibration are given."""

from __future__ import annotations

import mmap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from archives import METADATA
from numpy.typing import NDArray

from coupole.devices import ArmState, FrameFormat
from coupole.storage.frame_file_creation import create
from coupole.storage.journal import Journal
from coupole.storage.journal_events import FrameProven, SessionStarted, SessionStopped
from coupole.storage.run import Run
from coupole.storage.run_inputs import Inputs
from coupole.storage.view_writer import ViewWriter

SIZE_PX = (128, 96)
FORMAT = FrameFormat(
    height_px=SIZE_PX[1], width_px=SIZE_PX[0], bit_depth=12, bayer_pattern="GBRG", black_dn=64, white_dn=4095
)
PITCH_UM = 176.0
FOCAL_PX = 35.0 * 335.0 / (335.0 - 35.0) * 1e3 / PITCH_UM
"""At the focus of 335 mm."""


@dataclass(frozen=True)
class Taken:
    """One frame: view and shot, as `v/panel1/e0/r1`."""

    shot: str
    exposure_us: int
    base_from_camera: NDArray[np.float64]
    pixels: NDArray[np.uint16]


def write_light_run(folder: Path, frames: Sequence[Taken]) -> Path:
    """A run with these frames, all proven and of one size; returns its folder."""
    height_px, width_px = frames[0].pixels.shape
    frame_format = replace(FORMAT, height_px=height_px, width_px=width_px)
    folder.mkdir(parents=True)
    for name in ("plan.yaml", "rig.yaml"):
        (folder / name).write_text(f"# {name}\n")
    views = list(dict.fromkeys(frame.shot.split("/")[0] for frame in frames))
    labels = list(dict.fromkeys(frame.shot.split("/", 1)[1] for frame in frames))
    about = {"views": views, "labels": labels, "simulated": True}
    run = Run.create(folder, "light", Inputs(folder / "plan.yaml", folder / "rig.yaml", ()), about)
    diary = Journal(run.journal_path)
    diary.write(SessionStarted())
    for view in views:
        mine = [frame for frame in frames if frame.shot.split("/")[0] == view]
        path = run.view_path(view)
        metadata = {**METADATA, "title": view, "focus_distance_mm": 335.0, "pixel_pitch_um": PITCH_UM}
        create(path, len(mine), frame_format, metadata)
        writer = ViewWriter(path, {})
        arm = ArmState((0, -90, 90, 0, 90, 0), np.eye(4), 7, moving=False)
        pose = writer.add_pose(arm, mine[0].base_from_camera)
        for number, frame in enumerate(mine):
            pixels = np.frombuffer(mmap.mmap(-1, frame_format.frame_bytes), np.uint16).reshape(frame.pixels.shape)
            pixels[:] = frame.pixels
            slot = writer.store(pixels, frame_id=number, camera_ns=number, exposure_us=frame.exposure_us)
            digest = writer.prove(
                slot, frame.shot, led=0, pose=pose, board_temperature_dc=250, t_trigger_ns=10**9 * number
            )
            file = str(path.relative_to(run.folder))
            diary.write(
                FrameProven(shot=frame.shot, file=file, index=slot, frame_id=number, xxh3=f"{digest:016x}")
            )
        writer.sync()
        writer.close()
    diary.write(SessionStopped(outcome="done"))
    diary.commit()
    diary.close()
    return run.folder
