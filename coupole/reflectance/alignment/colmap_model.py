"""Cameras and images of a COLMAP model, read from its text or binary files (COLMAP's documentation, "Output
Format"). Models and parameters have the order of COLMAP's `sensor/models.h`."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from coupole.calibration.rotations import Floats
from coupole.errors import InputError

MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""COLMAP's camera models that equal our lens model or a special case of it, with their parameters."""
_NUMBERS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV", 6: "FULL_OPENCV"}
_PLACES = (".", "sparse/0", "sparse", "0")
_UNIT = 1e-3
"""Allowed difference of a quaternion's length from 1."""


@dataclass(frozen=True)
class ColmapCamera:
    """A lens and the size of its picture."""

    model: str
    size_px: tuple[int, int]
    parameters: dict[str, float]
    """Parameters by the names in `MODELS`."""


@dataclass(frozen=True)
class ColmapImage:
    """A picture with its pose."""

    name: str
    """Name of the image's file."""
    camera: int
    camera_from_world: Floats
    """[4, 4] pose of the camera: x right, y down, z forward, in the model's unit."""


@dataclass(frozen=True)
class ColmapModel:
    """A model; `path` is the file of its images."""

    path: Path
    cameras: dict[int, ColmapCamera]
    images: tuple[ColmapImage, ...]


def read_model(folder: Path) -> ColmapModel:
    """Read the model of a folder. The folder or its `sparse/0` holds `cameras` and `images` as .bin or .txt;
    binary files come first, as in COLMAP. Raises InputError for another folder, and for damaged files."""
    for place in _PLACES:
        for suffix, cameras, images in (
            (".bin", _binary_cameras, _binary_images),
            (".txt", _text_cameras, _text_images),
        ):
            paths = [folder / place / f"{name}{suffix}" for name in ("cameras", "images")]
            if all(path.is_file() for path in paths):
                cameras_by_number = dict(cameras(paths[0]))
                return ColmapModel(paths[1], cameras_by_number, tuple(images(paths[1])))
    raise InputError(
        f"{folder}: expected a model of COLMAP, cameras and images as .txt or .bin, there or in sparse/0; found "
        "none. Name the folder that `coupole export RUN --to colmap` made, or COLMAP's output"
    )


def _camera(path: Path, model: str, size_px: tuple[int, int], parameters: list[float]) -> ColmapCamera:
    names = MODELS.get(model, ())
    if len(names) != len(parameters) or not np.isfinite(parameters).all():
        raise InputError(
            f"{path}: camera {model} of {len(parameters)} parameters: expected one of {', '.join(MODELS)}; "
            "reconstruct with the camera that was exported"
        )
    return ColmapCamera(model, size_px, dict(zip(names, parameters, strict=True)))


def _image(path: Path, name: str, camera: int, pose: list[float]) -> ColmapImage:
    """Return the record of a picture; `pose` has a quaternion, w first, and then a translation."""
    w, x, y, z, *shift = pose
    if not np.isfinite(pose).all() or abs(math.hypot(w, x, y, z) - 1.0) > _UNIT:
        raise InputError(f"{path}: image {name}: expected a unit quaternion and a translation; found {pose}")
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    camera_from_world[:3, 3] = shift
    return ColmapImage(name, camera, camera_from_world)


# -- text -----------------------------------------------------------------------------------------------------


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines with their numbers, without comments."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot read COLMAP's text: {error}") from error
    return [(number, line) for number, line in enumerate(lines, start=1) if not line.startswith("#")]


def _text_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        try:
            camera, model, size_px = int(words[0]), words[1], (int(words[2]), int(words[3]))
            parameters = [float(word) for word in words[4:]]
        except (ValueError, IndexError):
            _refuse(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS", line)
        yield camera, _camera(path, model, size_px, parameters)


def _text_images(path: Path) -> Iterator[ColmapImage]:
    lines = iter(_lines(path))
    for number, line in lines:
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        try:
            pose, camera, name = [float(word) for word in words[1:8]], int(words[8]), words[9].strip()
        except (ValueError, IndexError):
            _refuse(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", line)
        yield _image(path, name, camera, pose)
        next(lines, None)  # its points, an empty line if it has none


def _refuse(path: Path, number: int, expectation: str, line: str) -> NoReturn:
    raise InputError(f"{path}:{number}:1: expected {expectation}; found {line[:60]!r}")


# -- binary ---------------------------------------------------------------------------------------------------


Record = TypeVar("Record")


def _records(path: Path, read_record: Callable[[bytes, int], tuple[Record, int]]) -> Iterator[Record]:
    """Yield the records that `read_record` reads, one after the other, from the data. `read_record` also returns
    the place of the next record."""
    try:
        data = path.read_bytes()
        (count,), at = struct.unpack_from("<Q", data), 8
        for _ in range(count):
            record, at = read_record(data, at)
            yield record
    except (OSError, OverflowError, struct.error, ValueError) as error:
        raise InputError(f"{path}: expected COLMAP's binary; it is damaged or cut short: {error}") from error


def _binary_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    def read_camera(data: bytes, at: int) -> tuple[tuple[int, ColmapCamera], int]:
        camera, number, width, height = struct.unpack_from("<IiQQ", data, at)
        model = _NUMBERS.get(number, f"number {number}")
        parameters = struct.unpack_from(f"<{len(MODELS.get(model, ()))}d", data, at + 24)
        return (camera, _camera(path, model, (width, height), list(parameters))), at + 24 + 8 * len(parameters)

    yield from _records(path, read_camera)


def _binary_images(path: Path) -> Iterator[ColmapImage]:
    def read_image(data: bytes, at: int) -> tuple[ColmapImage, int]:
        *pose, camera = struct.unpack_from("<7dI", data, at + 4)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode()
        (points,) = struct.unpack_from("<Q", data, end + 1)
        return _image(path, name, camera, pose), end + 9 + 24 * points

    yield from _records(path, read_image)
