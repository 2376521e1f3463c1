"""Measured materials, rendered: radiance of a plane under one light against what the files' readers say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from in_part import in_part
from lazily import lazily
from spectral_scenes import HERE
from test_coated_materials import ELEVATIONS_DEG, reflected, ways

from coupole.appearance.matter import brdf
from coupole.appearance.render.materials import MeasuredMaterial
from coupole.appearance.render.materials.measured_material import measured_brdf, measured_table, spectra_of_rgb
from coupole.appearance.spectra import light
from coupole.errors import InputError
from coupole.exchange.of_results.material_tables import Material
from coupole.exchange.of_results.merl import encode

tensor_io: Any = lazily("mitsuba.python.tensor_io")
KD, KS, ALPHA = np.array([0.12, 0.06, 0.03]), np.array([0.05, 0.05, 0.06]), 0.2


def analytic(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    lobe = brdf.ggx(wi, wo, roughness=ALPHA, fresnel=lambda c: np.ones((*np.shape(c), 1)))
    return brdf.lambert(wi, wo, reflectance=np.pi * KD) + KS * lobe


def merl(folder: Path) -> Path:
    path = folder / "red.binary"
    path.write_bytes(encode(Material("red", KD, KS, ALPHA)))
    return path


def alta(folder: Path) -> Path:
    """ALTA's text, of half vectors and of light about them, as densely as a gonioreflectometer of these angles."""
    half, apart, turn = (
        a.ravel()
        for a in np.meshgrid(
            1.3 * np.linspace(0.0, 1.0, 22) ** 2, np.linspace(0.0, 1.4, 15), np.linspace(0.0, 0.5 * np.pi, 7)
        )
    )
    about = np.stack([np.sin(apart) * np.cos(turn), np.sin(apart) * np.sin(turn), np.cos(apart)], axis=1)
    wi, wo = (
        np.stack(
            [
                np.cos(half) * side[:, 0] + np.sin(half) * side[:, 2],
                side[:, 1],
                np.cos(half) * side[:, 2] - np.sin(half) * side[:, 0],
            ],
            axis=1,
        )
        for side in (about * [-1.0, -1.0, 1.0], about)
    )
    above = (wi[:, 2] > 0.0) & (wo[:, 2] > 0.0)
    rows = np.column_stack([half, apart, turn, analytic(wi, wo)])[above]
    path = folder / "red.alta"
    head = "#DIM 3 3\n#PARAM_IN RUSIN_TH_TD_PD\n#PARAM_OUT INV_STERADIAN\n"
    path.write_text(head + "\n".join(" ".join(f"{v:.7g}" for v in row) for row in rows) + "\n")
    return path


def result(folder: Path) -> Path:
    (folder / "fits").mkdir()
    with h5py.File(folder / "fits" / "ggx.h5", "w") as file:
        file["triangles"] = np.arange(4)
        file["kd"], file["ks"] = np.stack([0.5 * KD, 1.5 * KD, KD, np.nan * KD]), np.tile(KS, (4, 1))
        file["alpha"] = np.full(4, ALPHA)
    return folder


def spectral(folder: Path) -> Path:
    """Of RGL's format with four wavelengths, by Mitsuba's own writer: any values."""
    random = np.random.default_rng(5)

    def plane(*shape: int) -> np.ndarray:
        found = random.uniform(0.6, 1.4, shape).astype(np.float32)
        return found + found[..., ::-1, :]

    values = plane(1, 6, 4, 8, 8)
    path = folder / "any.bsdf"
    tensor_io.write(
        str(path),
        theta_i=np.linspace(0.0, 1.55, 6, dtype=np.float32),
        phi_i=np.zeros(1, np.float32),
        ndf=plane(9, 12),
        sigma=np.repeat(plane(2, 5)[:1], 6, axis=0),
        vndf=plane(1, 6, 10, 14),
        luminance=values.mean(axis=2),
        wavelengths=np.array([400.0, 500.0, 600.0, 700.0], np.float32),
        spectra=values,
        description="made up",
        jacobian=np.array([1], np.uint8),
    )
    return path


@pytest.mark.parametrize("file", in_part([merl, alta, result, spectral], merl, result, spectral))
def test_a_measured_plane_is_seen_as_its_reader_says(file: Any, tmp_path: Path) -> None:
    path = file(tmp_path)
    # Paths begin at the camera: made-up values, which change when light and eye are exchanged, are seen so.
    to_light, to_eye = ways()
    direct = measured_brdf(MeasuredMaterial(kind="measured", path=path), HERE)(to_eye, to_light)
    nm = np.arange(380.0, 781.0, 40.0)
    to_bands = (
        np.stack([np.interp(nm, [400.0, 500.0, 600.0, 700.0], one) for one in np.eye(4)])
        if file is spectral
        else spectra_of_rgb()[:, ::8]
    )

    found = reflected({"kind": "measured", "path": str(path)})

    assert found == pytest.approx(direct @ to_bands, rel=0.01)
    if file is not spectral:
        assert len(direct) == len(ELEVATIONS_DEG)
        assert direct == pytest.approx(analytic(*ways()), rel=0.03)  # what the format itself keeps


def test_spectra_of_red_green_and_blue_have_their_colours_back() -> None:
    spectra = spectra_of_rgb()
    xyz = light.tristimulus(spectra, light.illuminant("D65"), light.observer("2 deg"))

    assert light.linear_srgb(xyz) == pytest.approx(np.eye(3), abs=0.01)
    assert spectra.sum(axis=0) == pytest.approx(1.0, abs=1e-4)
    assert spectra.min() >= -1e-9


def test_what_is_no_measured_material_is_refused(tmp_path: Path) -> None:
    (tmp_path / "short.binary").write_bytes(b"MERL")
    (tmp_path / "none").mkdir()
    (tmp_path / "of-pictures/fits").mkdir(parents=True)
    h5py.File(tmp_path / "of-pictures/fits/materials.h5", "w").close()
    for wanted, words in (
        ({"path": tmp_path / "short.binary"}, "expected a material of the MERL database"),
        ({"path": tmp_path / "short.binary", "cluster": 1}, "the folder of a result"),
        ({"path": tmp_path / "none"}, "ggx.h5: is not there"),
        ({"path": tmp_path / "of-pictures"}, "ggx.h5: is not there"),
        ({"path": result(tmp_path), "triangles": [3]}, "expected triangles with a material"),
        ({"path": tmp_path, "fit": "phong"}, "fit: expected one of ggx; found phong"),
    ):
        with pytest.raises(InputError, match=words):
            measured_table(MeasuredMaterial.model_validate({"kind": "measured", **wanted}), HERE)
