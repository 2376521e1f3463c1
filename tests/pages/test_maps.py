"""Maps: a pixel's colour is its value's place in the palette, and no value has no colour."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from coupole.pages import palettes
from coupole.pages.maps import WIDTH_PX, colour_map, eye_map, normal_map, shaded_map, value_map


def pixels(png: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(png)) as opened:
        return np.asarray(opened.convert("RGBA"))


@pytest.mark.parametrize("palette", sorted(palettes.ANCHORS))
def test_all_colours_of_a_palette_differ_and_lead_from_dark_to_light_or_about_a_middle(palette: str) -> None:
    assert len(set(palettes.hexadecimal(palette))) == palettes.LEVELS
    luminance = palettes.table(palette) @ np.array([0.2126, 0.7152, 0.0722])
    rises = np.diff(luminance) > 0
    assert rises.all() if palette != "signed" else rises[:90].all() and not rises[-90:].any()


@pytest.mark.parametrize(("low", "high"), [(0.0, 10.0), (-2.5, 2.5)])
def test_values_are_read_back_from_colours_to_one_in_199_of_the_range(low: float, high: float) -> None:
    values = np.random.default_rng(0).uniform(low, high, (20, 30))
    values[3, 4], values[5, 6] = np.nan, high + 1
    shown = value_map("x", values, "mm", high, low=low, palette="signed")
    codes = pixels(shown.png)
    place = {bytes(colour): k for k, colour in enumerate(palettes.table("signed"))}
    read = np.array([[low + (high - low) * place.get(bytes(c[:3]), 0) / 199 for c in row] for row in codes])
    known = np.isfinite(values)
    assert (codes[..., 3] == np.where(known, 255, 0)).all()
    assert np.abs(read - np.clip(values, low, high))[known].max() <= (high - low) / 199 / 2 + 1e-9
    assert shown.is_cut


def test_pictures_for_the_eye_and_normals_keep_their_values() -> None:
    colours = np.random.default_rng(1).uniform(0.0, 0.3, (8, 9, 3))
    shown = eye_map("x", colours, 0.3)
    assert 0.3 * (pixels(shown.png)[..., :3] / 255.0) ** shown.gamma == pytest.approx(colours, abs=0.002)
    normals = colours / np.linalg.norm(colours, axis=2, keepdims=True)
    normals[0, 0] = np.nan
    codes = pixels(normal_map("x", normals).png)
    assert codes[0, 0, 3] == 0
    assert codes[1:, :, :3] / 127.5 - 1 == pytest.approx(normals[1:], abs=0.005)


def test_a_wide_map_is_thinned_and_never_mixed() -> None:
    values = np.tile([0.0, 1.0], (4, WIDTH_PX))
    colours = {bytes(c[:3]) for row in pixels(value_map("x", values, "", 1.0).png) for c in row}
    assert colours <= {bytes(palettes.table("amount")[k]) for k in (0, -1)}
    assert pixels(colour_map("x", np.zeros((4, 1000, 3)), "abc", 1.0).png).shape[1] <= WIDTH_PX


def test_shade_lies_over_a_map_and_leaves_its_colours() -> None:
    values = np.full((5, 6), 0.5)
    shown = shaded_map("x", values, np.full((5, 6), 0.25), "mm", 1.0)
    plain = value_map("x", values, "mm", 1.0)
    assert shown.png == plain.png
    assert set(pixels(shown.shade_png)[..., 3].ravel()) == {191}
