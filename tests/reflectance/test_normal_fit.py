"""Normals and materials of what is drawn with another material than is fitted."""

import numpy as np
import pytest
from picture_cases import KD, ball_on_a_plane, lights_in_rings

from coupole.reflectance.light_gains import SUSPECT, gain_between, gains
from coupole.reflectance.normal_fit import colours, fit_materials, rank_normals

VIEW = np.array([0.0, 0.0, 1.0])
LIGHTS = lights_in_rings()
NORMALS, PICTURES = ball_on_a_plane(LIGHTS)
BALL = (NORMALS[..., 2] < 0.999) & (NORMALS[..., 2] > 0.5)
VALUES = np.moveaxis(PICTURES[:, BALL], 0, 1)


def degrees_off(normals: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(np.sum(normals * NORMALS[BALL], axis=1), -1, 1)))


def test_normals_of_a_glossy_ball_are_found_and_better_than_by_ranks_alone() -> None:
    grey = VALUES.mean(axis=2)
    found = fit_materials(grey, LIGHTS, VIEW)
    by_ranks, _ = rank_normals(grey, LIGHTS)
    assert degrees_off(found.normals).mean() < 0.5
    assert degrees_off(found.normals).mean() < 0.5 * degrees_off(by_ranks).mean()


def test_shadows_and_a_lamp_that_failed_hardly_move_them() -> None:
    grey = VALUES.mean(axis=2)
    grey[:, 5] = 0.0
    grey[:, 20:24] *= 0.02
    assert degrees_off(fit_materials(grey, LIGHTS, VIEW).normals).mean() < 1.5


def test_the_colour_of_the_diffuse_part_is_found() -> None:
    found = fit_materials(VALUES.mean(axis=2), LIGHTS, VIEW)
    kd, ks = colours(VALUES, found, LIGHTS, VIEW)
    share = kd / kd.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(np.median(share, axis=0), KD / KD.sum(), atol=0.01)
    assert np.all(ks >= 0)


def test_pixels_that_saw_too_few_lights_have_no_normal() -> None:
    grey = np.zeros((3, len(LIGHTS)))
    grey[1, :5] = 0.5
    found = fit_materials(grey, LIGHTS, VIEW)
    assert np.all(np.isnan(found.kd))


def test_pictures_that_are_too_bright_are_found() -> None:
    grey = VALUES.mean(axis=2)
    grey[:, 3] *= 1.3
    grey[:, 11] *= 0.8
    found = gains(grey, fit_materials(grey, LIGHTS, VIEW), LIGHTS, VIEW)
    assert set(np.flatnonzero(np.abs(found - 1) > SUSPECT)) == {3, 11}
    assert found[3] == pytest.approx(1.3, rel=0.03)
    assert found[11] == pytest.approx(0.8, rel=0.03)
    assert gain_between(LIGHTS, found, LIGHTS[3] + [0.01, 0, 0]) == pytest.approx(1.0, abs=0.03)
