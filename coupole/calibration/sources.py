"""Images of calibrations: from a run, or from a folder of pictures with a file of poses.

Each view of a run gives one image: the mean of its frames under panels or LEDs, at the longest exposure with few
clipped pixels, dark frames subtracted if there are any. Frames of one view are taken at one pose, so their mean
has less noise and the same corners.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.artefact import UsedArtefact
from coupole.calibration.grey_image import COLOUR, Picture
from coupole.calibration.poses import PoseFile, ReportedPoses, kuka_poses, read_poses
from coupole.calibration.rotations import Floats
from coupole.errors import InputError
from coupole.storage.durable import sha256
from coupole.storage.journal_events import FrameProven
from coupole.storage.run import Run
from coupole.storage.step_fields import temperature_range_c
from coupole.storage.view_reader import View, read_view

SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".pgm")
POSES_NAME, BOARD_NAME = "poses.yaml", "board.yaml"
_MOST_FRAMES = 64
"""Largest number of frames of one view. More frames do not improve corners."""
_CLIPPED = 0.02


@dataclass(frozen=True)
class About:
    """The camera that took the images. None means that a value is not known."""

    is_simulated: bool
    camera: str | None = None
    focal_length_mm: float | None = None
    focus_distance_mm: float | None = None
    f_number: float | None = None
    temperature_c: tuple[float, float] | None = None
    """Lowest and highest temperature of the LED boards. A run has no other temperatures."""
    begun: datetime | None = None
    """Time when the newest of the runs began."""


@dataclass(frozen=True)
class Source:
    """One image, read when it is used."""

    name: str
    read_picture: Callable[[], Picture]
    joints_deg: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Sources:
    """All images of a calibration."""

    images: tuple[Source, ...]
    poses: ReportedPoses | None
    """One pose for each image; None if there are no poses."""
    about: About
    inputs: tuple[tuple[str, str], ...]
    """Name and SHA-256 of every file that was or will be read."""
    artefacts: tuple[UsedArtefact, ...] = ()
    """The board that the images show, with its certificate; none without a certificate."""

    def with_file(self, path: Path | None) -> Sources:
        """Return the same sources with one more input file."""
        return self if path is None else replace(self, inputs=(*self.inputs, (path.name, sha256(path))))

    def with_words(self, words: str) -> Sources:
        """Return the same sources with one more input, which was given on the command line."""
        digest = hashlib.sha256(words.encode()).hexdigest()
        return replace(self, inputs=(*self.inputs, (words, digest)))


def open_sources(paths: Sequence[Path], poses: Path | None) -> Sources:
    """Open runs, or one folder of pictures with poses in `poses` or in its own `poses.yaml`.

    Raises InputError if nothing is there, if poses have no image, or if runs and folders are mixed.
    """
    runs = [path for path in paths if (path / "run.json").is_file()]
    if runs and len(runs) == len(paths) and poses is None:
        return _joined_sources([_of_run(Run(path)) for path in runs])
    if runs:
        raise InputError(f"{runs[0]}: a run, which has its own poses: give runs only, or one folder of pictures")
    if len(paths) != 1:
        raise InputError(f"expected runs, or one folder of pictures; found {len(paths)} paths")
    return _of_folder(paths[0], poses)


# -- folders ----------------------------------------------------------------------------------------------


def _of_folder(folder: Path, poses: Path | None) -> Sources:
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a run, or a folder of pictures; there is none")
    path = poses or folder / POSES_NAME
    file: PoseFile | None = None
    numbers: ReportedPoses | None = None
    if path.is_file() or poses is not None:
        file, numbers = read_poses(path)
        pictures = [folder / name for name in file.poses]
        missing = [picture for picture in pictures if not picture.is_file()]
        if missing:
            raise InputError(f"{path}: expected a picture for each pose; there is no {missing[0]}")
    else:
        pictures = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
    if not pictures:
        raise InputError(f"{folder}: no pictures ({', '.join(SUFFIXES)}) in this folder")
    files = [*pictures, *([path] if file else [])]
    inputs = tuple((f"{folder.resolve().name}/{file_.name}", sha256(file_)) for file_ in files)
    images = tuple(Source(picture.name, partial(_picture, picture)) for picture in pictures)
    return Sources(images, numbers, About(is_simulated=False), inputs)


def _picture(path: Path) -> Picture:
    """Return the picture with the file's bit depth and colours. Raises InputError if it cannot be read."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
    if image is None:
        raise InputError(f"{path}: not a picture that OpenCV can read")
    grey = Picture.of_grey(image, name=path.name)
    return grey if image.ndim == 2 else replace(grey, values=image[..., ::-1], pattern=COLOUR)


# -- runs -------------------------------------------------------------------------------------------------


