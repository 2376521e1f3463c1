"""From runs to spots: each frame under a single LED is looked at once, with its view's pose and dark frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from coupole.calibration.leds.matching import LedSightings
from coupole.calibration.leds.spots import find_spots
from coupole.calibration.rotations import Floats
from coupole.calibration.sources import About, about_of, frames_sha256, poses_and_attributes
from coupole.errors import InputError
from coupole.plan.led_table import LedTable
from coupole.plan.shot_id import Led, ShotId
from coupole.storage import frame_file
from coupole.storage.journal_events import FrameProven
from coupole.storage.run import Run, sha256
from coupole.storage.step_fields import temperature_range_c


@dataclass(frozen=True)
class LedImages:
    """All that a run says of LEDs."""

    seen: LedSightings
    base_from_flange: Floats
    """[v, 4, 4] as the robot reported them."""
    views: tuple[str, ...]
    """[v] names."""
    size_px: tuple[int, int]
    left_out: tuple[str, ...]
    """One line for each bright thing that was no spot."""
    about: About
    inputs: tuple[tuple[str, str], ...]
    """Name and SHA-256 of every file that was read."""
    joints_deg: Floats | None = None
    """[v, axes] as the robot reported them; None if it did not."""


@dataclass(frozen=True)
class _LedFrame:
    """One frame under one LED, the shortest exposed where there are several."""

    shot: ShotId
    led: int
    pose: tuple[str, int]
    """View's name, and number of the pose in it: an arm that was pushed aside has two."""
    exposure_us: int
    frame: FrameProven


@dataclass
class _Collected:
    """Grows view by view."""

    spots: list[tuple[int, int, Floats, Floats]]
    frames: list[tuple[int, int]]
    left_out: list[str]


def find_leds(
    paths: Sequence[Path], table: LedTable, progress: Callable[[int, int], None] = lambda done, total: None
) -> LedImages:
    """Look for spots in all frames of runs under single LEDs. Raises InputError: no such frames, LEDs that the
    dome does not have, runs of different cameras."""
    row_of = {int(led): row for row, led in enumerate(table.ids)}
    runs = [Run(path) for path in paths]
    work = [(run, view, frames) for run in runs for view, frames in _by_view(run).items()]
    total = sum(len(frames) for _, _, frames in work)
    if not total:
        raise InputError(
            f"{', '.join(map(str, paths))}: no proven frame under a single LED; acquire the plan first"
        )
    collected = _Collected([], [], [])
    poses: list[Floats] = []
    joints: list[Floats] = []
    views: list[str] = []
    inputs = [(f"{run.folder.name}/run.json", sha256(run.folder / "run.json")) for run in runs]
    about: About | None = None
    size_px: tuple[int, int] | None = None
    lit_records: list[np.void] = []
    done = 0
    for run, view, proven in work:
        path = run.view_path(view)
        layout, records = frame_file.read_layout(path), frame_file.read_frames(path)
        reported, attributes = poses_and_attributes(path)
        here, size = about_of(run, attributes), (layout.width_px, layout.height_px)
        if about is not None and (here != about or size != size_px):
            raise InputError(
                f"{path}: another camera, lens or focus than in the frames before it: {here}, {about}"
            )
        about, size_px = here, size
        lit = _single_leds(proven, records, view)
        unknown = sorted({f.led for f in lit} - set(row_of))
        if unknown:
            raise InputError(f"{path}: LEDs {unknown[:5]} are not in the dome's table; name the rig of this run")
        number_of: dict[int, int] = {}
        for pose in sorted({frame.pose[1] for frame in lit}):
            number_of[pose] = len(views)
            views.append(view if len(runs) == 1 else f"{run.folder.name}/{view}")
            poses.append(np.array(reported[pose]["base_from_flange"], dtype=np.float64))
            joints.append(np.array(reported[pose]["joints_deg"], dtype=np.float64))
        lit_records += [records[f.frame.index] for f in lit]
        facts, darks = frame_file.read_facts(path), _darks(path, layout, proven, records)
        for frame in lit:
            pixels = frame_file.read_frame(path, layout, frame.frame.index)
            dark = darks.get(frame.exposure_us, float(facts["black_dn"]))
            spots = find_spots(pixels, dark, facts["pattern"], facts["white_dn"])
            key = number_of[frame.pose[1]], row_of[frame.led]
            collected.frames.append(key)
            collected.spots += [(*key, spot.pixel, spot.covariance) for spot in spots.good]
            collected.left_out += [f"{frame.shot} {reason}" for reason in spots.rejected]
            done += 1
            progress(done, total)
        digest = frames_sha256([*(f.frame for f in lit), *_dark_frames(proven)])
        inputs.append((f"{run.folder.name}/views/{path.name}", digest))
    assert about is not None
    assert size_px is not None
    return LedImages(
        _sightings(collected),
        np.stack(poses),
        tuple(views),
        size_px,
        tuple(collected.left_out),
        replace(
            about,
            temperature_c=temperature_range_c(lit_records),
            begun=max(run.created for run in runs),
        ),
        tuple(inputs),
        np.stack(joints),
    )


def _sightings(collected: _Collected) -> LedSightings:
    spots = collected.spots
    return LedSightings(
        np.array([spot[0] for spot in spots], dtype=np.intp),
        np.array([spot[1] for spot in spots], dtype=np.intp),
        np.array([spot[2] for spot in spots]).reshape(-1, 2),
        np.array([spot[3] for spot in spots]).reshape(-1, 2, 2),
        np.array(collected.frames, dtype=np.intp).reshape(-1, 2),
    )


def _by_view(run: Run) -> dict[str, list[FrameProven]]:
    """Proven frames of the views that have some under single LEDs."""
    found: dict[str, list[FrameProven]] = {}
    for shot, frame in run.proven().items():
        found.setdefault(shot.view, []).append(frame)
    return {view: frames for view, frames in found.items() if any(isinstance(f.shot.light, Led) for f in frames)}


def _single_leds(proven: Sequence[FrameProven], records: Any, view: str) -> list[_LedFrame]:
    """Frames under LEDs, of those of one LED at one pose the shortest exposed: spots are white in all of them."""
    shortest: dict[tuple[int, int], _LedFrame] = {}
    for frame in proven:
        if not isinstance(frame.shot.light, Led):
            continue
        led = frame.shot.light.id
        record = records[frame.index]
        pose = int(record["pose"])
        found = _LedFrame(frame.shot, led, (view, pose), int(record["exposure_us"]), frame)
        before = shortest.get((led, pose))
        if before is None or found.exposure_us < before.exposure_us:
            shortest[led, pose] = found
    return list(shortest.values())


def _dark_frames(proven: Sequence[FrameProven]) -> list[FrameProven]:
    return [frame for frame in proven if frame.shot.is_dark]


def _darks(
    path: Path, layout: frame_file.Layout, proven: Sequence[FrameProven], records: Any
) -> dict[int, Floats]:
    """Mean dark frame [H, W] for each exposure that has some, DN."""
    sums: dict[int, tuple[Floats, int]] = {}
    for frame in _dark_frames(proven):
        exposure_us = int(records[frame.index]["exposure_us"])
        before, count = sums.get(exposure_us, (np.zeros((layout.height_px, layout.width_px)), 0))
        sums[exposure_us] = before + frame_file.read_frame(path, layout, frame.index), count + 1
    return {exposure_us: total / count for exposure_us, (total, count) in sums.items()}
