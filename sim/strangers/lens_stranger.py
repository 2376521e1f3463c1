"""A lens that Brown's model does not describe: rational and thin-prism terms, a decentred stop, a focus group that
slides, coma.

The stop determines the point of the lens through which the chief rays pass. If the stop is shifted by e from the
lens's axis, the projection centre moves by e (which only the hand-eye calibration sees). The principal point moves
by e/s of the focal length, where s is the focus distance. Distortion stays centred on the lens's axis.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from sim.render.lens import Lens

TAPS = 6


class LensStranger(BaseModel):
    """Terms in addition to the rig's `distortion`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rational: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """k4, k5, k6 of OpenCV's rational model."""
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """s1, s2, s3, s4 of OpenCV's thin-prism model."""
    stop_shift_mm: tuple[float, float] = (0.0, 0.0)
    """Shift of the entrance pupil from the lens's axis, along the image's x and y."""
    breathing: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    """Relative change of the image distance from a camera that looks straight down to one that looks sideways. The
    focus group slides by its weight, in proportion to the cosine of the angle."""
    coma_px: Annotated[float, Field(ge=0)] = 0.0
    """Length at the image's corners of the one-sided blur, which grows with the square of the distance from the
    centre."""
    coma_deg: float = 0.0
    """Direction of the coma in the image, from x towards y. It is the same everywhere in the image."""

    def disturbed_lens(self, lens: Lens, focus_distance_mm: float) -> Lens:
        """The lens with these terms, when the camera looks straight down."""
        more = (*self.rational, *self.prism) if any((*self.rational, *self.prism)) else ()
        x, y = (shift / focus_distance_mm for shift in self.stop_shift_mm)
        return replace(lens, distortion=(*lens.distortion, *more), off_axis=(x, y))

    def with_breathing(self, lens: Lens, down: float) -> Lens:
        """The lens when the cosine between its axis and straight down is `down`."""
        return replace(lens, focal_px=lens.focal_px * (1.0 + self.breathing * (1.0 - down)))

    def coma_shift_px(self, pixels: NDArray[np.float64], size_px: tuple[int, int]) -> NDArray[np.float64]:
        """Return vectors [..., 2] from the bright end of a spot, at pixels [..., 2], to its faint end."""
        middle = 0.5 * (np.array(size_px) - 1.0)
        share = np.sum((pixels - middle) ** 2, axis=-1, keepdims=True) / (middle @ middle)
        direction = np.radians(self.coma_deg)
        return np.asarray(self.coma_px * share * np.array([np.cos(direction), np.sin(direction)]))

    def with_coma(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """An image [h, w, channels] with coma: each point becomes a streak that fades linearly to its end."""
        from scipy.ndimage import map_coordinates

        height, width = image.shape[:2]
        rows, columns = np.mgrid[:height, :width].astype(np.float64)
        shift = self.coma_shift_px(np.stack([columns, rows], axis=-1), (width, height))
        out = np.zeros_like(image)
        places = (np.arange(TAPS) + 0.5) / TAPS
        for place, weight in zip(places, (1.0 - places) / np.sum(1.0 - places), strict=True):
            at = (rows - place * shift[..., 1], columns - place * shift[..., 0])
            for channel in range(image.shape[2]):
                out[..., channel] += weight * map_coordinates(image[..., channel], at, order=3, mode="nearest")
        return np.maximum(out, np.float32(0.0))
