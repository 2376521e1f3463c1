"""Stickers in RAW images: where the centre of a tilted disk is seen, and what is no sticker."""

from __future__ import annotations

import numpy as np
import pytest
from bright_squares import BLACK_DN, covered, raw
from scipy.spatial.transform import Rotation
from synthesis import Array, TrueLens

from coupole.calibration.grey_image import plane
from coupole.calibration.optics import Intrinsics
from coupole.calibration.stickers.detection import Sticker, find_stickers

SHAPE = (240, 320)
LENS = TrueLens((3480.0, 3480.0), (160.3, 118.6), (-0.05, 0.02, 2e-4, -3e-4, 0.0))
INTRINSICS = Intrinsics(3480.0, 3480.0, 160.3, 118.6, -0.05, 0.02, 2e-4, -3e-4, 0.0)


def outline(centre_mm: Array, normal: Array, radius_mm: float) -> Array:
    """A circle's picture, as a polygon of 90 corners."""
    x = np.cross(normal, [0.3, -0.5, 0.81])
    x /= np.linalg.norm(x)
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)[:, None]
    return LENS.see(centre_mm + radius_mm * (np.cos(angle) * x + np.sin(angle) * np.cross(normal, x)))


def picture(disks: list[tuple[Array, Array]], ground: float = 0.25, light: float = 0.6) -> Array:
    """Stickers of 6 mm in 10 mm on an even ground."""
    image = np.full(SHAPE, ground)
    for centre, normal in disks:
        border, disk = covered(SHAPE, outline(centre, normal, 5.0)), covered(SHAPE, outline(centre, normal, 3.0))
        image = image * (1 - border) + 0.02 * (border - disk) + light * disk
    return image


def seen(image: Array, seed: int = 1) -> list[Sticker]:
    frame = raw(image.copy(), np.random.default_rng(seed))
    return find_stickers(plane(frame - float(BLACK_DN), "GBRG"), INTRINSICS, depth_mm=(250.0, 600.0))


def tilted(tilt_deg: float, azimuth_deg: float) -> Array:
    turn = Rotation.from_euler("ZY", [azimuth_deg, tilt_deg], degrees=True)
    return np.asarray(turn.apply([0.0, 0.0, -1.0]))


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0, 55.0])
def test_one_of_the_two_centres_is_the_true_one(tilt_deg: float) -> None:
    errors, stated = [], []
    for seed in range(8):
        random = np.random.default_rng(seed)
        centre = np.array([random.uniform(-6, 6), random.uniform(-4, 4), random.uniform(320, 400)])
        found = seen(picture([(centre, tilted(tilt_deg, random.uniform(0, 360)))]), seed)
        assert len(found) == 1
        off = found[0].centres - LENS.see(centre)
        errors.append(off[np.argmin(np.linalg.norm(off, axis=1))])
        stated.append(np.sqrt(np.diag(found[0].covariance)))
    assert np.sqrt(np.mean(np.square(errors))) < 0.08
    assert 0.3 < np.sqrt(np.mean(np.square(np.array(errors) / stated))) < 2.0


def test_one_of_the_two_normals_is_the_true_one() -> None:
    normal = tilted(40.0, 70.0)
    found = seen(picture([(np.array([2.0, -1.0, 350.0]), normal)]))
    assert np.degrees(np.arccos((found[0].normals @ normal).max())) < 1.0
    assert abs(found[0].distance_mm - 350.0) < 5.0


def test_the_middle_of_the_ellipse_is_not_where_the_centre_is_seen() -> None:
    near = Intrinsics(3480.0, 3480.0, 160.3, 118.6)
    sticker = seen(picture([(np.array([0.0, 0.0, 300.0]), tilted(50.0, 0.0))]))[0]
    apart = np.linalg.norm(sticker.centres - sticker.middle, axis=1)
    assert (apart > 0.05).all()
    assert near.fx * 9 / 300**2 > apart.max()


def test_all_of_several_stickers_are_found() -> None:
    places = [(x, y) for x in (-9.0, 4.0) for y in (-5.0, 6.0)]
    disks = [(np.array([x, y, 360.0]), tilted(10.0 * i, 80.0 * i)) for i, (x, y) in enumerate(places)]
    assert len(seen(picture(disks))) == 4


def test_a_bright_disk_without_a_black_border_is_no_sticker() -> None:
    disk = covered(SHAPE, outline(np.array([0.0, 0.0, 350.0]), tilted(20.0, 0.0), 3.0))
    assert seen(0.5 * (1 - disk) + 0.6 * disk) == []


def test_a_bright_square_in_a_black_one_is_no_sticker() -> None:
    image = np.full(SHAPE, 0.25)
    image[70:170, 110:210] = 0.02
    image[90:150, 130:190] = 0.6
    assert seen(image) == []


def test_a_sticker_cut_by_the_frames_edge_is_left_out() -> None:
    assert seen(picture([(np.array([-15.5, 0.0, 350.0]), tilted(0.0, 0.0))])) == []


def test_uneven_light_moves_no_centre() -> None:
    centre = np.array([1.0, 1.0, 350.0])
    slope = 1.0 + 0.8 * (np.arange(SHAPE[1])[None] - 160) / 160
    found = seen(picture([(centre, tilted(0.0, 0.0))]) * slope)
    assert np.linalg.norm(found[0].middle - LENS.see(centre)) < 0.15
