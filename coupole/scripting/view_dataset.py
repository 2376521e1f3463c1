"""The frames of one view as an xarray Dataset on dask."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from coupole.scripting.proven_frame import Frame

if TYPE_CHECKING:
    import xarray as xr

NO_LED = -1
"""Value of `led` for a frame without a single LED."""
_NOWHERE_MM = np.full(3, np.nan)


def dataset_of(frames: Sequence[Frame], facts: Mapping[str, Any]) -> xr.Dataset:
    """Return the frames of one view, as `Run.dataset` describes them; `facts` become the dataset's attributes.
    Raises ModuleNotFoundError without the extra."""
    try:
        import xarray as xr

        pixels = stack_frames(frames)
    except ModuleNotFoundError as error:
        message = f"a dataset needs {error.name}; install it: pip install 'coupole[xarray]'"
        raise ModuleNotFoundError(message, name=error.name) from error
    attributes = {"units": "DN", "long_name": "raw pixels"}
    return xr.Dataset(
        {"pixels": (("shot", "y", "x"), pixels, attributes)},
        coords=_coordinates(frames),
        attrs={**facts, "frame_of_reference": "robot base"},
    )


def stack_frames(frames: Sequence[Frame]) -> Any:
    """Return a dask array [frames, height, width]; a frame is read when a part of it is computed."""
    import dask.array

    library: Any = dask.array  # dask has no types
    return library.stack([library.from_array(_Lazy(frame), chunks=frame.shape) for frame in frames])


class _Lazy:
    """A frame in the form of an array that dask can read."""

    dtype, ndim = np.dtype(np.uint16), 2

    def __init__(self, frame: Frame) -> None:
        self.shape, self._frame = frame.shape, frame

    def __getitem__(self, part: Any) -> Any:
        return self._frame.pixels[part]


def _coordinates(frames: Sequence[Frame]) -> dict[str, tuple[tuple[str, ...], Any, dict[str, str]]]:
    """Coordinates along `shot`, each with its unit."""
    led_numbers = [NO_LED if frame.led is None else frame.led for frame in frames]
    positions_mm = [_NOWHERE_MM if frame.led_position_mm is None else frame.led_position_mm for frame in frames]
    temperatures_c = np.array([frame.board_temperature_c for frame in frames], np.float64)
    poses = np.stack([frame.base_from_camera for frame in frames])
    along = ("shot",)
    return {
        "shot": (along, [frame.label for frame in frames], {"long_name": "label of the shot"}),
        "led": (along, led_numbers, {"long_name": "number of the LED; -1 for none"}),
        "exposure_us": (along, [frame.exposure_us for frame in frames], {"units": "us"}),
        "is_dark": (along, [frame.is_dark for frame in frames], {}),
        "led_position_mm": ((*along, "xyz"), np.stack(positions_mm), {"units": "mm"}),
        "base_from_camera": (
            (*along, "row", "column"),
            poses,
            {"units": "mm", "long_name": "4x4 pose"},
        ),
        "board_temperature_c": (along, temperatures_c, {"units": "degC"}),
        "xyz": (("xyz",), ["x", "y", "z"], {}),
    }
