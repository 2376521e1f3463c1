"""The simulated lens as glass: vignetting, depth of field, diffraction, lateral colour."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coupole.errors import InputError
from sim.optics import blur
from sim.optics.objective import (
    Objective,
    defocus_px,
    diffraction_px,
    vignetting,
)

LENS = Objective()
RED, GREEN, BLUE = (np.full((2, 2), channel) for channel in range(3))
GBRG = np.array([[1, 2], [0, 1]])
PITCH_UM = 5.5


def spread_px(image: NDArray[np.float32]) -> tuple[float, float]:
    """Standard deviations of a blurred point, rows and columns."""
    rows, cols = np.indices(image.shape)
    weights = image / image.sum()
    return tuple(float(np.sqrt((weights * (axis - (weights * axis).sum()) ** 2).sum())) for axis in (rows, cols))  # type: ignore[return-value]


def point(size: int = 61) -> NDArray[np.float32]:
    image = np.zeros((size, size), np.float32)
    image[size // 2, size // 2] = 1000.0
    return image


def test_light_falls_with_the_fourth_power_of_the_cosine_where_the_rim_is_far() -> None:
    tangent = np.linspace(0.0, 0.4, 20)
    assert np.allclose(vignetting(LENS, tangent), np.cos(np.arctan(tangent)) ** 4, rtol=1e-12)


@given(st.floats(0.3, 3.0), st.floats(0.0, 12.0), st.floats(0.0, 1.0))
def test_the_rim_takes_light_away_and_never_adds_any(rim: float, shift: float, tangent: float) -> None:
    lens = Objective(rim_radius=rim, rim_shift=shift)
    here, farther = vignetting(lens, [tangent, tangent + 0.01])
    assert 0.0 <= farther <= here <= (1.0 + tangent**2) ** -2.0 + 1e-12


@pytest.mark.parametrize(("rim", "shift"), [(1.0, 0.5), (1.4, 1.0), (0.8, 0.6), (2.0, 2.5)])
def test_the_pupil_that_the_rim_leaves_is_the_common_area_of_two_disks(rim: float, shift: float) -> None:
    x, y = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 400_000))
    pupil = x * x + y * y < 1.0
    common = ((x - shift) ** 2 + y * y < rim * rim)[pupil].mean()
    natural = (1.0 + 1.0) ** -2.0
    assert vignetting(Objective(rim_radius=rim, rim_shift=shift), 1.0) / natural == pytest.approx(common, abs=4e-3)


def test_the_circle_of_confusion_is_that_of_rays_through_the_rim_of_the_pupil() -> None:
    depth_mm, s, f = 360.0, LENS.focus_distance_mm, LENS.focal_length_mm
    sensor_mm, image_mm = f * s / (s - f), f * depth_mm / (depth_mm - f)
    circle_mm = f / LENS.f_number * abs(sensor_mm - image_mm) / image_mm
    assert defocus_px(LENS, depth_mm, PITCH_UM) * PITCH_UM * 1e-3 == pytest.approx(circle_mm, rel=1e-12)
    assert defocus_px(LENS, s, PITCH_UM) == 0.0


def test_at_the_instruments_aperture_diffraction_stays_below_a_pixel() -> None:
    assert diffraction_px(LENS, 0.54, PITCH_UM) == pytest.approx(0.42 * 0.54 * 8 * 334 / 299 / 5.5)
    assert diffraction_px(LENS, 0.60, PITCH_UM) < 0.5


def test_the_normal_curve_has_the_width_of_airys_disk() -> None:
    from scipy import special

    # Airy's half-width at half maximum is 0.514 lambda N; the nearest normal curve's is within 5 % of it.
    r = np.linspace(1e-6, 1.2, 20_000)
    airy = (2.0 * special.j1(np.pi * r) / (np.pi * r)) ** 2
    half_width = r[np.argmin(np.abs(airy - 0.5))]
    assert 0.42 * np.sqrt(2.0 * np.log(2.0)) == pytest.approx(half_width, rel=0.05)


def test_a_focus_nearer_than_the_focal_length_is_refused() -> None:
    with pytest.raises(InputError, match="beyond the focal length"):
        Objective(focus_distance_mm=30.0)


def blurred(image: NDArray[np.float32], sigma_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """[h, w] blurred at each pixel by its own standard deviation [h, w], by a lens without diffraction."""
    wide_open, channels = Objective(f_number=1e-6), np.repeat(image[..., None], 3, axis=2)
    return blur.through(wide_open, channels, sigma_px, GREEN, pixel_pitch_um=PITCH_UM)


@pytest.mark.parametrize("sigma_px", [0.25, 0.5, 1.3, 4.0])
def test_a_point_is_blurred_as_asked_and_keeps_its_light(sigma_px: float) -> None:
    image = blurred(point(), np.full((61, 61), sigma_px, np.float32))
    assert image.sum() == pytest.approx(1000.0, rel=1e-4)
    assert spread_px(image) == pytest.approx((sigma_px, sigma_px), rel=0.002)


def test_pixels_of_different_depths_are_blurred_each_by_its_own() -> None:
    sigma_px = np.full((61, 183), 0.8, np.float32)
    sigma_px[:, 61:122], sigma_px[:, 122:] = 1.7, 3.1
    image = blurred(np.tile(point(), (1, 3)), sigma_px)
    for k, expected in enumerate((0.8, 1.7, 3.1)):
        assert spread_px(image[:, 61 * k : 61 * (k + 1)]) == pytest.approx((expected, expected), rel=0.03)


def test_defocus_and_diffraction_are_added_in_variance_at_every_depth() -> None:
    disk_px = np.full((61, 183), 0.4, np.float32)
    disk_px[:, 61:122], disk_px[:, 122:] = 0.9, 1.6
    lens = Objective(f_number=22.0)
    image = np.repeat(np.tile(point(), (1, 3))[..., None], 3, axis=2)
    soft = blur.through(lens, image, disk_px, GREEN, pixel_pitch_um=PITCH_UM)
    for k, disk in enumerate((0.4, 0.9, 1.6)):
        expected = np.hypot(disk, diffraction_px(lens, 0.54, PITCH_UM))
        assert spread_px(soft[:, 61 * k : 61 * (k + 1)]) == pytest.approx((expected, expected), rel=0.03)


def test_an_even_image_stays_as_it_is_whatever_the_depths() -> None:
    depth_mm = np.random.default_rng(1).uniform(250.0, 450.0, (40, 50)).astype(np.float32)
    depth_mm[:5] = np.inf
    image = np.full((40, 50, 3), 700.0, np.float32)
    disk_px = blur.defocus_blur_px(LENS, depth_mm, PITCH_UM)
    assert np.allclose(blur.through(LENS, image, disk_px, GBRG, pixel_pitch_um=PITCH_UM), 700.0, rtol=1e-5)


def test_an_image_of_several_tiles_is_blurred_as_its_spectrum_is_damped() -> None:
    """Lindeberg's curve damps a frequency w by exp(t (cos w - 1)); an image continued by reflection is a sum of
    cosines."""
    from scipy.fft import dctn, idctn

    image = np.random.default_rng(2).uniform(0.0, 1000.0, (151, 613)).astype(np.float32)
    down, along = (np.cos(np.pi * np.arange(n) / n) - 1.0 for n in image.shape)
    damped = dctn(image) * np.exp(3.0**2 * (down[:, None] + along))
    assert np.allclose(blurred(image, np.full(image.shape, 3.0, np.float32)), idctn(damped), atol=0.02)


def test_each_pixel_gets_the_channel_that_its_filter_passes_blurred_in_full_resolution() -> None:
    image = np.random.default_rng(3).uniform(0.0, 1000.0, (70, 301, 3)).astype(np.float32)
    disk_px = np.random.default_rng(4).uniform(0.0, 2.0, (70, 301)).astype(np.float32)
    mosaic, red, green, blue = (
        blur.through(LENS, image, disk_px, channels, pixel_pitch_um=PITCH_UM)
        for channels in (GBRG, RED, GREEN, BLUE)
    )
    assert np.array_equal(mosaic[0::2, 0::2], green[0::2, 0::2])
    assert np.array_equal(mosaic[0::2, 1::2], blue[0::2, 1::2])
    assert np.array_equal(mosaic[1::2, 0::2], red[1::2, 0::2])
    assert np.array_equal(mosaic[1::2, 1::2], green[1::2, 1::2])


def test_what_is_in_focus_is_blurred_by_diffraction_alone() -> None:
    disk_px = blur.defocus_blur_px(LENS, np.full((61, 61), LENS.focus_distance_mm, np.float32), PITCH_UM)
    image = np.repeat(point()[..., None], 3, axis=2)
    for channels, wavelength_um in ((RED, 0.60), (BLUE, 0.46)):
        through = blur.through(LENS, image, disk_px, channels, pixel_pitch_um=PITCH_UM)
        assert spread_px(through)[0] == pytest.approx(diffraction_px(LENS, wavelength_um, PITCH_UM), rel=0.01)


def test_lateral_colour_moves_a_corner_outwards_and_leaves_the_middle() -> None:
    lens = Objective(lateral_colour=(0.02, 0.0, 0.0), f_number=2.0)
    image = np.zeros((101, 101, 3), np.float32)
    image[50, 90] = image[50, 50] = 100.0
    sharp = np.zeros((101, 101), np.float32)
    cols = np.arange(101)
    far, near = slice(80, 101), slice(40, 61)
    for channels, shift_px in ((RED, 0.8), (GREEN, 0.0)):
        row = blur.through(lens, image, sharp, channels, pixel_pitch_um=PITCH_UM).sum(axis=0)
        assert (row[far] * cols[far]).sum() / row[far].sum() == pytest.approx(90.0 + shift_px, abs=0.03)
        assert (row[near] * cols[near]).sum() / row[near].sum() == pytest.approx(50.0, abs=0.03)
