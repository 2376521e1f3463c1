"""Lays out the file of one view's frames as NeXus HDF5, and allocates all its space."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.devices import FrameFormat
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import sync_folder
from coupole.storage.frame_file import DATA, FRAME_DTYPE, MAX_POSES, PAGE, POSE_DTYPE
from coupole.storage.hdf5_file import hdf5_file
from coupole.storage.line_file import utc_now


@dataclass(frozen=True)
class Quantity:
    """An array or one value, with the attributes that describe it."""

    values: NDArray[np.generic] | float | str
    units: str = ""
    frame: str = ""
    """The coordinate frame of positions and directions."""


Collections = Mapping[str, Mapping[str, Quantity | NDArray[np.generic]]]
"""Arrays by name, by the path of their group in the entry (NXcollection)."""

_MAPS_CAMERA = "base_from_camera maps camera coordinates (x right, y down, z forward) to the robot's base"
_MAPS_FLANGE = "base_from_flange maps coordinates of the flange to the robot's base"
_POSES_ATTRIBUTES = {
    "t_ns_units": "ns",
    "joints_deg_units": "degree",
    "base_from_flange_units": "mm",
    "base_from_camera_units": "mm",
    "frames_of_reference": f"{_MAPS_CAMERA}; {_MAPS_FLANGE}; 4x4, p_base = matrix @ (x, y, z, 1)",
}
_FRAMES_ATTRIBUTES = {
    "state_values": "0 free, 1 a frame that is not proven, 2 the proven frame of `shot`, 3 as 2, but its pixels "
    "were discarded: they read as 0",
    "led_none": 65535,
    "exposure_us_units": "us",
    "t_trigger_ns_units": "ns",
    "t_trigger_ns_clock": "time by the LED box's clock; by the host's clock where the box has none",
    "camera_ns_units": "ns",
    "camera_ns_clock": "the camera's",
    "board_temperature_dc_units": "0.1 degC",
    "led_current_ma_units": "mA",
    "xxh3": "xxh3-64 of the pixels as little-endian uint16",
    "pose": "row of /entry/instrument/robot/poses",
}


def create(
    path: Path,
    slots: int,
    frame_format: FrameFormat,
    metadata: dict[str, Any],
    collections: Collections | None = None,
    *,
    is_packed: bool = False,
) -> None:
    """Create a view's file with `slots` free slots, and allocate its space; with `is_packed`, frames of up to 12
    bits are packed.

    `metadata`: `title`, `sample`, `simulated`, `pixel_pitch_um` and any further attributes of the entry. Raises
    DiskFull if the disk has not enough space.
    """
    partial = path.with_suffix(".part")
    try:
        with hdf5_file(
            partial, "w", alignment_threshold=PAGE, alignment_interval=PAGE, libver=("v108", "v110")
        ) as file:
            _describe(file, slots, frame_format, metadata, is_packed=is_packed)
            for name, arrays in (collections or {}).items():
                collection = _group(file["entry"], name, "NXcollection")
                for key, values in arrays.items():
                    _store(collection, key, values)
        with partial.open("r+b") as file_on_disk:
            os.posix_fallocate(file_on_disk.fileno(), 0, partial.stat().st_size)
            os.fsync(file_on_disk.fileno())
        partial.rename(path)
        sync_folder(path.parent)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise disk_error(path, error) from error


def _describe(
    file: h5py.File, slots: int, frame_format: FrameFormat, metadata: dict[str, Any], *, is_packed: bool
) -> None:
    file.attrs["default"] = "entry"
    entry = _group(file, "entry", "NXentry", default="data")
    entry["definition"] = "NXentry"  # base classes only: there is no application definition of a dome
    entry["title"] = metadata["title"]
    entry["start_time"] = utc_now()
    for key, value in metadata.items():
        entry.attrs[key] = value
    if "base_from_support" in metadata:
        entry.attrs["base_from_support_units"] = "mm"
    instrument = _group(entry, "instrument", "NXinstrument")
    instrument["name"] = "La Coupole"
    detector = _group(instrument, "detector", "NXdetector")
    columns, dtype = (frame_format.width_px * 3 // 2, "u1") if is_packed else (frame_format.width_px, "<u2")
    shape = (slots, frame_format.height_px, columns)
    data = _contiguous(detector, "data", shape, np.dtype(dtype), fill=False)
    if is_packed:
        data.attrs["packing"] = "three bytes hold two pixels a, b: a[7:0], b[3:0] a[11:8], b[11:4] (GenICam 12p)"
    data.attrs["units"] = "DN"
    data.attrs["long_name"] = "raw frames, one a slot; `frames` says what each slot holds"
    frames = _contiguous(detector, "frames", (slots,), FRAME_DTYPE, fill=True)
    frames.attrs.update(_FRAMES_ATTRIBUTES)
    detector["bit_depth_readout"] = frame_format.bit_depth
    detector["saturation_value"] = frame_format.white_dn
    detector["black_level"] = frame_format.black_dn
    detector["bayer_pattern"] = frame_format.bayer_pattern
    for axis in ("x_pixel_size", "y_pixel_size"):
        detector[axis] = float(metadata["pixel_pitch_um"])
        detector[axis].attrs["units"] = "um"
    robot = _group(instrument, "robot", "NXpositioner")
    poses = _contiguous(robot, "poses", (MAX_POSES,), POSE_DTYPE, fill=True)
    poses.attrs.update(_POSES_ATTRIBUTES)
    sample = _group(entry, "sample", "NXsample")
    sample["name"] = metadata["sample"]
    default_plot = _group(entry, "data", "NXdata", signal="data")
    default_plot["data"] = h5py.SoftLink(f"/{DATA}")


def _group(parent: h5py.Group, name: str, nx_class: str, **attributes: str) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    for key, value in attributes.items():
        group.attrs[key] = value
    return group


def _store(group: h5py.Group, name: str, value: Quantity | NDArray[np.generic]) -> None:
    quantity = value if isinstance(value, Quantity) else Quantity(value)
    group[name] = quantity.values
    for key in ("units", "frame"):
        if text := getattr(quantity, key):
            group[name].attrs[key] = text


def _contiguous(
    group: h5py.Group, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], *, fill: bool
) -> h5py.Dataset:
    """Return a contiguous dataset that is allocated immediately, so that its offset in the file is known."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_layout(h5py.h5d.CONTIGUOUS)
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_ALLOC if fill else h5py.h5d.FILL_TIME_NEVER)
    space = h5py.h5s.create_simple(shape)
    h5py.h5d.create(group.id, name.encode(), h5py.h5t.py_create(dtype, logical=True), space, dcpl=properties)
    return group[name]
