"""Frames of runs for radiometric calibrations, with light, exposure, time and temperature.

A frame is read when it is used. So a calibration that processes frames in turn needs memory for only few frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.calibrated_arm import CalibratedArm, corrected_poses
from coupole.calibration.rotations import Floats
from coupole.calibration.sources import About, about_of, frames_sha256
from coupole.errors import InputError, StorageError
from coupole.plan.shot_id import Led, Light, PanelMark, Sentinel, ShotId
from coupole.storage.durable import sha256
from coupole.storage.journal_events import FrameProven
from coupole.storage.run import Run
from coupole.storage.view_reader import read_view

CHANNELS = ("R", "G", "B")


@dataclass(frozen=True)
class LightFrame:
    """One proven frame."""

    shot: ShotId
    exposure_us: float
    t_s: float
    """Time of the frame's trigger, on the box's clock."""
    temperature_c: float
    """Temperature of the LED's board; NaN if the box did not measure it."""
    base_from_flange: Floats
    """[4, 4] measured pose, mm."""
    base_from_camera: Floats
    """[4, 4] pose of the camera, mm, by the rig's hand-eye, or by a record's (`seen_through`)."""
    read: Callable[[], NDArray[np.uint16]]
    """Reads [H, W] DN."""
    joints_deg: Floats | None = None
    """[6] angles that were measured with the pose."""
    read_into: Callable[[NDArray[np.uint16]], None] | None = None
    """Reads the frame into memory [H, W], C order, if the frame's file can do this."""
    is_kept: bool = True
    """False if its pixels were discarded when their samples were safe. It cannot be read then."""

    @property
    def view(self) -> str:
        return self.shot.view

    @property
    def led(self) -> int | None:
        """Id of the LED that was lit; None under a panel or in the dark."""
        return self.shot.light.id if isinstance(self.shot.light, Led) else None


@dataclass(frozen=True)
class LightFrames:
    """All frames that a calibration may use, and their common properties."""

    frames: tuple[LightFrame, ...]
    pattern: str
    """Bayer pattern, 2 x 2 from the top left."""
    black_dn: int
    white_dn: int
    about: About
    focal_px: float
    """Image distance f (1 + m) divided by the pixel pitch: the length on the sensor, px, for a tangent of 1."""
    inputs: tuple[tuple[str, str], ...]
    """Name and SHA-256 of every file that was or will be read."""
    gain_db: float = 0.0
    """The camera's gain."""

    @property
    def temperature_range_c(self) -> tuple[float, float] | None:
        """Lowest and highest temperature of the LEDs' boards; None if no frame has one."""
        return temperatures_of(self.frames)

    @property
    def lit(self) -> tuple[LightFrame, ...]:
        return tuple(frame for frame in self.frames if frame.shot.is_shot)

    @property
    def dark(self) -> tuple[LightFrame, ...]:
        return tuple(frame for frame in self.frames if not frame.shot.is_shot)

    def until(self, view: str) -> LightFrames:
        """Return the frames of a view and of the views that were begun before it, with their files."""
        views = list(dict.fromkeys(frame.view for frame in self.frames))
        kept_views = set(views[: views.index(view) + 1])
        files = {f"/views/{name}.h5" for name in kept_views} | {"/run.json"}
        return replace(
            self,
            frames=tuple(frame for frame in self.frames if frame.view in kept_views),
            inputs=tuple((name, digest) for name, digest in self.inputs if name[name.index("/") :] in files),
        )

    def brightest(self, most_saturated: float) -> dict[tuple[str, Light], list[LightFrame]]:
        """Return lit frames by view and light. They have the longest exposure with a share of saturated pixels
        below `most_saturated`. The list is empty if there is no such exposure."""
        groups: dict[tuple[str, Light], list[LightFrame]] = {}
        for frame in sorted(self.lit, key=lambda frame: -frame.exposure_us):
            group = groups.setdefault((frame.view, frame.shot.light), [])
            usable = not group and bool(np.mean(frame.read() >= self.white_dn) < most_saturated)
            if usable or (group and group[0].exposure_us == frame.exposure_us):
                group.append(frame)
        return groups

    @cached_property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        readable = next((frame for frame in self.frames if frame.is_kept), self.frames[0])
        height_px, width_px = readable.read().shape
        return width_px, height_px

    def seen_through(self, flange_from_camera: Floats, arm: CalibratedArm | None = None) -> LightFrames:
        """Return the same frames with another pose [4, 4] of the camera on the flange. With `arm`, its axis zeros
        correct the flange's pose. Raises InputError if frames without joints are to be corrected."""
        flanges = [frame.base_from_flange for frame in self.frames] if arm is None else self._corrected_poses(arm)
        frames = (
            replace(frame, base_from_flange=flange, base_from_camera=flange @ flange_from_camera)
            for frame, flange in zip(self.frames, flanges, strict=True)
        )
        return replace(self, frames=tuple(frames))

    def _corrected_poses(self, arm: CalibratedArm) -> list[Floats]:
        joints_deg = [frame.joints_deg for frame in self.frames if frame.joints_deg is not None]
        if len(joints_deg) < len(self.frames):
            raise InputError("frames without the arm's joints cannot be corrected by its axis zeros")
        reported_poses = np.stack([frame.base_from_flange for frame in self.frames]).reshape(-1, 16)
        rows = np.concatenate([reported_poses, np.array(joints_deg)], axis=1)
        distinct, pose_of_frame = np.unique(rows, axis=0, return_inverse=True)  # a view's frames share a pose
        poses = corrected_poses(distinct[:, :16].reshape(-1, 4, 4), distinct[:, 16:], arm)
        return list(poses[pose_of_frame.reshape(-1)])


