"""Squares of pixels that share a material, on surfaces that are drawn."""

from __future__ import annotations

import numpy as np
import pytest

from coupole.errors import InputError
from coupole.reflectance.new_light.pictured_surface import Surface
from coupole.reflectance.texels.texel_grid import pixel_mm, texel_grid
from coupole.reflectance.texels.texel_size import TexelSize
from coupole.reflectance.texels.texel_values import _mean

STEP_MM = 0.1


def drawn(heights_mm: np.ndarray, triangle: np.ndarray) -> Surface:
    """Pixels of 0.1 mm that look straight down on horizontal triangles."""
    row, column = np.indices(triangle.shape)
    places = np.stack([STEP_MM * column, STEP_MM * row, heights_mm[triangle]], axis=-1).astype(np.float32)
    places[triangle < 0] = np.nan
    count = len(heights_mm)
    centres = np.stack([places[triangle == n].mean(axis=0) for n in range(count)]).astype(float)
    return Surface(
        triangle.astype(np.int32), places, np.array([0.0, 0.0, 300.0]), np.arange(count), centres,
        np.tile([0.0, 0.0, 1.0], (count, 1)),
    )  # fmt: skip


def test_a_texel_is_on_the_triangle_that_most_of_its_pixels_see() -> None:
    triangle = np.zeros((6, 9), int)
    triangle[:, 4:] = 1
    grid = texel_grid(drawn(np.zeros(2), triangle), 3)
    np.testing.assert_array_equal(grid.triangle, [[0, 1, 1], [0, 1, 1]])
    np.testing.assert_array_equal(grid.texel_of_pixel[:, ::3], [[0, 1, 2]] * 3 + [[3, 4, 5]] * 3)
    np.testing.assert_allclose(grid.places_mm[1, 2], [0.7, 0.4, 0.0], atol=1e-6)


def test_pixels_that_see_something_far_behind_belong_to_no_texel() -> None:
    triangle = np.zeros((8, 8), int)
    triangle[:, 7] = 1
    grid = texel_grid(drawn(np.array([0.0, -5.0]), triangle), 4)
    assert (grid.texel_of_pixel[:, :7] >= 0).all()
    assert (grid.texel_of_pixel[:, 7] == -1).all()
    np.testing.assert_allclose(grid.places_mm[0, 1], [0.5, 0.15, 0.0], atol=1e-6)


def test_texels_at_the_edge_of_a_picture_have_fewer_pixels_and_nothing_is_none() -> None:
    triangle = np.zeros((5, 7), int)
    triangle[:, :2] = -1
    grid = texel_grid(drawn(np.zeros(1), triangle), 2)
    assert grid.triangle.shape == (3, 4)
    assert (grid.triangle[:, 0] == -1).all()
    assert (grid.triangle[:, 1:] == 0).all()
    assert np.bincount(grid.texel_of_pixel[grid.texel_of_pixel >= 0])[-1] == 1


def test_a_pixel_is_as_wide_as_the_square_of_what_it_sees() -> None:
    surface = drawn(np.zeros(1), np.zeros((40, 60), int))
    assert pixel_mm(surface) == pytest.approx(STEP_MM, rel=1e-4)
    surface.places_mm[..., 2] = np.sqrt(3.0) * surface.places_mm[..., 1]  # seen at 60 degrees
    assert pixel_mm(surface) == pytest.approx(STEP_MM * np.sqrt(2.0), rel=1e-4)


@pytest.mark.parametrize(
    ("mm", "side_px"), [(None, 1), (0.1, 1), (0.14, 1), (0.17, 2), (0.2, 2), (0.44, 4), (1.0, 10)]
)
def test_texels_are_the_nearest_whole_number_of_pixels_wide(mm: float | None, side_px: int) -> None:
    assert TexelSize(mm).side_px(0.1) == side_px


@pytest.mark.parametrize("mm", [0.0, -0.2, 101.0, float("nan"), float("inf")])
def test_what_is_no_width_is_refused_also_in_python(mm: float) -> None:
    with pytest.raises(InputError, match=r"expected auto \(each view's own pixels\) or a width"):
        TexelSize(mm)


def test_a_square_whose_pixels_all_lie_elsewhere_is_no_texel() -> None:
    surface = drawn(np.zeros(1), np.zeros((4, 8), int))
    surface.places_mm[:, 4:, 2] = 50.0
    grid = texel_grid(surface, 4)
    np.testing.assert_array_equal(grid.triangle, [[0, -1]])
    assert (grid.texel_of_pixel[:, 4:] == -1).all()


def means(values: list[list[float]], reached: list[list[bool]], channel: list[int]) -> np.ndarray:
    """[channels, leds] of one texel."""
    out = np.full((1, 2, 2), np.nan, np.float32)
    starts = np.array([0, len(values)])
    _mean(starts, np.array(channel), np.array(reached), np.array(values, np.float32), out)
    return out[0]


def test_values_are_means_of_the_pixels_of_a_channel() -> None:
    every = [[True, True]] * 4
    found = means([[1, 2], [3, 4], [5, 6], [9, 9]], every, [0, 1, 1, 0])
    np.testing.assert_array_equal(found, [[5, 5.5], [4, 5]])


def test_a_pixel_in_shadow_is_left_out_and_more_than_half_leave_no_value() -> None:
    reached = [[True, True], [False, True], [True, True], [True, False], [True, False]]
    found = means([[1, 2], [7, 4], [5, 6], [8, 0], [6, 0]], reached, [0, 0, 1, 1, 1])
    np.testing.assert_array_equal(found[0], [1, 3])
    assert found[1, 0] == pytest.approx(19 / 3)
    assert np.isnan(found[1, 1])


def test_a_clipped_pixel_leaves_no_value_since_a_mean_without_it_would_be_too_dark() -> None:
    every = [[True, True]] * 4
    found = means([[1, 2], [np.nan, 4], [5, 6], [9, 9]], every, [0, 0, 1, 1])
    assert np.isnan(found[0, 0])
    np.testing.assert_array_equal(found[:, 1], [3, 7.5])