def _of_run(run: Run) -> Sources:
    """Return one image and pose for each view that has frames with light."""
    by_view: dict[str, list[FrameProven]] = {}
    for shot, frame in run.proven().items():
        by_view.setdefault(shot.view, []).append(frame)
    images, flanges, inputs = [], [], [(f"{run.folder.name}/run.json", sha256(run.folder / "run.json"))]
    about = About(is_simulated=run.is_simulated)
    lit_records: list[np.void] = []
    for view, frames in by_view.items():
        path = run.view_path(view)
        file = read_view(path, frames)
        lit = _at_one_pose([frame for frame in frames if frame.shot.is_shot], file.records)
        if not lit:
            continue
        dark = [frame for frame in frames if frame.shot.is_dark]
        records = file.records[[frame.index for frame in lit]]
        pose = file.poses[int(records["pose"][0])]
        lit_records += list(records)
        reader = partial(_mean_frame, view, file, lit, dark)
        images.append(Source(view, reader, tuple(map(float, pose["joints_deg"]))))
        flanges.append(np.array(pose["base_from_flange"], dtype=np.float64))
        inputs.append((f"{run.folder.name}/views/{path.name}", frames_sha256([*lit, *dark])))
        about = about_of(run, file)
    if not images:
        raise InputError(f"{run.folder}: no proven frame under light; acquire the plan first")
    about = replace(about, temperature_c=temperature_range_c(lit_records), begun=run.created_at)
    return Sources(tuple(images), kuka_poses(np.stack(flanges)), about, tuple(inputs))


def _at_one_pose(frames: Sequence[FrameProven], table: NDArray[np.void]) -> list[FrameProven]:
    """Return the frames of the pose with most frames. A view has two poses if the arm was moved during it."""
    frame_counts = Counter(int(table[frame.index]["pose"]) for frame in frames)
    return [frame for frame in frames if int(table[frame.index]["pose"]) == frame_counts.most_common(1)[0][0]]


def _mean_frame(name: str, file: View, lit: Sequence[FrameProven], dark: Sequence[FrameProven]) -> Picture:
    """Return the mean of the frames at the longest exposure with few clipped pixels, with dark frames
    subtracted."""
    exposures = {frame.shot: int(file.records[frame.index]["exposure_us"]) for frame in (*lit, *dark)}
    for exposure_us in sorted({exposures[frame.shot] for frame in lit}, reverse=True):
        exposure_frames = [frame for frame in lit if exposures[frame.shot] == exposure_us]
        frames = [file.proven_pixels(frame) for frame in _evenly_chosen(exposure_frames)]
        clipped_share = np.mean([np.mean(frame >= file.white_dn) for frame in frames])
        if clipped_share < _CLIPPED:
            break
    mean = _mean(frames)
    darks = [frame for frame in dark if exposures[frame.shot] == exposure_us]
    if darks:
        black = np.mean([file.proven_pixels(frame) for frame in _evenly_chosen(darks)], axis=0, dtype=np.float64)
    else:
        black = np.full(mean.shape, float(file.black_dn))
    white = file.white_dn - float(black.mean())
    return Picture(mean - black, file.pattern, white, name)


def _mean(frames: Sequence[NDArray[np.uint16]]) -> Floats:
    """[H, W], DN."""
    total = np.zeros(frames[0].shape)
    for frame in frames:
        total += frame
    return total / len(frames)


def _evenly_chosen(frames: Sequence[FrameProven]) -> Iterator[FrameProven]:
    """Yield at most `_MOST_FRAMES` of the frames, evenly over the list."""
    step = max(1, -(-len(frames) // _MOST_FRAMES))
    return iter(frames[::step])


def frames_sha256(frames: Sequence[FrameProven]) -> str:
    """Return the hash of the frames' proven checksums, which packing and archiving do not change."""
    lines = sorted(f"{frame.shot} {frame.xxh3}" for frame in frames)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def about_of(run: Run, file: View) -> About:
    """Return camera and lens from the attributes of a view's file. Raises StorageError."""
    camera = file.attributes.get("camera")
    return About(
        is_simulated=run.is_simulated,
        camera=str(camera) if camera is not None else None,
        focal_length_mm=file.number("focal_length_mm"),
        focus_distance_mm=file.number("focus_distance_mm"),
        f_number=file.number("f_number"),
    )


def _joined_sources(parts: Sequence[Sources]) -> Sources:
    """Return several runs as one. Raises InputError if they were taken with different lenses or cameras."""
    first = parts[0]
    for part in parts[1:]:
        here, there = (replace(source.about, temperature_c=None, begun=None) for source in (part, first))
        if here != there:
            raise InputError(f"runs with different cameras, lenses or focus: {part.about} and {first.about}")
    warm = [t for part in parts if part.about.temperature_c for t in part.about.temperature_c]
    flanges: list[Floats] = [part.poses.base_from_flange for part in parts if part.poses is not None]
    return Sources(
        tuple(image for part in parts for image in part.images),
        kuka_poses(np.concatenate(flanges)),
        replace(
            first.about,
            temperature_c=(min(warm), max(warm)) if warm else None,
            begun=max((part.about.begun for part in parts if part.about.begun), default=None),
        ),
        tuple(line for part in parts for line in part.inputs),
    )
