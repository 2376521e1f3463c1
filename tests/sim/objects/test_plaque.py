"""The plaque: its form, which material is where, and its inscription."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sim.objects import plaque, plum_branch
from sim.objects import plaque_relief as relief
from sim.objects.carving import NOISE_SPREAD, curve, distance_to_line, noise
from sim.objects.lettering import CAPITALS, strokes_distance, text_width
from sim.scene.surface import Surface


@pytest.fixture(scope="module")
def coarse() -> Surface:
    return plaque.plaque(0.5)


def material_at(*places: tuple[float, float], wear: float = 0.0) -> list[int]:
    x, y = np.array(places).T
    return plaque.materials_at(x, y, np.full(len(x), wear)).tolist()


def height_at(x: float, y: float) -> float:
    return float(relief.height_mm(np.array([x]), np.array([y]))[0])


def test_the_plaque_is_one_closed_body_of_112_by_84_mm(coarse: Surface) -> None:
    body = trimesh.Trimesh(coarse.corners_mm.reshape(-1, 3), np.arange(3 * len(coarse.corners_mm)).reshape(-1, 3))
    assert body.is_watertight
    assert body.is_winding_consistent
    assert body.volume > 0
    assert body.bounds[:, :2] == pytest.approx(np.array([[-56.0, -42.0], [56.0, 42.0]]))
    assert body.bounds[0, 2] == 0.0
    assert 18.0 < body.bounds[1, 2] < 23.0


def test_shading_normals_are_units_and_near_those_of_the_triangles(coarse: Surface) -> None:
    assert coarse.normals is not None
    assert np.linalg.norm(coarse.normals, axis=1) == pytest.approx(1.0)
    corners = coarse.corners_mm
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    assert np.median(np.sum(flat * coarse.normals, axis=1)) > 0.999


def test_every_material_covers_some_of_the_plaque(coarse: Surface) -> None:
    share = np.bincount(coarse.material, minlength=8) / len(coarse.material)
    assert len(plaque.materials()) == 8
    assert (share > 0.002).all()
    assert share[plaque.STONE] > 0.3


def test_parts_are_where_they_belong() -> None:
    assert material_at((0.0, 8.0), (-53.0, 0.0), (-54.5, -40.5)) == 3 * [plaque.STONE]
    assert material_at((41.3, 10.0), (36.0, -10.0)) == 2 * [plaque.CLOTH]
    nimbus = [(relief.NIMBUS[0] + 18.0 * np.cos(a), relief.NIMBUS[1] + 18.0 * np.sin(a)) for a in (0.3, 1.5, 2.8)]
    assert material_at(*nimbus) == 3 * [plaque.GOLD]
    in_lacquer = np.random.default_rng(1).uniform((-48.0, -24.0), (-34.0, 34.0), (4000, 2))
    assert set(material_at(*map(tuple, in_lacquer))) == {plaque.LACQUER, plaque.POWDER}


def test_gold_is_worn_to_the_bole_and_then_to_the_stone() -> None:
    place = (relief.NIMBUS[0], relief.NIMBUS[1] + 18.0)
    worn = [material_at(place, wear=wear)[0] for wear in (0.0, 1.0, 2.0)]
    assert worn == [plaque.GOLD, plaque.BOLE, plaque.STONE]


def test_powder_lies_where_the_drawing_has_it() -> None:
    x, y = np.random.default_rng(2).uniform((-49.0, -25.0), (-33.4, 35.0), (40_000, 2)).T
    share = plum_branch.powder_share(*relief.panel_place(x, y))
    has_powder = plaque.materials_at(x, y, np.zeros(len(x))) == plaque.POWDER
    for low, high in ((0.0, 0.05), (0.3, 0.5), (0.6, 0.8), (0.9, 1.0)):
        chosen = (share >= low) & (share <= high)
        assert has_powder[chosen].mean() == pytest.approx(share[chosen].mean(), abs=0.05)


def test_the_nose_is_the_highest_of_the_face_and_eyes_lie_deeper() -> None:
    x, y = np.meshgrid(np.linspace(-9.0, 11.0, 101), np.linspace(-4.0, 16.0, 101))
    head = relief.head_mm(x, y)
    top_y, top_x = np.unravel_index(np.argmax(head), head.shape)
    assert 3.0 < y[top_y, 0] < 7.0
    assert 1.0 < x[0, top_x] < 6.0
    assert head.max() == pytest.approx(height_at(x[0, top_x], y[top_y, 0]), abs=1e-6)
    assert head.max() - relief.head_mm(np.array([-2.0]), np.array([8.5]))[0] > 2.0


def test_strokes_are_cut_0_3_mm_wide_and_0_06_mm_deep() -> None:
    # The stem of the first L, halfway up.
    stem = -0.5 * text_width(relief.INSCRIPTION) * relief.LETTER_MM
    x = stem + np.linspace(-1.0, 1.0, 2001)
    y = np.full(2001, relief.BASELINE_MM + 0.5 * relief.LETTER_MM)
    assert 1e-3 * np.sum(plaque.materials_at(x, y, np.zeros(2001)) == plaque.RED) == pytest.approx(0.3, abs=0.003)
    height = relief.height_mm(x, y)
    assert height[np.abs(x - stem) > 0.2].mean() - height[1000] == pytest.approx(0.06, abs=0.02)


def test_the_inscription_fits_its_band() -> None:
    assert set(relief.INSCRIPTION) - {" "} <= CAPITALS.keys()
    left, right, bottom, top = relief.BAND_MM
    foot, head = relief.BASELINE_MM, relief.BASELINE_MM + relief.LETTER_MM
    assert text_width(relief.INSCRIPTION) * relief.LETTER_MM < right - left - 4.0
    assert foot > bottom + 1.0
    assert head < top - 1.0


def test_letters_are_as_long_as_their_strokes_say() -> None:
    """The area of a line is its length times its width, plus round ends."""
    spacing, half_width = 0.01, 0.05
    x, y = np.meshgrid(np.arange(-1.0, 1.0, spacing), np.arange(-0.2, 1.2, spacing))
    area = spacing**2 * np.sum(strokes_distance("O", x.ravel(), y.ravel(), 1.0) < half_width)
    assert area == pytest.approx(np.pi * ((0.5 + half_width) ** 2 - (0.5 - half_width) ** 2), rel=0.02)
    area = spacing**2 * np.sum(strokes_distance("I", x.ravel(), y.ravel(), 1.0) < half_width)
    assert area == pytest.approx(2 * half_width * 1.0 + np.pi * half_width**2, rel=0.03)


def test_cloth_has_threads_of_0_7_mm_over_and_under() -> None:
    y = np.arange(0.0, 14.0, 0.01)
    height = relief.cloth_mm(np.full(len(y), 41.3), y)
    slow = np.convolve(height, np.ones(140) / 140, mode="same")
    spectrum = np.abs(np.fft.rfft((height - slow)[140:-140]))
    period_mm = 0.01 * (len(y) - 280) / np.argmax(spectrum)
    # A thread on top, then one below: the pattern repeats after two.
    assert min(abs(period_mm - 1.4), abs(period_mm - 0.7)) < 0.05


def test_noise_repeats_and_has_the_stated_spread() -> None:
    x, y = np.random.default_rng(3).uniform(0.0, 256.0, (2, 20_000))
    values = noise(x, y, 2.0, 5)
    assert abs(values.mean()) < 0.05
    assert values.std() == pytest.approx(NOISE_SPREAD, abs=0.03)
    assert noise(x + 256.0, y, 2.0, 5) == pytest.approx(values, abs=1e-9)
    assert np.abs(noise(x, y, 2.0, 6) - values).mean() > 0.3


def test_a_curve_goes_through_its_points_and_distance_is_to_the_nearest_of_it() -> None:
    points = [(0.0, 0.0), (1.0, 2.0), (3.0, 1.0)]
    smooth = curve(points, 10)
    assert smooth[0] == points[0]
    assert smooth[5] == pytest.approx(points[1])
    assert smooth[-1] == pytest.approx(points[-1])
    distance, along = distance_to_line(np.array([0.5, -1.0]), np.array([1.0, 0.0]), [(0.0, 0.0), (2.0, 0.0)])
    assert distance.tolist() == [1.0, 1.0]
    assert along.tolist() == [0.25, 0.0]
