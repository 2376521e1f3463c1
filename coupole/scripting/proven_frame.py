"""One proven frame; its pixels are read when they are used."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform
from coupole.storage.journal_events import FrameProven
from coupole.storage.view_reader import View as ViewFile


@dataclass(frozen=True, eq=False)
class Frame:
    """One proven frame. `numpy.asarray(frame)` and `frame.pixels` read it from the disk each time."""

    shot: str
    """Id of its shot, such as `top/led0417/e0`."""
    view: str
    """Name of its view."""
    label: str
    """Id of its shot without the view, such as `led0417/e0`."""
    led: int | None
    """Number of the LED that was lit; None for a panel or a dark frame."""
    led_position_mm: NDArray[np.float64] | None
    """[3] place of that LED, base frame, mm: calibrated if the run's plan names a record of LEDs, else nominal."""
    exposure_us: int
    """Exposure time, us."""
    is_dark: bool
    """True for a frame without light."""
    base_from_camera: Transform
    """[4, 4] pose of the camera by the arm's measured joints, mm: from camera to base coordinates."""
    joints_deg: NDArray[np.float64]
    """[6] measured joint angles, degrees."""
    board_temperature_c: float | None
    """Temperature of the LED's board, C; None if the box did not measure it."""
    taken_utc: str
    """Time when the frame was proven, UTC, ISO 8601."""
    proof: str
    """How the frame's identity was proven, in the words of run.json."""
    xxh3: str
    """Checksum of its pixels, xxh3-64, 16 hexadecimal digits."""
    _file: ViewFile = field(repr=False)
    _event: FrameProven = field(repr=False)

    @property
    def pixels(self) -> NDArray[np.uint16]:
        """[height, width] DN as the camera gave them. Raises ChecksumMismatch if they differ from the proven ones,
        StorageError if they cannot be read."""
        return self._file.proven_pixels(self._event)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, px; the pixels are not read."""
        return self._file.layout.height_px, self._file.layout.width_px

    @property
    def file(self) -> str:
        """NeXus HDF5 file of its view, in the run's folder: `views/top.h5`."""
        return self._event.file

    @property
    def slot(self) -> int:
        """Row of the frame's pixels in that file's data, from 0."""
        return self._event.index

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """The pixels for numpy; always a new array."""
        if copy is False:
            raise ValueError("a frame is read from the disk, so an array without a copy is not possible")
        return np.asarray(self.pixels, dtype)
