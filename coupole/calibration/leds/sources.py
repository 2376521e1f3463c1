"""Collect spots from runs: frames under a single LED, with the pose and dark frames of their view."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from coupole.calibration.leds.matching import LedSightings
from coupole.calibration.leds.spots import find_spots
from coupole.calibration.rotations import Floats
from coupole.calibration.sources import About, about_of, frames_sha256
from coupole.errors import InputError
from coupole.plan.led_table import LedTable
from coupole.plan.shot_id import Led, ShotId
from coupole.storage.durable import sha256
from coupole.storage.journal_events import FrameProven
from coupole.storage.run import Run
from coupole.storage.step_fields import temperature_range_c
from coupole.storage.view_reader import View, read_view


@dataclass(frozen=True)
class LedImages:
    """Spots and poses of some runs."""

    seen: LedSightings
    base_from_flange: Floats
    """[v, 4, 4] poses as the robot reported them."""
    views: tuple[str, ...]
    """[v] names."""
    size_px: tuple[int, int]
    left_out: tuple[str, ...]
    """One line for each bright region that is not a spot."""
    about: About
    inputs: tuple[tuple[str, str], ...]
    """Name and SHA-256 of every file that was read."""
    joints_deg: Floats | None = None
    """[v, axes] angles as the robot reported them; None if it reported none."""


@dataclass(frozen=True)
class _LedFrame:
    """One frame under one LED: the frame of the shortest exposure, if there are several."""

    shot: ShotId
    led: int
    pose: tuple[str, int]
    """Name of the view and number of the pose in it: there are two if the arm was moved during the view."""
    exposure_us: int
    frame: FrameProven


@dataclass
class _Collected:
    """Grows view by view."""

    inputs: list[tuple[str, str]]
    camera: tuple[About, tuple[int, int]] | None = None
    """Properties of the camera, and width and height of its frames, px."""
    views: list[str] = field(default_factory=list)
    poses: list[Floats] = field(default_factory=list)
    joints_deg: list[Floats] = field(default_factory=list)
    lit_records: list[np.void] = field(default_factory=list)
    frames: list[tuple[int, int]] = field(default_factory=list)
    """Number of the view and row of the LED, for each frame."""
    spots: list[tuple[int, int, Floats, Floats]] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


def find_leds(
    paths: Sequence[Path], table: LedTable, progress: Callable[[int, int], None] = lambda done, total: None
) -> LedImages:
    """Find spots in all frames under single LEDs. Raises InputError if there are no such frames, if the dome does
    not have one of the LEDs, or if runs have different cameras."""
    row_of = {int(led): row for row, led in enumerate(table.ids)}
    runs = [Run(path) for path in paths]
    work = [(run, view, frames) for run in runs for view, frames in _by_view(run).items()]
    total = sum(len(frames) for _, _, frames in work)
    if not total:
        raise InputError(
            f"{', '.join(map(str, paths))}: no proven frame under a single LED; acquire the plan first"
        )
    collection = _Collected([(f"{run.folder.name}/run.json", sha256(run.folder / "run.json")) for run in runs])
    numbers = count(1)
    for run, view, proven in work:
        name = view if len(runs) == 1 else f"{run.folder.name}/{view}"
        _collect(collection, run, view, name, proven, row_of, lambda: progress(next(numbers), total))
    assert collection.camera is not None, "every view has a camera"
    about, size_px = collection.camera
    return LedImages(
        _sightings(collection),
        np.stack(collection.poses),
        tuple(collection.views),
        size_px,
        tuple(collection.left_out),
        replace(
            about,
            temperature_c=temperature_range_c(collection.lit_records),
            begun=max(run.created_at for run in runs),
        ),
        tuple(collection.inputs),
        np.stack(collection.joints_deg),
    )


def _collect(
    collection: _Collected,
    run: Run,
    view: str,
    name: str,
    proven: Sequence[FrameProven],
    row_of: Mapping[int, int],
    frame_done: Callable[[], None],
) -> None:
    """Add one view's poses and the spots of its frames under single LEDs."""
    path = run.view_path(view)
    file = read_view(path, proven)
    records, reported_poses = file.records, file.poses
    camera = about_of(run, file), (file.layout.width_px, file.layout.height_px)
    if collection.camera is not None and camera != collection.camera:
        raise InputError(
            f"{path}: another camera, lens or focus than in the frames before it: {camera[0]}, "
            f"{collection.camera[0]}"
        )
    collection.camera = camera
    lit = _single_leds(proven, records, view)
    unknown = sorted({f.led for f in lit} - set(row_of))
    if unknown:
        raise InputError(f"{path}: LEDs {unknown[:5]} are not in the dome's table; name the rig of this run")
    number_of: dict[int, int] = {}
    for pose in sorted({frame.pose[1] for frame in lit}):
        number_of[pose] = len(collection.views)
        collection.views.append(name)
        collection.poses.append(np.array(reported_poses[pose]["base_from_flange"], dtype=np.float64))
        collection.joints_deg.append(np.array(reported_poses[pose]["joints_deg"], dtype=np.float64))
    collection.lit_records += [records[frame.frame.index] for frame in lit]
    darks = _darks(file, proven)
    for frame in lit:
        pixels = file.proven_pixels(frame.frame)
        dark = darks.get(frame.exposure_us, float(file.black_dn))
        spots = find_spots(pixels, dark, file.pattern, file.white_dn)
        key = number_of[frame.pose[1]], row_of[frame.led]
        collection.frames.append(key)
        collection.spots += [(*key, spot.pixel, spot.covariance) for spot in spots.good]
        collection.left_out += [f"{frame.shot} {reason}" for reason in spots.rejection_reasons]
        frame_done()
    digest = frames_sha256([*(f.frame for f in lit), *_dark_frames(proven)])
    collection.inputs.append((f"{run.folder.name}/views/{path.name}", digest))


