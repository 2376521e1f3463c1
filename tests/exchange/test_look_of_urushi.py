"""Urushi on pages: means of grains and flakes, against grains and flakes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coupole.appearance.matter import lacquer
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.render.scene_file import Scene
from coupole.appearance.render.urushi import Makie, Nashiji
from coupole.exchange.look.look_of_scenes import look_of_scene
from coupole.exchange.look.scene_layers import COSINES
from coupole.exchange.look.urushi_layers import coarse_grains, nashiji_layers

HERE = Path()
BOWL = Nashiji.model_validate({"kind": "nashiji", "body": {"kind": "turned"}})
BOX = {
    "kind": "makie",
    "body": {"kind": "box", "size_mm": [30, 20, 10], "edge_mm": 2},
    "drawing": {"kind": "motif", "name": "waves", "period_mm": 10},
}


def refracted(ways: np.ndarray, ratio: float) -> np.ndarray:
    """Unit vectors [n, 3] that go up, behind a plane; NaN where they do not pass."""
    flat = ways[:, :2] * ratio
    with np.errstate(invalid="ignore"):
        return np.column_stack([flat, np.sqrt(1.0 - (flat**2).sum(axis=1))])


@pytest.mark.parametrize(("incidence_deg", "low", "high"), [(5.0, 0.98, 1.02), (40.0, 1.0, 1.16)])
def test_the_lobe_has_the_light_of_flakes_that_are_traced_one_by_one(
    incidence_deg: float, low: float, high: float
) -> None:
    random = np.random.default_rng(1)
    count, n = 20_000, indices.URUSHI
    slope = np.tan(np.radians(BOWL.tilt_deg)) * np.sqrt(0.5) * random.normal(size=(count, 2))
    normals = np.column_stack([-slope, np.ones(count)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    angle = np.radians(incidence_deg)
    light = np.tile([np.sin(angle), 0.0, np.cos(angle)], (count, 1))
    inward = refracted(light, 1.0 / n)
    met = np.sum(inward * normals, axis=1)
    outward = 2.0 * met[:, None] * normals - inward
    leaving = refracted(outward, n)
    depth_mm = random.uniform(0.0, BOWL.depth_mm, count)
    way_mm = depth_mm * (1.0 / inward[:, 2] + 1.0 / outward[:, 2])
    kept = np.exp(-way_mm[:, None] * lacquer.urushi_absorption()[::8])
    metal = fresnel.reflectance(met[:, None], indices.gold_silver(0.8)[::8] / n)
    through = np.where(
        np.isfinite(leaving[:, 2]), 1.0 - fresnel.reflectance(np.nan_to_num(leaving[:, 2], nan=1.0), n), 0.0
    )
    traced = (1.0 - fresnel.reflectance(np.cos(angle), n)) * (through[:, None] * metal * kept).mean(axis=0)
    radius_mm = BOWL.flake_radius_mm * np.exp(0.3 * random.normal(size=count))
    covered = 1.0 - np.exp(-BOWL.flakes_per_mm2 * np.pi * np.mean(radius_mm**2))

    _, lobe = nashiji_layers(BOWL, HERE)

    at = [np.interp(np.sqrt(np.cos(angle)), np.sqrt(COSINES), band) for band in lobe.mirror[:, ::8].T]
    ratio = np.array(at) / (covered * traced)
    assert low < ratio.min()
    assert ratio.max() < high
    # Rays leave n times as far apart as they would without lacquer: GGX's alpha is the slopes' root mean square.
    half = light + leaving
    half = half[np.isfinite(half[:, 2])] / half[np.isfinite(half[:, 2])][:, 2:]
    middle = half - np.median(half, axis=0)
    if incidence_deg < 10.0:
        wide = 1.4826 * np.sqrt(2.0) * np.median(np.abs(middle[:, 1]))
        assert lobe.roughness == pytest.approx(np.hypot(wide, n * BOWL.metal.roughness), rel=0.05)


def test_makie_on_a_page_has_as_much_metal_as_its_grains() -> None:
    from coupole.appearance.render.objects import pieces

    box = Makie.model_validate(BOX)
    page = coarse_grains(box.model_copy(update={"grain_mm": 0.8}), HERE)
    powder, bare = (_area(piece.corners_mm) for piece in pieces(box, HERE))

    areas = np.linalg.norm(np.cross(*(page.corners_mm[:, k] - page.corners_mm[:, 0] for k in (1, 2))), axis=1)
    assert (areas * page.share).sum() / areas.sum() == pytest.approx(powder / (powder + bare), abs=0.01)


def test_a_scene_of_both_becomes_a_page() -> None:
    scene = Scene.model_validate(
        {
            "schema_version": 1,
            "name": "urushi",
            "cameras": [
                {
                    "name": "main",
                    "position_mm": [0, -300, 200],
                    "target_mm": [0, 0, 20],
                    "optics": {"kind": "field", "degrees": 20},
                    "width_px": 64,
                    "height_px": 48,
                }
            ],
            "objects": [{**BOX, "grain_mm": 2.0}, BOWL.model_dump(mode="json")],
            "lights": [
                {"kind": "environment", "luminance_cd_m2": 10, "spectrum": {"kind": "illuminant", "name": "A"}}
            ],
        }
    )
    made = look_of_scene(scene, HERE)
    assert len(made.about["materials"]) == 2
    assert made.about["triangles"] > 100_000


def _area(corners_mm: np.ndarray) -> float:
    return float(
        np.linalg.norm(np.cross(*(corners_mm[:, k] - corners_mm[:, 0] for k in (1, 2))), axis=1).sum() / 2
    )