@dataclass(frozen=True)
class PlainSources:
    """Sources of a record that is made from plain pictures. For frames, `LightFrames` has the same."""

    about: About
    inputs: tuple[tuple[str, str], ...]
    """Name and SHA-256 of every picture."""
    temperature_range_c: tuple[float, float] | None = None


def open_light_frames(paths: Sequence[Path]) -> LightFrames:
    """Open all proven frames of some runs, without the bursts' marks. Raises InputError if there are no frames, or
    if cameras, lenses or levels of black differ."""
    frames: list[LightFrame] = []
    inputs: list[tuple[str, str]] = []
    common: tuple[Any, ...] | None = None
    for path in paths:
        run = Run(path)
        inputs.append((f"{run.folder.name}/run.json", sha256(run.folder / "run.json")))
        for view_path, proven in _by_view(run).items():
            view_frames, here = _of_view(run, view_path, proven)
            if common is not None and here != common:
                raise InputError(
                    f"{view_path}: expected frames as in the files before it ({common}), found {here}; calibrate "
                    "from runs of one camera, lens and gain"
                )
            common = here
            frames += view_frames
            inputs.append((f"{run.folder.name}/views/{view_path.name}", frames_sha256(proven)))
    if common is None or not frames:
        raise InputError(f"{', '.join(map(str, paths))}: no proven frame; acquire the plan first")
    pattern, black_dn, white_dn, gain_db, focal_px, about = common
    about = replace(about, begun=max(Run(path).created_at for path in paths))
    return LightFrames(tuple(frames), pattern, black_dn, white_dn, about, focal_px, tuple(inputs), gain_db)


def channel_mask(shape: tuple[int, int], pattern: str, channel: str) -> NDArray[np.bool_]:
    """Return [H, W], True where the Bayer filter has a channel. All pixels of a MONO sensor are green."""
    letters = np.array(list("GGGG" if pattern == "MONO" else pattern)).reshape(2, 2)
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return np.asarray(letters[rows % 2, columns % 2] == channel)


def channels_of(pattern: str) -> tuple[str, ...]:
    """Return the channels of a sensor."""
    return ("G",) if pattern == "MONO" else CHANNELS


def temperatures_of(frames: Sequence[LightFrame]) -> tuple[float, float] | None:
    """Return the lowest and highest temperature, C; None if no frame has one."""
    temperatures_c = [frame.temperature_c for frame in frames if np.isfinite(frame.temperature_c)]
    return (min(temperatures_c), max(temperatures_c)) if temperatures_c else None


def _by_view(run: Run) -> dict[Path, list[FrameProven]]:
    """Return proven frames by their view's file, without marks and sentinels. Marks are dark, but light may still
    glow when they end."""
    frames_of: dict[Path, list[FrameProven]] = {}
    for shot, frame in run.proven().items():
        if not isinstance(shot.light, PanelMark | Sentinel):
            frames_of.setdefault(run.view_path(shot.view), []).append(frame)
    return frames_of


def _of_view(
    run: Run, path: Path, proven: Sequence[FrameProven]
) -> tuple[list[LightFrame], tuple[str, int, int, float, float, About]]:
    file = read_view(path, proven)
    poses = file.poses
    frames = []
    for frame in proven:
        record = file.records[frame.index]
        decicelsius = int(record["board_temperature_dc"])
        frames.append(
            LightFrame(
                frame.shot,
                float(record["exposure_us"]),
                float(record["t_trigger_ns"]) * 1e-9,
                decicelsius / 10.0 if decicelsius else float("nan"),
                np.array(poses[int(record["pose"])]["base_from_flange"], dtype=np.float64),
                np.array(poses[int(record["pose"])]["base_from_camera"], dtype=np.float64),
                partial(file.proven_pixels, frame),
                np.array(poses[int(record["pose"])]["joints_deg"], dtype=np.float64),
                partial(file.read_proven_pixels, frame),
                not file.is_discarded(frame.index),
            )
        )
    optics = file.number("focal_length_mm"), file.number("focus_distance_mm"), file.number("pixel_pitch_um")
    focal_mm, focus_mm, pitch_um = (value or 0.0 for value in optics)
    if not 0.0 < focal_mm < focus_mm or pitch_um <= 0.0:
        raise StorageError(f"{path}: lacks a possible focal length, focus distance or pixel pitch: {optics}")
    image_mm = focal_mm * focus_mm / (focus_mm - focal_mm)
    about = about_of(run, file)
    focal_px = image_mm * 1e3 / pitch_um
    gain_db = file.number("gain_db") or 0.0
    return frames, (file.pattern, file.black_dn, file.white_dn, gain_db, focal_px, about)
