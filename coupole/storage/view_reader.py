"""One view's file for readers of proven frames: pixels, records and poses, which are checked against each
other."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import ChecksumMismatch, FrameDiscarded, StorageError
from coupole.storage import frame_file
from coupole.storage.frame_file import Layout
from coupole.storage.journal_events import FrameProven


@dataclass(frozen=True)
class View:
    """Frames are named by their slots, as `FrameProven.index` gives them."""

    path: Path
    layout: Layout
    records: NDArray[np.void]
    """[slots], FRAME_DTYPE."""
    poses: NDArray[np.void]
    """POSE_DTYPE; a record's `pose` is a row of it."""
    attributes: dict[str, Any]
    """Attributes of the file: object, lens, camera, gain."""
    pattern: str
    black_dn: int
    white_dn: int

    def pixels(self, slot: int) -> NDArray[np.uint16]:
        """Return [H, W], DN. Raises StorageError, FrameDiscarded."""
        self._refuse_discarded(slot)
        return frame_file.read_frame(self.path, self.layout, slot)

    def proven_pixels(self, frame: FrameProven) -> NDArray[np.uint16]:
        """Return [H, W], DN, of a frame of this file. Raises StorageError, FrameDiscarded, and ChecksumMismatch if
        the pixels differ from the proven ones."""
        return self._proven(frame, self.pixels(frame.index))

    def read_proven_pixels(self, frame: FrameProven, pixels: NDArray[np.uint16]) -> None:
        """Read the same into the caller's memory [H, W], as `frame_file.read_frame_into` does."""
        self._refuse_discarded(frame.index)
        frame_file.read_frame_into(self.path, self.layout, frame.index, pixels)
        self._proven(frame, pixels)

    def _refuse_discarded(self, slot: int) -> None:
        if self.is_discarded(slot):
            raise FrameDiscarded(
                f"{self.path}: {self.records[slot]['shot'].decode(errors='replace')} was discarded when its "
                "samples of reflectance were safe, as its plan said (`discard: after_fit`). `coupole verify` "
                "says which result has these samples, and `coupole reflectance relight` makes pictures from this "
                "result; frames of LEDs that are kept for the check, and dark frames, are still there"
            )

    def is_discarded(self, slot: int) -> bool:
        """Tell whether the pixels of a proven frame were discarded."""
        return bool(self.records[slot]["state"] == frame_file.DISCARDED)

    def _proven(self, frame: FrameProven, pixels: NDArray[np.uint16]) -> NDArray[np.uint16]:
        if f"{frame_file.checksum(pixels):016x}" != frame.xxh3:
            raise ChecksumMismatch(
                f"{self.path}: {frame.shot} differs from what was proven. See `coupole verify`."
            )
        return pixels

    def number(self, name: str) -> float | None:
        """Return an attribute that is a number; None if the file lacks it. Raises StorageError."""
        if (value := self.attributes.get(name)) is None:
            return None
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number):
            raise StorageError(f"{self.path}: `{name}` is not a number: {value!r:.40}")
        return number


def refuse_lost(folder: Path, frames: Iterable[FrameProven]) -> None:
    """Raise StorageError if the file of one of these frames is missing, is not a view's file, or ends before the
    frame. Checksums are not compared (`coupole verify` compares them)."""
    last_slots: dict[str, int] = {}
    for frame in frames:
        last_slots[frame.file] = max(frame.index, last_slots.get(frame.file, -1))
    for name, last_slot in last_slots.items():
        path = folder / name
        if not path.is_file():
            raise StorageError(
                f"{path}: is missing, and the journal has proven frames of it. Put it back, then resume the run; "
                "if it is gone, these frames are lost: begin a new run."
            )
        try:
            layout = frame_file.read_layout(path)
        except StorageError as error:
            raise StorageError(
                f"{error}. Restore it, then resume the run; if that is impossible, its frames are lost: begin a "
                "new run."
            ) from error
        end_bytes = layout.data_offset + (last_slot + 1) * layout.frame_bytes
        if not layout.is_archived and path.stat().st_size < end_bytes:
            raise StorageError(
                f"{path}: ends within slot {last_slot}, although the journal has a proven frame of this slot. "
                "Restore it, then resume the run; if that is impossible, its frames are lost: begin a new run."
            )


def read_view(path: Path, frames: Iterable[FrameProven]) -> View:
    """Return the file that holds these frames. Raises StorageError if the file is damaged, or lacks one of the
    frames.
    """
    layout, records = frame_file.read_layout(path), frame_file.read_frames(path)
    poses, attributes = frame_file.read_poses_and_attributes(path)
    for frame in frames:
        if not 0 <= frame.index < layout.frames:
            raise StorageError(f"{path}: has no slot {frame.index}, where the journal has {frame.shot}")
        if records[frame.index]["pose"] >= len(poses):
            raise StorageError(f"{path}: slot {frame.index} names a pose that the file does not have")
    return View(path, layout, records, poses, attributes, **frame_file.read_facts(path))
