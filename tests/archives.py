"""Runs made without a cell, to archive and export: views of proven frames, with a journal that says so."""

from __future__ import annotations

import mmap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coupole.devices import ArmState, FrameFormat
from coupole.storage.frame_file_creation import create
from coupole.storage.journal import Journal
from coupole.storage.journal_events import FrameProven, SessionStarted, SessionStopped
from coupole.storage.run import Run
from coupole.storage.run_inputs import Inputs
from coupole.storage.view_writer import ViewWriter

FORMAT = FrameFormat(height_px=96, width_px=128, bit_depth=12, bayer_pattern="GBRG", black_dn=64, white_dn=4095)
METADATA = {
    "program_name": "coupole",
    "sample": "relief",
    "simulated": True,
    "pixel_pitch_um": 5.5,
    "focal_length_mm": 35.0,
    "focus_distance_mm": 335.0,
    "f_number": 8.0,
    "base_from_support": np.eye(4),
    "camera": "memory camera sim-0",
}
DATA = "entry/instrument/detector/data"
FRAMES = "entry/instrument/detector/frames"
Frame = np.ndarray[Any, np.dtype[np.uint16]]


def noisy_frame(number: int, of: FrameFormat = FORMAT) -> Frame:
    """A dim picture with noise of a few DN, as a sensor's, in page-aligned memory, as drivers deliver it."""
    random = np.random.default_rng(number)
    slope = np.linspace(0, 300, of.width_px)[None, :] * np.ones((of.height_px, 1))
    noisy = of.black_dn + slope + random.normal(0, 4, slope.shape)
    pixels = np.frombuffer(mmap.mmap(-1, of.frame_bytes), np.uint16).reshape(of.height_px, of.width_px)
    pixels[:] = np.clip(np.rint(noisy), 0, of.white_dn)
    return pixels


@dataclass(frozen=True)
class MadeRun:
    """A run and the frames that were proven in it, by shot."""

    run: Run
    frames: dict[str, Frame]


def make_run(
    folder: Path,
    *,
    views: tuple[str, ...] = ("top", "side"),
    shots: int = 4,
    of: FrameFormat = FORMAT,
    missing: tuple[str, ...] = (),
    packed: bool = False,
) -> MadeRun:
    """A run of some views with `shots` proven frames each, but for those `missing`; every view has one frame that
    was stored and never proven, and two slots that are free. Frames are stored `packed` if so wanted."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("plan.yaml", "rig.yaml"):
        (folder / name).write_text(f"# {name}\n")
    labels = [f"led{number:04d}/e0" for number in range(shots)]
    about = {"views": list(views), "labels": labels, "simulated": True}
    run = Run.create(folder, "made", Inputs(folder / "plan.yaml", folder / "rig.yaml", ()), about)
    diary, frames = Journal(run.journal_path), {}
    diary.write(SessionStarted())
    for place, view in enumerate(views):
        path = run.view_path(view)
        create(path, shots + 3, of, {**METADATA, "title": view}, is_packed=packed)
        writer = ViewWriter(path, {})
        pose = writer.add_pose(ArmState((1, 2, 3, 4, 5, 6), np.eye(4), 7, moving=False), 2 * np.eye(4))
        writer.store(noisy_frame(999, of), frame_id=999, camera_ns=999, exposure_us=8000)
        for number, label in enumerate(labels):
            shot, pixels = f"{view}/{label}", noisy_frame(100 * place + number, of)
            if shot in missing:
                continue
            slot = writer.store(pixels, frame_id=number, camera_ns=number, exposure_us=8000)
            digest = writer.prove(slot, shot, led=number, pose=pose, board_temperature_dc=251, led_current_ma=700)
            file = str(path.relative_to(run.folder))
            diary.write(FrameProven(shot=shot, file=file, index=slot, frame_id=number, xxh3=f"{digest:016x}"))
            frames[shot] = pixels
        writer.sync()
        writer.close()
    diary.write(SessionStopped(outcome="done"))
    diary.commit()
    diary.close()
    return MadeRun(run, frames)
