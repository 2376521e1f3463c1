"""What pixels may see beside a triangle, on a sheet whose brightness is known in closed form."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from relight_cases import waves, write_result

from coupole.errors import InputError
from coupole.reflectance.extraction.sample_codes import SHADED
from coupole.reflectance.sample_sources import ChannelSamples, channel_samples, triangles_beside

SIDE, PITCH_MM = 40, 0.5
LED_MM = np.array([[0.0, 0.0, 1e6], [3e5, 0.0, 1e6]])


def sheet(folder: Path, shift_mm: float, u_noise: float, brightness: Any) -> tuple[Any, Any]:
    """A result with one view straight from above, far away, of a sheet of little squares, as a lamp above them and
    one beside see it; `brightness` [n] of places."""
    y, x = (PITCH_MM * values.ravel() for values in np.mgrid[:SIDE, :SIDE])
    centres = np.column_stack([x, y, np.zeros(len(x))])
    count, random = len(centres), np.random.default_rng(0)
    cosine = LED_MM[:, 2] / np.linalg.norm(LED_MM, axis=1)
    f = brightness(centres)[:, None, None] / cosine[:, None] * np.ones((count, 2, 1))
    f = f * (1 + u_noise * random.standard_normal(f.shape))
    path = folder / "top.h5"
    with h5py.File(path, "w") as file:
        file.attrs.update(led_u_mm=0.1, lateral_u_mm=shift_mm)
        values = {"f": f, "u_own": np.full(f.shape, u_noise), "u_response": np.full((count, 1), 0.002)}
        values |= {"led_u_own": np.full((2, 1), 0.01), "led_u_shared": np.full((2, 1), 0.006)}
        values |= {"centres_mm": centres, "normals": np.tile([0.0, 0, 1], (count, 1)), "camera_mm": [0.0, 0, 1e6]}
        file["codes"] = np.zeros((count, 2), np.uint8)
        for name, data in values.items():
            file[name] = np.asarray(data, np.float16 if name in ("f", "u_own") else np.float64)
    corners = centres[:, None] + PITCH_MM * np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]]) / 3
    result = SimpleNamespace(corners_mm=corners, areas_mm2=np.full(count, PITCH_MM**2))
    view = SimpleNamespace(
        path=path, triangles=np.arange(count), inter_reflection=None, led_mm=LED_MM, led_normals=-LED_MM / 1e6
    )
    return result, view


def of(made: tuple[Any, Any], rows: np.ndarray) -> ChannelSamples:
    return channel_samples(*made, rows, np.arange(2), 0, 30.0)


def inner() -> np.ndarray:
    return np.flatnonzero(np.pad(np.ones((SIDE - 12, SIDE - 12), bool), 6))


@pytest.mark.parametrize("shift_mm", [0.03, 0.2, 1.0])
def test_a_slope_of_brightness_counts_as_far_as_the_picture_may_be_off(tmp_path: Path, shift_mm: float) -> None:
    made = sheet(tmp_path, shift_mm, 0.0, lambda places: 10.0 + places[:, 0])
    mine = of(made, inner())
    slope = shift_mm / (10.0 + mine.places.corners_mm[:, :, 0].mean(axis=1))
    np.testing.assert_allclose(mine.sources.u_place, slope, rtol=0.15)
    assert np.median(mine.sources.u_place / slope) == pytest.approx(1.0, abs=0.04)


def test_noise_counts_once_more_by_a_quarter_at_most(tmp_path: Path) -> None:
    """Of a sheet of one brightness there is nothing but noise, which is taken off what neighbours differ by; what
    is left is never less than nothing."""
    still = of(sheet(tmp_path, 0.4, 0.05, lambda places: np.full(len(places), 10.0)), inner()).sources
    assert np.sqrt(np.mean(still.u_signal**2)) < 1.25 * np.hypot(0.05, 0.002)
    assert np.median(still.u_signal) < 1.05 * np.hypot(0.05, 0.002)


def test_an_edge_counts_on_both_sides_of_it_and_nowhere_else(tmp_path: Path) -> None:
    edge = of(sheet(tmp_path, 0.3, 0.0, lambda places: np.where(places[:, 0] < 10.2, 1.0, 2.0)), inner())
    away_mm = np.abs(edge.places.corners_mm[:, :, 0].mean(axis=1) - 10.25)
    assert (edge.sources.u_place[away_mm < 0.3] > 0.2).all()
    assert (edge.sources.u_place[away_mm > 1.0] < 1e-6).all()


def test_a_neighbour_in_shadow_is_dark_and_one_that_nobody_knows_may_be(tmp_path: Path) -> None:
    made = sheet(tmp_path, 0.3, 0.0, lambda places: np.full(len(places), 1.0))
    with h5py.File(made[1].path, "a") as file:
        x, f, codes = file["centres_mm"][:, 0], file["f"][()], file["codes"][()]
        f[x > 10.2, 0], codes[x > 10.2, 0] = np.nan, SHADED
        lonely = int(inner()[100])
        f[:, 1] = np.where(np.arange(len(f)) == lonely, 1.0, np.nan)[:, None]
        file["f"][()], file["codes"][()] = f, codes
    mine = of(made, inner())
    away_mm = np.abs(mine.places.corners_mm[:, :, 0].mean(axis=1) - 10.25)
    lit = np.isfinite(mine.f)
    assert (mine.sources.u_place[lit & (mine.leds == 0) & (away_mm < 0.3)] > 0.2).all()
    assert (mine.sources.u_place[lit & (mine.leds == 0) & (away_mm > 1.0)] < 1e-6).all()
    assert mine.sources.u_place[lit & (mine.leds == 1)].tolist() == [1.0]


def test_the_other_sources_come_from_the_file_row_by_row_or_led_by_led(tmp_path: Path) -> None:
    made = sheet(tmp_path, 0.2, 0.02, lambda places: 10.0 + places[:, 1])
    many, few = of(made, np.arange(SIDE**2)), of(made, np.array([7, 900]))
    for whole, some in (
        (many.f, few.f),
        *zip(vars(many.sources).values(), vars(few.sources).values(), strict=True),
    ):
        np.testing.assert_array_equal(whole.reshape(-1, 2)[[7, 900]], some.reshape(-1, 2))
    assert few.rows.tolist() == [7, 7, 900, 900]
    assert few.leds.tolist() == [0, 1, 0, 1]
    assert few.sources.u_noise == pytest.approx(0.02, rel=1e-3)
    assert few.sources.u_response == pytest.approx(0.002)
    assert few.sources.u_own == pytest.approx(0.01)
    assert few.sources.u_shared == pytest.approx(0.006)
    assert (few.sources.led_mm == 0.1).all()
    assert (few.sources.vertex_um == 30.0).all()


def test_samples_of_an_earlier_version_are_refused(tmp_path: Path) -> None:
    made = sheet(tmp_path, 0.2, 0.0, lambda places: np.full(len(places), 1.0))
    with h5py.File(made[1].path, "a") as file:
        del file.attrs["lateral_u_mm"]
    with pytest.raises(InputError, match="earlier version"):
        of(made, np.array([0]))


def test_a_result_that_is_made_again_in_its_folder_has_its_own_neighbours(tmp_path: Path) -> None:
    """The second result has fewer triangles; numbers of the first one would not exist in it."""
    for count in (30, 12):
        result = write_result(tmp_path / "result", waves(count))
        (view,) = result.views
        rows = np.arange(len(view.triangles))
        neighbours = triangles_beside(result, view, rows).rows
        assert neighbours.max() < len(rows)
        shutil.rmtree(tmp_path / "result")
