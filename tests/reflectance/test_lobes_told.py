"""A specular lobe that the samples do not tell is said on the page, and not drawn as noise."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from coupole.reflectance.ggx import lobe
from coupole.reflectance.result_pages import lobes_told, run_reflectance_page
from coupole.reflectance.result_pages.material_maps import MapValues, MaterialMaps, material_maps

ROWS = np.arange(100, dtype=np.int32).reshape(10, 10)
"""A view of a hundred triangles, a pixel each."""


def uncertainties(of_ks: np.ndarray) -> np.ndarray:
    return np.stack([*np.full((3, 100), 0.01), of_ks, np.full(100, 0.2)], axis=1)


def maps_of(ks: np.ndarray, alpha: np.ndarray, uncertain: np.ndarray) -> MaterialMaps:
    normals, kd = np.tile([0.0, 0.0, 1.0], (100, 1)), np.full((100, 3), 0.2)
    return material_maps(MapValues(ROWS, normals, kd, ks, alpha, uncertain))


def test_a_lobe_is_told_where_its_uncertainty_is_at_most_a_half() -> None:
    ks = np.array([[0.1], [0.1], [0.0], [np.nan], [0.1]])
    told = lobes_told.is_told_by_uncertainty(ks, np.array([0.5, 6.0, 0.1, 0.1, np.nan]))
    assert told.tolist() == [True, False, False, False, False]


@pytest.mark.parametrize("alpha", [0.1, 0.4, 1.0])
def test_a_highlight_is_what_the_fitted_model_shows_along_the_normal(alpha: float) -> None:
    kd, ks = np.array([[0.2, 0.3, 0.4]]), np.array([[0.02, 0.02, 0.02]])
    expected = 0.02 * lobe(1.0, 1.0, 1.0, alpha)[0] / 0.3
    assert lobes_told.highlights(kd, ks, np.array([alpha])) == pytest.approx(expected)


def test_a_matt_object_has_a_sentence_in_place_of_maps() -> None:
    ks, alpha = np.full((100, 3), 0.01), np.full(100, 0.5)
    of_ks = np.full(100, 6.1)
    of_ks[0] = 0.1
    maps = maps_of(ks, alpha, uncertainties(of_ks))
    assert maps.lobe == ()
    assert "not drawn" in maps.lobe_words
    assert "99%" in maps.lobe_words


def test_an_object_that_shines_in_part_has_maps_of_that_part_alone() -> None:
    ks, alpha = np.full((100, 3), 0.05), np.full(100, 0.5)
    of_ks = np.where(np.arange(100) < 30, 0.2, 3.0)
    maps = maps_of(ks, alpha, uncertainties(of_ks))
    assert len(maps.lobe) == 4
    assert "30%" in maps.lobe_words
    for figure in maps.lobe:
        with Image.open(io.BytesIO(figure.png)) as opened:
            assert (np.asarray(opened.convert("RGBA"))[..., 3].ravel() == np.where(of_ks < 1, 255, 0)).all()


def test_an_uncertainty_beyond_the_value_is_not_told() -> None:
    assert run_reflectance_page._percent_in_words(607.9) == "not told"
    assert run_reflectance_page._percent_in_words(4.72) == "4.7 %"
