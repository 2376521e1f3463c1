"""ALTA's text: samples with their bounds, and the reflectance between them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from places import SHARED_DATA
from scipy.spatial.transform import Rotation

from coupole.appearance.matter.alta_samples import interpolated_brdf, read_alta
from coupole.errors import InputError

RETRO = SHARED_DATA / "brdf/retro-gray-tape.dat"
HEAD = "#DIM 3 1\n#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI\n#PARAM_OUT INV_STERADIAN\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "a.alta"
    path.write_text(text)
    return path


def directions(count: int, least: float, seed: int) -> np.ndarray:
    ways = np.random.default_rng(seed).normal(size=(4 * count, 3))
    ways[:, 2] = np.abs(ways[:, 2])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    found: np.ndarray = ways[ways[:, 2] > least][:count]
    return found


def angles(light: np.ndarray, eye: np.ndarray) -> dict[str, np.ndarray]:
    """Inputs of ALTA's parametrisations, by rotations as their definitions have them."""
    theta_l, theta_v = np.arccos(light[:, 2]), np.arccos(eye[:, 2])
    phi_l, phi_v = (np.arctan2(way[:, 1], way[:, 0]) for way in (light, eye))
    half = light + eye
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    theta_h, phi_h = np.arccos(half[:, 2]), np.arctan2(half[:, 1], half[:, 0])
    difference = Rotation.from_euler("zy", np.stack([-phi_h, -theta_h], axis=1)).apply(eye)
    theta_d, phi_d = np.arccos(difference[:, 2]), np.arctan2(difference[:, 1], difference[:, 0])
    return {
        "ISOTROPIC_TL_TV_PROJ_DPHI": np.stack(
            [theta_l, theta_v * np.cos(phi_v - phi_l), theta_v * np.sin(phi_v - phi_l)], axis=1
        ),
        "ISOTROPIC_TV_TL_DPHI": np.stack([theta_v, theta_l, phi_l - phi_v], axis=1),
        "RUSIN_TH_TD_PD": np.stack([theta_h, theta_d, phi_d], axis=1),
        "RUSIN_TH_PH_TD_PD": np.stack([theta_h, phi_h, theta_d, phi_d], axis=1),
        "SPHERICAL_TL_PL_TV_PV": np.stack([theta_l, phi_l, theta_v, phi_v], axis=1),
        "CARTESIAN": np.concatenate([eye, light], axis=1),
    }


def test_directions_are_those_of_each_parametrisation(tmp_path: Path) -> None:
    light, eye = directions(50, 0.1, 1), directions(50, 0.1, 2)
    for name, inputs in angles(light, eye).items():
        rows = "\n".join(" ".join(f"{value:.15g}" for value in (*row, 0.5)) for row in inputs)
        head = f"#DIM {inputs.shape[1]} 1\n#PARAM_IN {name}\n"
        found = read_alta(written(tmp_path, head + rows)).directions()
        both = [one[:, 2] for one in found] + [np.sum(found[0] * found[1], axis=1)]
        wanted = [light[:, 2], eye[:, 2], np.sum(light * eye, axis=1)]  # a turn of both is free
        np.testing.assert_allclose(both, wanted, atol=1e-12, err_msg=name)
        side = [np.cross(a, b)[:, 2] for a, b in (found, (light, eye))]
        np.testing.assert_allclose(*side, atol=1e-12, err_msg=name)


