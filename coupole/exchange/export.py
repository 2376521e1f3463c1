"""Frames of a run for other programs: one file for each frame, named after its shot."""

from __future__ import annotations

import fnmatch
import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from coupole.errors import InputError
from coupole.exchange import dng, tiff_for_the_eye
from coupole.exchange.exported_frame import Picture
from coupole.exchange.formats import Source, Writer, format_named
from coupole.exchange.kept_frames import refuse_discarded
from coupole.exchange.run_colour import ColourWanted, colour_of_run
from coupole.exchange.target_folder import refuse_standing, writing_into
from coupole.plan.shot_id import ShotId
from coupole.storage.journal_events import FrameProven
from coupole.storage.run import Run
from coupole.storage.step_fields import STORED_NO_LED, board_temperature_c
from coupole.storage.view_reader import read_view


@dataclass(frozen=True)
class Exported:
    """Number and size of the files that `export_run` wrote."""

    files: int
    bytes: int


@dataclass(frozen=True)
class FramePatterns:
    """Names of frames, with `*` and `?`. View and label (`led0417/e0`) must each match one of their patterns;
    without patterns all do."""

    views: Sequence[str] = ()
    shots: Sequence[str] = ()

    def has(self, shot: ShotId) -> bool:
        return _matches(shot.view, self.views) and _matches(str(shot.label), self.shots)


ALL_FRAMES = FramePatterns()


def export_run(
    run: Run,
    to: str,
    folder: Path,
    *,
    patterns: FramePatterns = ALL_FRAMES,
    colour: ColourWanted | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Exported:
    """Write proven frames whose view and label match `patterns` into `folder`, as `<view>_led0417_e0.<to>`. With
    `colour`, a TIFF has colours (sRGB for the eye, or linear values), and a DNG contains the colour matrix.

    Raises InputError if nothing matches or a file exists already (unless `overwrite`), before anything is written;
    ChecksumMismatch if a frame differs from the proven one, DiskFull or StorageError.
    """
    encode = _encoder(to, run, colour)
    frames = [frame for shot, frame in run.proven().items() if patterns.has(shot)]
    if not frames:
        raise InputError(f"{run.folder}: no proven frame matches; see `coupole status` for its views")
    refuse_discarded(run, [frame.shot for frame in frames], _words_of_kept)
    paths = {str(frame.shot): folder / f"{str(frame.shot).replace('/', '_')}.{to}" for frame in frames}
    if not overwrite:
        refuse_standing(list(paths.values()))
    total_bytes = 0
    with writing_into(folder):
        for count, picture in enumerate(_pictures(run, frames), start=1):
            total_bytes += _write(paths[picture.about["shot"]], encode(picture))
            progress(count, len(frames))
    return Exported(len(frames), total_bytes)


def _words_of_kept(kept_shots: Sequence[ShotId]) -> str:
    label = str(kept_shots[0].label) if kept_shots else "dark*"
    return f"With --shots, name frames that were not discarded, such as `{label}`; "


def _encoder(to: str, run: Run, colour: ColourWanted | None) -> Callable[[Picture], bytes]:
    format_named(to, Source.RUN, Writer.FRAMES)
    if colour is None:
        encode: Callable[[Picture], bytes] = importlib.import_module(f"coupole.exchange.{to}").encode
        return encode
    camera_colour = colour_of_run(run, colour)
    if to == "dng":
        return partial(dng.encode, colour=camera_colour)
    return partial(tiff_for_the_eye.encode, colour=camera_colour, linear=colour.is_linear)


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return not patterns or any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def _pictures(run: Run, frames: list[FrameProven]) -> Iterator[Picture]:
    """Yield the frames, in the order of their files and slots."""
    by_file: dict[str, list[FrameProven]] = {}
    for frame in sorted(frames, key=lambda f: (f.file, f.index)):
        by_file.setdefault(frame.file, []).append(frame)
    for name, file_frames in by_file.items():
        path = run.folder / name
        file = read_view(path, file_frames)
        attributes = _plain(file.attributes)
        for frame in file_frames:
            pixels = file.proven_pixels(frame)
            record = file.records[frame.index]
            pose = file.poses[record["pose"]]
            about = {
                "shot": str(frame.shot),
                "run": run.folder.name,
                "led": None if record["led"] == STORED_NO_LED else int(record["led"]),
                "exposure_us": int(record["exposure_us"]),
                "board_temperature_c": board_temperature_c(record),
                "led_current_ma": int(record["led_current_ma"]),
                "frame_id": frame.frame_id,
                "xxh3": frame.xxh3,
                "joints_deg": pose["joints_deg"].tolist(),
                "base_from_camera": pose["base_from_camera"].tolist(),
                **attributes,
            }
            yield Picture(
                pixels,
                pattern=file.pattern,
                black_dn=file.black_dn,
                white_dn=file.white_dn,
                exposure_us=int(record["exposure_us"]),
                taken_utc=frame.t,
                about=about,
            )


def _plain(attributes: dict[str, Any]) -> dict[str, Any]:
    """Return attributes of a view's file (object, lens, gain) as JSON types."""
    entries = {key: value for key, value in attributes.items() if key not in ("NX_class", "default")}
    return {key: np.asarray(value).tolist() for key, value in entries.items()}


def _write(path: Path, content: bytes) -> int:
    """Write atomically: the file gets its name when all its bytes are written."""
    partial = path.with_name(f".{path.name}.part")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return len(content)
