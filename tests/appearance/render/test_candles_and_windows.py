"""Light of candles and through coloured glass, against the definition of the candela and Fresnel's and Bouguer's
laws."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from spectral_scenes import camera, constant, everywhere, illuminant, plane, rendered, scene

from coupole.appearance.render.church import Size, church
from coupole.appearance.render.spectra import luminous, scaled_power
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.errors import InputError

WHITE = {"kind": "diffuse", "reflectance": constant(1.0)}
FROM_THE_SIDE = {**camera(20), "optics": {"kind": "field", "degrees": 0.5}, "width_px": 4, "height_px": 4}
INDEX = 1.52


def test_a_candle_gives_one_lux_at_one_metre_from_the_side_and_the_colour_of_its_flame() -> None:
    candle = {"kind": "candle", "position_mm": [1000, 0, -197], "intensity_cd": 1.0}
    wall = {**plane(WHITE, 40.0), "abc_deg": [0, 90, 0]}
    view = {**FROM_THE_SIDE, "width_px": 8, "height_px": 8}
    found = rendered(scene([wall], [candle], cameras=[view], samples=300)).radiance.mean(axis=(0, 1))
    # The wall's foot is level with the flame's; the middle of the flame is 11 mm higher.
    assert luminous(found) * np.pi == pytest.approx(1.0, rel=0.02)
    planck = WAVELENGTHS_NM**-5.0 / np.expm1(1.4388e7 / (WAVELENGTHS_NM * 1900.0))
    assert found / found.sum() == pytest.approx(planck / planck.sum(), rel=0.01)


def through_a_pane(colour: dict[str, Any], folder: Path) -> Any:
    """Radiance of a white plane under a pane, in the sun's light along its normal, per irradiance without it."""
    pane = {
        "kind": "stained_glass",
        "width_mm": 400,
        "height_mm": 400,
        "layout": ["g"],
        "panes": {"g": colour},
        "abc_deg": [0, 0, -90],
        "translation_mm": [0, -200, 200],
    }
    sun = {
        "kind": "distant",
        "direction": [0, 0, -1],
        "illuminance_lux": 1e4,
        "width_deg": 0.53,
        "spectrum": illuminant("D65"),
    }
    one = scene([plane(WHITE, 60.0), pane], [sun], cameras=[FROM_THE_SIDE], samples=32)
    found = rendered(one).radiance.mean(axis=(0, 1))
    return found, found * np.pi / scaled_power(light.illuminant("D65"), 1e4)


def test_the_spot_behind_a_pane_is_the_sun_times_what_the_glass_lets_through(tmp_path: Path) -> None:
    per_mm = 0.1 + 0.6 * np.exp(-0.5 * ((WAVELENGTHS_NM - 590.0) / 40.0) ** 2)
    rows = "\n".join(f"{nm:g},{value:.6f}" for nm, value in zip(WAVELENGTHS_NM, per_mm, strict=True))
    (tmp_path / "blue.csv").write_text("nm,1/mm\n" + rows + "\n")
    absorbing = {"kind": "absorption", "path": str(tmp_path / "blue.csv"), "thickness_mm": 3.0}
    radiance, share = through_a_pane(absorbing, tmp_path)
    # Bouguer between two faces, all reflections summed one by one.
    face, left = ((INDEX - 1.0) / (INDEX + 1.0)) ** 2, np.exp(-3.0 * per_mm)
    expected = sum((1.0 - face) ** 2 * left * (face * left) ** (2 * n) for n in range(6))
    assert share == pytest.approx(expected, rel=1e-3)
    xyz = light.observer("2 deg") @ radiance
    seen = light.observer("2 deg") @ (expected * light.illuminant("D65"))
    assert xyz[:2] / xyz.sum() == pytest.approx(seen[:2] / seen.sum(), abs=1e-3)


def test_a_measured_sheet_lets_through_what_was_measured(tmp_path: Path) -> None:
    (tmp_path / "sheet.csv").write_text("nm,T\n380,0.2\n580,0.9\n780,0.4\n")
    measured = {"kind": "transmittance", "path": str(tmp_path / "sheet.csv")}
    _, share = through_a_pane(measured, tmp_path)
    assert share[[0, 40, 80]] == pytest.approx([0.2, 0.9, 0.4], rel=5e-3)


def test_a_sheet_clearer_than_glass_is_refused(tmp_path: Path) -> None:
    (tmp_path / "sheet.csv").write_text("nm,T\n380,0.99\n580,0.99\n780,0.99\n")
    with pytest.raises(InputError, match="whole sheet"):
        through_a_pane({"kind": "transmittance", "path": str(tmp_path / "sheet.csv")}, tmp_path)


def test_a_layout_with_a_letter_that_is_no_pane_is_refused() -> None:
    window = {
        "kind": "stained_glass",
        "width_mm": 1,
        "height_mm": 1,
        "layout": ["rb"],
        "panes": {"r": {"kind": "clear"}},
    }
    with pytest.raises(ValidationError, match="does not name"):
        scene([window], [everywhere(illuminant("E"))])


SIZE = Size(6000.0, 12000.0, 5000.0, 3, 600.0, 1000.0, 1800.0, 3800.0)


def test_light_reaches_a_church_by_its_windows_alone() -> None:
    """Rays from the altar, by a tracer of its own: those that leave pass the rectangle of a window."""
    import trimesh

    parts = church(SIZE)
    corners = np.concatenate([parts.stone_mm, parts.light_tiles_mm, parts.dark_tiles_mm])
    assert 1000 < len(corners) < 5000
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    ways = np.random.default_rng(1).normal(size=(4000, 3))
    starts = np.broadcast_to([0.0, 3000.0, 1500.0], ways.shape)
    gone = ~mesh.ray.intersects_any(starts, ways)
    through = np.zeros(len(ways), dtype=bool)
    for opening in parts.openings:
        into = np.linalg.inv(opening.church_from_window)
        start, way = starts @ into[:3, :3].T + into[:3, 3], ways @ into[:3, :3].T
        x, _, z = (start - start[:, 1:2] / way[:, 1:2] * way).T
        ahead = way[:, 1] * start[:, 1] < 0.0
        through |= ahead & (abs(x) <= 0.5 * opening.width_mm) & (z >= 0.0) & (z <= opening.height_mm)
    assert 0.005 < gone.mean() < 0.2
    assert not np.any(gone & ~through)
