"""Rendered layers and facets against closed forms: a plane under one light, from several sides."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from spectral_scenes import HERE, camera, constant, illuminant, plane, scene

from coupole.appearance.matter import kubelka_munk, typical
from coupole.appearance.matter.glossy_face import InternalReflectance, face
from coupole.appearance.matter.layer_stack import stack_brdf
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.render.absorption import per_mm
from coupole.appearance.render.materials import Layers, Material
from coupole.appearance.render.materials.coatings import stack_of
from coupole.appearance.render.rendering import open_renderer
from coupole.appearance.render.spectra import scaled_power
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.errors import InputError

GLAZE = {"absorption": 6.0, "scattering": 8.0, "direct_absorption": 3.0, "forward": 9.0, "backward": 2.0}
GILT = {"kind": "leaf", "roughness": 0.15}
RED = {"kind": "shape", "name": "red_shape"}
VARNISH = {"kind": "clear", "absorption": {"kind": "typical_varnish", "age": 1.0}, "thickness_mm": 0.05}
LIGHT_DEG = 30.0
"""Of the light to the normal, on the side of -x."""
ELEVATIONS_DEG = (82.0, 57.0, 40.0)
"""Of cameras on the side of +x: before, near and beyond the mirror direction at 60; there and upright made-up
tables are not defined."""


def reflected(material: dict[str, Any]) -> np.ndarray:
    """f of a plane for each camera, 1/sr, by the renderer: 380 to 780 nm by 40 nm."""
    tilt = np.radians(LIGHT_DEG)
    sun = {
        "kind": "distant",
        "direction": [np.sin(tilt), 0.0, -np.cos(tilt)],
        "illuminance_lux": 1000.0,
        "spectrum": illuminant("E"),
    }
    cameras = [camera(up, name=f"at{up:.0f}") for up in ELEVATIONS_DEG]
    one = scene([plane(material)], [sun], cameras=cameras, samples=4, bands={"step_nm": 40})
    irradiance = scaled_power(light.illuminant("E"), 1000.0)[::8] * np.cos(tilt)
    with open_renderer(one, HERE) as renderer:
        return np.stack([renderer.render(seen).radiance.mean(axis=(0, 1)) / irradiance for seen in one.cameras])


def ways() -> tuple[np.ndarray, np.ndarray]:
    """[cameras, 3] to the light and to the cameras."""
    tilt, up = np.radians(LIGHT_DEG), np.radians(ELEVATIONS_DEG)
    wo = np.stack([np.cos(up), 0.0 * up, np.sin(up)], axis=1)
    return np.broadcast_to([-np.sin(tilt), 0.0, np.cos(tilt)], wo.shape), wo


LAYERED = {
    "a glaze over a glossy ground": {
        "kind": "four_flux",
        "coefficients": {"kind": "values", **GLAZE},
        "thickness_mm": 0.05,
        "ground": constant(0.3),
        "ground_mirror": 0.4,
    },
    "a gilt under varnish": {"kind": "layers", "layers": [VARNISH, GILT], "ground": {"kind": "bole"}},
}


@pytest.mark.parametrize("name", LAYERED)
def test_layers_are_rendered_as_their_brdf_says(name: str) -> None:
    parsed = TypeAdapter(Material).validate_python(LAYERED[name])
    expected = stack_brdf(*ways(), stack=stack_of(parsed, HERE))[:, ::8]

    assert reflected(LAYERED[name]) == pytest.approx(expected, rel=0.01)


def test_paints_over_paint_are_kubelka_munk_and_saunderson() -> None:
    glaze = {"kind": "paint", "pigment": RED, "thickness_mm": 0.02, "scattering_per_mm": 8.0}
    white = {"kind": "paint", "pigment": constant(0.9), "thickness_mm": 0.05}
    two = {"kind": "layers", "layers": [glaze, white], "ground": constant(0.1), "roughness": 0.01}

    r = constant(0.9)["value"]
    below = kubelka_munk.over(*kubelka_munk.layer((1.0 - r) ** 2 / (2.0 * r) * 30.0, 30.0, 0.05), 0.1)
    k = kubelka_munk.k_over_s(typical.reflectance("red_shape").values) * 8.0
    inside = kubelka_munk.over(*kubelka_munk.layer(k, 8.0, 0.02), below)

    # By diffuse light seen along the normal: Saunderson; by exchange, the light along the normal that comes back.
    body = stack_of(Layers.model_validate(two), HERE).body[-1]
    assert body == pytest.approx(face(1.5).reflectance_in_air(InternalReflectance(inside)).values, rel=2e-3)


def test_varnish_over_a_mirroring_leaf_is_beers_law_on_the_way_in_and_out() -> None:
    material = {"kind": "layers", "layers": [VARNISH, GILT], "index": 1.5}
    mirror = stack_of(Layers.model_validate(material), HERE).mirror[-1]
    k = 15.0 * np.exp(-0.018 * (WAVELENGTHS_NM - 450.0))
    left = fresnel.reflectance(1.0, indices.gold() / 1.5) * np.exp(-2.0 * k * 0.05)

    # A leaf of 100 nm is nearly bulk gold; the face reflects 0.04.
    assert mirror == pytest.approx(0.96**2 * left / (1.0 - 0.04 * left), abs=0.015)


def test_absorbance_of_a_film_gives_its_transmittance_back(tmp_path: Path) -> None:
    (tmp_path / "aged.csv").write_text("nm,A\n380,0.9\n580,0.3\n780,0.0\n")
    clear = {"kind": "absorbance", "path": tmp_path / "aged.csv", "film_mm": 0.02, "age": 0.5}
    varnish = {"kind": "layers", "layers": [{"kind": "clear", "absorption": clear, "thickness_mm": 0.02}]}

    k = per_mm(Layers.model_validate(varnish).layers[0].absorption, 1.5, HERE)

    assert np.exp(-k * 0.02)[[0, 40]] == pytest.approx([10.0**-0.45, 10.0**-0.15], rel=1e-6)


def test_what_a_stack_cannot_be_is_refused(tmp_path: Path) -> None:
    bare = {"kind": "layers", "layers": [{"kind": "leaf", "uncovered": 0.2}]}
    with pytest.raises(ValidationError, match="take `kind: worn`"):
        Layers.model_validate(bare)
    rows = "".join(f"{nm},4,12\n" for nm in range(380, 781, 20))
    head = "# coupole: paint 1\n# name: ochre\n# unit: per mm\n# binder_index: 1.5\nwavelength_nm,K,S\n"
    (tmp_path / "ochre.paint.csv").write_text(head + rows)
    paint = {"kind": "paint_file", "path": tmp_path / "ochre.paint.csv"}
    glaze = {"kind": "layers", "layers": [{"kind": "four_flux", "coefficients": paint, "thickness_mm": 0.1}]}
    with pytest.raises(InputError, match="found no k, s_i, s_j"):
        stack_of(Layers.model_validate(glaze), HERE)


def test_gold_in_grooves_is_cook_and_torrances_equation() -> None:
    m = 0.25
    wi, wo = ways()
    h = (wi + wo) / np.linalg.norm(wi + wo, axis=1, keepdims=True)
    cosine = np.sum(wi * h, axis=1)
    # Cook and Torrance 1982, as Callet et al. 2010 have it, with 1/pi in D and 4 below.
    tangent2 = 1.0 / h[:, 2] ** 2 - 1.0
    d = np.exp(-tangent2 / m**2) / (np.pi * m**2 * h[:, 2] ** 4)
    g = np.minimum(1.0, 2.0 * h[:, 2] * np.minimum(wi[:, 2], wo[:, 2]) / cosine)
    mirror = fresnel.reflectance(cosine[:, None], indices.gold())[:, ::8]
    expected = mirror * (d * g / (4.0 * wi[:, 2] * wo[:, 2]))[:, None]

    found = {
        name: reflected({"kind": "metal", "roughness": m, "distribution": name})
        for name in ("ggx", "beckmann", "cook_torrance")
    }

    assert found["cook_torrance"] == pytest.approx(expected, rel=0.01)
    # So near the normal no groove is in another's shadow, and Smith's takes little.
    assert found["beckmann"] == pytest.approx(expected, rel=0.03)
    assert found["ggx"][0, 4] < 0.8 * expected[0, 4]
