"""Small view files with random pixels, for tests of what is on disk."""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import Any

import numpy as np

from coupole.devices import FrameFormat
from coupole.storage.frame_file_creation import create
from coupole.storage.view_writer import ViewWriter

FORMAT = FrameFormat(height_px=64, width_px=128, bit_depth=12, bayer_pattern="GBRG", black_dn=64, white_dn=4095)
ODD = FrameFormat(height_px=30, width_px=50, bit_depth=12, bayer_pattern="GBRG", black_dn=64, white_dn=4095)
METADATA = {"title": "test", "sample": "relief", "simulated": True, "pixel_pitch_um": 44.0}
DATA = "entry/instrument/detector/data"
FRAMES = "entry/instrument/detector/frames"
SLOTS = 6


def frame(number: int, of: FrameFormat = FORMAT) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """Pixels in page-aligned memory, as drivers deliver them."""
    memory = np.frombuffer(mmap.mmap(-1, of.frame_bytes), np.uint16).reshape(of.height_px, of.width_px)
    memory[:] = np.random.default_rng(number).integers(0, 4096, memory.shape)
    return memory


def write_view(path: Path, proven: int = 3, stored: int = 1, of: FrameFormat = FORMAT) -> dict[str, int]:
    """A view's file with proven and merely stored frames; returns the checksums of the proven shots."""
    create(path, SLOTS, of, METADATA)
    writer = ViewWriter(path, {})
    checksums = {}
    try:
        for number in range(proven + stored):
            slot = writer.store(
                frame(number, of), frame_id=100 + number, camera_ns=1000 * number, exposure_us=8000
            )
            if number < proven:
                shot = f"{path.stem}/led{number:04d}/e0"
                checksums[shot] = writer.prove(slot, shot, led=number, step=number, t_trigger_ns=number)
        writer.sync()
    finally:
        writer.close()
    return checksums
