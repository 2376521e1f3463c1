"""Worn and cracked layers and dust: shares of the picture counted in pixels, and where they lie."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from spectral_scenes import constant, everywhere, illuminant, plane, rendered, scene

from coupole.appearance.render.materials import Material
from coupole.appearance.render.spectra import scaled_power
from coupole.appearance.render.weathered_mesh import weathered_triangles
from coupole.appearance.shapes import solid_masks
from coupole.appearance.shapes.solids import relief
from coupole.appearance.shapes.triangles import rectangle
from coupole.appearance.spectra import light
from coupole.errors import InputError

BLACK, WHITE = ({"kind": "diffuse", "reflectance": constant(value)} for value in (0.0, 1.0))


def worn(pattern: dict[str, Any], share: float | None = None) -> dict[str, Any]:
    return {"kind": "worn", "over": BLACK, "under": WHITE, "share": share, "pattern": pattern}


def picture(thing: dict[str, Any], size_mm: float, pixels: int) -> np.ndarray:
    """Reflectance of each pixel under light from everywhere, from far above."""
    far = {
        "name": "main",
        "position_mm": [0, 0, 50 * size_mm],
        "target_mm": [0, 0, 0],
        "up": [0, 1, 0],
        "optics": {"kind": "field", "degrees": float(np.degrees(2 * np.arctan(0.01)))},
        "width_px": pixels,
        "height_px": pixels,
    }
    lit = [everywhere(illuminant("E"))]
    one = scene([thing], lit, cameras=[far], samples=16, bands={"step_nm": 40})
    return np.asarray(rendered(one).radiance[..., 0] / scaled_power(light.illuminant("E"), 100.0)[0])


@pytest.mark.parametrize(
    ("pattern", "share"),
    [({"kind": "uniform"}, 0.2), ({"kind": "cracks", "cell_mm": 3.0}, 0.12)],
)
def test_a_worn_share_is_that_of_the_picture(pattern: dict[str, Any], share: float) -> None:
    seen = picture(plane(worn(pattern, share), 15.0), 15.0, 48)

    assert seen.mean() == pytest.approx(share, abs=0.01)
    assert (pattern["kind"] == "uniform") == (seen.std() < 0.15)


def test_cracks_have_their_width_and_cells_their_size() -> None:
    material = TypeAdapter(Material).validate_python(worn({"kind": "cracks", "cell_mm": 4.0, "width_mm": 0.4}))
    sheet = rectangle(24.0, 24.0)

    made = weathered_triangles(sheet, material, smooth=False)

    # Lines across the sheet cross a crack in pi/2 times its width, in the mean over directions.
    grid = np.linspace(-11.9, 11.9, 2000)
    import trimesh

    found = trimesh.Trimesh(
        made.corners_mm.reshape(-1, 3), np.arange(3 * len(made.off)).reshape(-1, 3), process=False
    )
    lengths, crossings = 0.0, 0
    for y in np.linspace(-11.3, 11.4, 15):
        above = np.stack([grid, np.full_like(grid, y), np.ones_like(grid)], axis=1)
        off = made.off[found.ray.intersects_first(above, np.tile([0.0, 0.0, -1.0], (len(grid), 1)))]
        lengths += off.mean() * 23.8
        crossings += int((np.diff(off.astype(int)) == 1).sum())
    assert lengths / crossings / (0.5 * np.pi) == pytest.approx(0.4, rel=0.3)
    assert 15 * 23.8 / crossings == pytest.approx(4.0, rel=0.4)


def test_edges_are_rubbed_where_a_relief_stands_out() -> None:
    corners = relief(40.0, 4000, 9.0, 1)
    material = TypeAdapter(Material).validate_python(worn({"kind": "edges", "reach_mm": 4.0}, 0.15))

    made = weathered_triangles(corners, material, smooth=True)

    assert made.share == pytest.approx(0.15, abs=0.01)
    heights = made.corners_mm.mean(axis=1)[:, 2]
    up = made.normals.mean(axis=1)[:, 2] > 0.5
    assert heights[made.off & up].mean() > heights[~made.off & up].mean()


def test_dust_lies_on_what_faces_up_by_the_share_that_grains_hide() -> None:
    dusty = {
        "kind": "dusty",
        "over": BLACK,
        "grams_per_m2": 8.0,
        "grain_um": 20.0,
        "density_g_cm3": 2.0,
        "reflectance": constant(1.0),
    }
    ball = {"kind": "sphere", "radius_mm": 15.0, "material": dusty}

    seen = picture(ball, 30.0, 48)

    # 8 g/m2 in spheres of 20 um and 2 g/cm3 have 0.3 m2 of shadow on each m2.
    offset = (np.arange(48) + 0.5) / 24.0 - 1.0
    upward = np.sqrt(np.maximum(0.0, 1.0 - offset[:, None] ** 2 - offset**2))
    for low, high in ((0.3, 0.6), (0.6, 0.8), (0.8, 0.95), (0.95, 1.0)):
        ring = (upward > low) & (upward < high)
        assert seen[ring].mean() == pytest.approx((1.0 - np.exp(-0.3 * upward[ring])).mean(), abs=0.02)


def test_random_spheres_hide_what_the_exponential_says() -> None:
    # 0.3 m2 of disks on a torus of 1 m2, by 20,000 probes.
    random = np.random.default_rng(1)
    radius = 0.01
    centres, probes = random.random((round(0.3 / (np.pi * radius**2)), 2)), random.random((20_000, 2))
    from scipy.spatial import KDTree

    hidden = KDTree(centres, boxsize=1.0).query(probes, distance_upper_bound=radius)[0] < radius
    assert hidden.mean() == pytest.approx(1.0 - np.exp(-0.3), abs=0.02)


def test_what_cannot_be_worn_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    sheet = rectangle(40.0, 40.0)
    flat = TypeAdapter(Material).validate_python(worn({"kind": "edges", "reach_mm": 4.0}, 0.15))
    with pytest.raises(InputError, match="a flat sheet has no edges"):
        weathered_triangles(sheet, flat, smooth=False)
    monkeypatch.setattr(solid_masks, "MOST_TRIANGLES", 20_000)
    fine = TypeAdapter(Material).validate_python(worn({"kind": "cracks", "cell_mm": 1.0, "width_mm": 0.01}))
    with pytest.raises(InputError, match="wider cracks"):
        weathered_triangles(sheet, fine, smooth=False)
    with pytest.raises(ValidationError, match="give either `share`, or `width_mm`"):
        TypeAdapter(Material).validate_python(worn({"kind": "cracks", "cell_mm": 1.0}))