def test_bounds_are_absolute_or_a_radius_and_those_of_the_outputs_that_have_them(tmp_path: Path) -> None:
    samples = read_alta(
        written(tmp_path, HEAD + "#VS 2\n# mine\n\n0.1 0.2 0 1.5 1.25 2\n0.1 0.3 0 2 0 3.4028235e+38")
    )
    np.testing.assert_array_equal(samples.values[:, 0], [1.5, 2.0])
    np.testing.assert_array_equal(samples.low[:, 0], [1.25, 0.0])
    np.testing.assert_array_equal(samples.high[:, 0], [2.0, np.inf])
    three = HEAD.replace("3 1", "3 2")
    samples = read_alta(written(tmp_path, three + "#VS 1\n0.1 0.2 0 1.5 4 0.25"))
    np.testing.assert_array_equal([samples.low[0], samples.high[0]], [[1.25, np.nan], [1.75, np.nan]])
    samples = read_alta(written(tmp_path, three + "#VS 0 2\n0.1 0.2 0 1.5 4 3 5\n#VS 1\n0.1 0.2 0 1 2 1 3"))
    np.testing.assert_array_equal([samples.low[0], samples.high[0]], [[np.nan, 3], [np.nan, 5]])
    assert len(samples.values) == 2


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("1 2 3 4", "expected ALTA's text with a line `#DIM inputs outputs`"),
        ("#DIM 3\n1 2 3 4", "a.alta:1:1: #DIM: expected two whole numbers, 1 to 9999; found '3'"),
        ("#DIM 3 1\n1 2 3 4", "expected a line `#PARAM_IN`"),
        (HEAD.replace("3 1", "2 1") + "1 2 3", "a.alta:2:1: PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI has 3 inputs"),
        (HEAD + "#VS 3\n1 2 3 4", "a.alta:4:1: #VS: expected 0, 1 or 2"),
        (HEAD + "#FORMAT binary\n", "a.alta:4:1: expected ALTA's text; found its binary format"),
        (HEAD + "0 0 0 1\n0 0  x 1", "a.alta:5:6: expected a number; found 'x'"),
        (HEAD + "0 0 0 nan", "a.alta:4:7: expected a number; found 'nan'"),
        (HEAD + "0 0 0", "a.alta:4:6: expected 4 numbers in the line, by DIM and VS; found 3"),
        (HEAD + "0 0 0 1 7", "a.alta:4:9: expected 4 numbers in the line, by DIM and VS; found 5"),
        (HEAD + "#VS 2\n0 0 0 1 3 2", "a.alta:5:1: expected a lower and an upper bound; found 3 and 2"),
        (HEAD, "expected samples after the head"),
    ],
)
def test_wrong_text_is_refused_with_its_place(text: str, why: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(why)):
        read_alta(written(tmp_path, text))


def test_between_samples_a_smooth_reflectance_is_found(tmp_path: Path) -> None:
    """Of 4,000 random pairs one, looked up at others, at their exchange and their mirror image."""

    def smooth(light: np.ndarray, eye: np.ndarray) -> np.ndarray:
        half = light + eye
        cosine = half[:, 2] / np.linalg.norm(half, axis=1)
        value: np.ndarray = 0.2 + np.exp(8.0 * (cosine - 1.0)) * (2.0 - np.sum(light * eye, axis=1))
        return value

    light, eye = directions(4000, 0.05, 3), directions(4000, 0.05, 4)
    rows = np.column_stack([angles(light, eye)["ISOTROPIC_TL_TV_PROJ_DPHI"], smooth(light, eye)])
    text = "\n".join(" ".join(f"{value:.12g}" for value in row) for row in rows)
    made = interpolated_brdf(read_alta(written(tmp_path, HEAD + text)))
    np.testing.assert_allclose(made(light, eye)[:, 0], smooth(light, eye), rtol=1e-6)
    light, eye = directions(500, 0.3, 5), directions(500, 0.3, 6)
    found = made(light, eye)[:, 0]
    off = np.abs(found / smooth(light, eye) - 1.0)
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.95) < 0.05
    turn = Rotation.from_euler("z", 1.0)
    mirror = np.array([1.0, -1.0, 1.0])
    for again in (made(eye, light), made(turn.apply(light), turn.apply(eye)), made(light * mirror, eye * mirror)):
        np.testing.assert_allclose(again[:, 0], found, rtol=1e-6)
    assert (made(light * [1, 1, -1], eye) == 0).all()


def test_what_cannot_be_interpolated_is_refused(tmp_path: Path) -> None:
    rows = "\n".join(f"0.5 {0.1 * n} 0 1" for n in range(12))
    with pytest.raises(InputError, match="their angles lie in one plane"):
        interpolated_brdf(read_alta(written(tmp_path, HEAD + rows)))
    with pytest.raises(InputError, match="expected 8 samples above the surface; found 1"):
        interpolated_brdf(read_alta(written(tmp_path, HEAD + "0.5 0 0 1\n0.5 2 0 1")))
    with pytest.raises(InputError, match="PARAM_OUT: expected INV_STERADIAN; found ENERGY"):
        interpolated_brdf(read_alta(written(tmp_path, HEAD.replace("INV_STERADIAN", "ENERGY") + rows)))
    with pytest.raises(InputError, match="PARAM_IN COS_TLV: expected one of"):
        read_alta(written(tmp_path, "#DIM 1 1\n#PARAM_IN COS_TLV\n0.5 1")).directions()


@pytest.mark.skipif(not RETRO.exists(), reason="the measured tape is not part of the project")
def test_a_measured_tape_sends_light_back_where_it_came_from() -> None:
    samples = read_alta(RETRO)
    assert samples.values.shape == (7405, 1)
    assert samples.given_out is None
    light, eye = samples.directions()
    assert sorted(set(np.round(np.degrees(np.arccos(light[:, 2])), 3))) == [15.0, 30.0, 60.0]
    best = np.argmax(samples.values[:, 0])
    assert np.degrees(np.arccos(np.sum(light[best] * eye[best]))) < 2.0