def _sightings(collection: _Collected) -> LedSightings:
    spots = collection.spots
    return LedSightings(
        np.array([spot[0] for spot in spots], dtype=np.intp),
        np.array([spot[1] for spot in spots], dtype=np.intp),
        np.array([spot[2] for spot in spots]).reshape(-1, 2),
        np.array([spot[3] for spot in spots]).reshape(-1, 2, 2),
        np.array(collection.frames, dtype=np.intp).reshape(-1, 2),
    )


def _by_view(run: Run) -> dict[str, list[FrameProven]]:
    """Proven frames of the views that have some under single LEDs."""
    frames_of: dict[str, list[FrameProven]] = {}
    for shot, frame in run.proven().items():
        frames_of.setdefault(shot.view, []).append(frame)
    return {
        view: frames for view, frames in frames_of.items() if any(isinstance(f.shot.light, Led) for f in frames)
    }


def _single_leds(proven: Sequence[FrameProven], records: Any, view: str) -> list[_LedFrame]:
    """Return the frames under LEDs: for one LED at one pose only the frame of the shortest exposure, because spots
    are saturated in all exposures."""
    shortest: dict[tuple[int, int], _LedFrame] = {}
    for frame in proven:
        if not isinstance(frame.shot.light, Led):
            continue
        led = frame.shot.light.id
        record = records[frame.index]
        pose = int(record["pose"])
        led_frame = _LedFrame(frame.shot, led, (view, pose), int(record["exposure_us"]), frame)
        before = shortest.get((led, pose))
        if before is None or led_frame.exposure_us < before.exposure_us:
            shortest[led, pose] = led_frame
    return list(shortest.values())


def _dark_frames(proven: Sequence[FrameProven]) -> list[FrameProven]:
    return [frame for frame in proven if frame.shot.is_dark]


def _darks(file: View, proven: Sequence[FrameProven]) -> dict[int, Floats]:
    """Return the mean dark frame [H, W], DN, for each exposure that has dark frames."""
    sums: dict[int, tuple[Floats, int]] = {}
    for frame in _dark_frames(proven):
        exposure_us = int(file.records[frame.index]["exposure_us"])
        before, n_before = sums.get(exposure_us, (np.zeros((file.layout.height_px, file.layout.width_px)), 0))
        sums[exposure_us] = before + file.proven_pixels(frame), n_before + 1
    return {exposure_us: total / n_frames for exposure_us, (total, n_frames) in sums.items()}
