"""Colours between the pixels of a Bayer pattern."""

from __future__ import annotations

import numpy as np

from coupole.reflectance.texels.mosaic import all_channels

CHANNEL = np.tile(np.array([[0, 1], [1, 2]], np.int8), (30, 30))
ALL = np.ones(CHANNEL.shape, np.float32)


def seen(colours: np.ndarray) -> np.ndarray:
    return np.take_along_axis(colours, CHANNEL[..., None].astype(int), axis=-1)[..., 0].astype(np.float32)


def test_a_pixel_keeps_what_it_has_seen() -> None:
    colours = np.random.default_rng(1).standard_normal((*CHANNEL.shape, 3))
    whole = all_channels(seen(colours), ALL, CHANNEL, 3)
    np.testing.assert_array_equal(seen(whole), seen(colours))


def test_stripes_of_four_pixels_keep_their_contrast_in_all_channels() -> None:
    """Red and blue alone are sampled at every second pixel: by themselves they could not show them."""
    stripes = np.sin(2 * np.pi * (np.arange(60) + 0.3) / 4)
    colours = np.broadcast_to(stripes[None, :, None], (60, 60, 3))
    whole = all_channels(seen(colours), ALL, CHANNEL, 3)
    inner = (slice(10, 50), slice(10, 50))
    for channel in range(3):
        slope = np.polyfit(colours[inner][..., channel].ravel(), whole[inner][..., channel].ravel(), 1)[0]
        assert 0.9 < slope < 1.1


def test_slow_changes_of_colour_are_followed() -> None:
    rows, columns = np.indices(CHANNEL.shape)
    colours = np.stack([0.01 * rows, -0.01 * columns, 0.005 * (rows + columns)], axis=-1)
    whole = all_channels(seen(colours), ALL, CHANNEL, 3)
    np.testing.assert_allclose(whole[8:-8, 8:-8], colours[8:-8, 8:-8], atol=0.02)


def test_pixels_without_a_fit_say_nothing() -> None:
    random = np.random.default_rng(2)
    fitted = random.uniform(size=CHANNEL.shape) < 0.8
    deviation = random.standard_normal(CHANNEL.shape).astype(np.float32)
    deviation[~fitted] = np.nan
    whole = all_channels(deviation, fitted.astype(np.float32), CHANNEL, 3)
    assert np.isfinite(whole).all()
    assert (whole[~fitted] == 0.0).all()


def test_a_camera_without_filter_has_its_one_channel() -> None:
    deviation = np.random.default_rng(3).standard_normal(CHANNEL.shape).astype(np.float32)
    np.testing.assert_array_equal(all_channels(deviation, ALL, np.zeros_like(CHANNEL), 1)[..., 0], deviation)
