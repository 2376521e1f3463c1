"""Measured frames in a page: where they lie on the object, and what they show there."""

from __future__ import annotations

import base64
import math
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from relight_cases import LED, waves, write_result

from coupole.exchange.look.look_frames import DEGREE, frames_of_view
from coupole.reflectance.new_light.pictured_surface import surface_of_view
from coupole.reflectance.run_result import FRAMES, RunResult


def write_frame(folder: Path, share: np.ndarray) -> RunResult:
    """A result whose view has one frame [h, w]."""
    result = write_result(folder, waves())
    (folder / FRAMES).mkdir()
    with h5py.File(folder / FRAMES / "top.h5", "w") as file:
        file["share"], file["leds"] = share[None, :, :, None].astype(np.float32), [LED]
    return result


def pictured(result: RunResult) -> tuple[np.ndarray, np.ndarray]:
    """[h, w] shares of the camera's range, NaN for none, as the page reads them; and the same at each place that
    the view sees, beside the shares [n, 2] of the view's width and height at which it sees the place."""
    (view,) = result.views
    found = frames_of_view(result, view, np.eye(4))
    assert found is not None
    about, (block,) = found
    code = np.frombuffer(zlib.decompress(base64.b64decode(block.text)), np.uint8).reshape(block.shape)[..., 0]
    shown = (code - 1.0) / 254.0
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    share = np.where(code > 0, about["frames"][0]["peak"] * linear, np.nan)
    surface = surface_of_view(result, view)
    rows, columns = np.nonzero(surface.triangle_of_pixel >= 0)
    local = (surface.places_mm[rows, columns] - np.array(about["camera_mm"])) @ np.array(about["axes"]).T
    x, y = (local[:, :2] / local[:, 2:]).T
    powers = [x**i * y**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    column, row = (np.stack(powers, axis=1) @ np.array(about["lens"]) * share.shape[::-1]).astype(int).T
    height, width = surface.triangle_of_pixel.shape
    return share, np.stack([share[row, column], (columns + 0.5) / width, (rows + 0.5) / height], axis=1)


@pytest.mark.parametrize(
    ("height", "width"), [(1536, 2048), pytest.param(1501, 1921, id="one row and one column are left over")]
)
def test_a_large_frame_lies_where_the_view_saw_it(tmp_path: Path, height: int, width: int) -> None:
    down, right = (np.arange(height)[:, None] + 0.5) / height, (np.arange(width) + 0.5) / width
    small, at = pictured(write_frame(tmp_path / "result", (right + down) / 2))
    assert small.shape == (math.ceil(height / 4), math.ceil(width / 4))
    off = at[:, 0] - at[:, 1:].mean(axis=1)
    assert abs(np.median(off)) < 0.3 / width


def test_a_large_frame_is_averaged_without_what_is_not_known(tmp_path: Path) -> None:
    share = np.tile([[0.2, 0.6], [0.4, np.nan]], (300, 500))
    share[:2, :2] = np.nan
    small, _ = pictured(write_frame(tmp_path / "result", share))
    assert small.shape == (300, 500)
    assert np.isnan(small[0, 0])
    np.testing.assert_allclose(small.ravel()[1:], 0.4, rtol=1e-3)
