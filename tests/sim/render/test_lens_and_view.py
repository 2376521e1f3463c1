"""What a view knows of the triangles it shows, and what the lens does to the picture."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import BENT, camera_above, quad, scene_of

from coupole.errors import InputError
from sim.optics.objective import Objective, vignetting
from sim.render.camera_view import Viewer, slopes
from sim.render.lens import Lens, distorted_points, sight
from sim.scene.scene import build_scene
from sim.scene.surface import Material, Surface

LENS = Lens(160, 120, 200.0)
BENT_SIGHT = sight(Lens(160, 120, 200.0, BENT))


def test_the_back_of_a_triangle_is_a_side_of_its_own_with_its_normal_turned() -> None:
    scene = scene_of(quad((0, 0, 0), 50.0)[:, ::-1])
    view = Viewer(scene, LENS).look(camera_above(200.0))
    assert sorted(view.sides.tolist()) == [1, 3]
    assert np.allclose(view.normals, [0, 0, 1])


def test_tint_normals_and_materials_go_with_their_triangles() -> None:
    square, tilted = quad((0, 0, 0), 50.0), np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8]])
    tint = np.array([[1.0, 0.5, 0.25], [0.5, 1.0, 1.0]], np.float32)
    plain = Surface(quad((0, 0, -30), 200.0), (Material("a", (0.1, 0.1, 0.1)),), np.zeros(2, np.int32))
    painted = Surface(square, (Material("b", (0.8, 0.6, 0.4)),), np.zeros(2, np.int32), tint, tilted)
    view = Viewer(build_scene([(plain, np.eye(4)), (painted, np.eye(4))]), LENS).look(camera_above(200.0))
    row = {int(side) >> 1: i for i, side in enumerate(view.sides)}
    assert np.allclose(view.diffuse[row[0]], 0.1)
    assert np.allclose(view.diffuse[row[3]], [0.4, 0.6, 0.4])
    assert np.allclose(view.shading_normals[[row[0], row[2], row[3]]], [[0, 0, 1], *tilted])
    assert np.allclose(view.normals, [0, 0, 1])


@given(st.floats(0, 159), st.floats(0, 119))
def test_undoing_distortion_and_distorting_again_leads_back_to_the_pixel(x: float, y: float) -> None:
    lens, shift = BENT_SIGHT.lens, BENT_SIGHT.shift
    assert shift is not None
    col, row = int(x), int(y)
    place = (np.array([col, row]) - lens.centre_px) / lens.focal_px
    assert distorted_points(place + shift[:, row, col], BENT) == pytest.approx(place, abs=1e-7)


def test_a_lens_that_folds_its_image_is_refused() -> None:
    with pytest.raises(InputError, match="folds the image"):
        sight(Lens(160, 120, 100.0, (-1.5, 0.0, 0.0, 0.0, 0.0)))


def test_light_falls_off_with_the_fourth_power_of_the_cosine() -> None:
    falloff = vignetting(Objective(), np.hypot(*slopes(sight(LENS))))
    x, y = 0.0 - 79.5, 10.0 - 59.5
    assert falloff[10, 0] == pytest.approx((200.0 / np.sqrt(200.0**2 + x**2 + y**2)) ** 4, rel=1e-6)
