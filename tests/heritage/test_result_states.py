"""Results of reflectance as states: a repainted patch is found if the fit is sure enough, and only then."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from relight_cases import waves, write_result

from coupole.errors import InputError
from coupole.heritage.comparison.result_state import lab_of_kd
from coupole.heritage.comparison.state_comparison import Comparison, compare

KD, REDDER = np.array([0.16, 0.12, 0.09]), np.array([1.12, 1.0, 0.94])
UNKNOWN = slice(40, 60)
"""Triangles without a material."""


def silent(*_: object) -> None: ...


def patch(middles: np.ndarray) -> np.ndarray:
    return np.linalg.norm(middles[:, :2] - [12.0, -8.0], axis=1) < 7.0


def made(folder: Path, seed: int, *, painted: bool, u_kd: float) -> Path:
    """Waves of 60 mm with 1 % noise of kd, and what the fit states of it."""
    corners = waves(40)
    write_result(folder, corners)
    rng = np.random.default_rng(seed)
    with h5py.File(folder / "fits/ggx.h5", "r+") as file:
        rows = file["triangles"][()]
        kd = KD * np.where(painted & patch(corners.mean(axis=1)[rows])[:, None], REDDER, 1.0)
        kd = kd * (1 + 0.01 * rng.standard_normal(kd.shape))
        file["alpha"][UNKNOWN] = np.nan
        file["kd"][...], file["u_kd"][...] = kd, u_kd
    assert len(rows) > 0.7 * len(corners)
    return folder


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("states") / "before", 1, painted=False, u_kd=0.01)


def compared(before: Path, after: Path) -> Comparison:
    return compare(before, after, "mm", None, is_aligned=True, say=silent)


def test_a_repainted_patch_is_found_in_its_place_and_by_its_difference(before: Path, tmp_path: Path) -> None:
    import colour

    found = compared(before, made(tmp_path / "after", 2, painted=True, u_kd=0.01))
    assert found.recoloured_points is not None
    assert found.de00 is not None
    inside = patch(found.before.points_mm)
    assert found.recoloured_points[inside].mean() > 0.7
    assert (found.recoloured_points & ~inside).sum() < 0.1 * found.recoloured_points.sum() + 0.02 * inside.sum()
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    one, two = (
        colour.XYZ_to_Lab(colour.RGB_to_XYZ(np.pi * kd, "sRGB", apply_cctf_decoding=False), white)
        for kd in (KD, KD * REDDER)
    )
    assert np.median(found.de00[inside]) == pytest.approx(colour.delta_E(one, two, method="CIE 2000"), rel=0.2)
    assert found.moved_points.sum() == 0


def test_what_a_fit_is_not_sure_of_is_not_marked(before: Path, tmp_path: Path) -> None:
    """The same patch, where both results state that red, green and blue may be off by a fifth."""
    unsure = [made(tmp_path / str(k), k, painted=k == 2, u_kd=0.2) for k in (1, 2)]
    sure, found = compared(before, made(tmp_path / "sure", 2, painted=True, u_kd=0.01)), compared(*unsure)
    assert sure.recoloured_points is not None
    assert found.recoloured_points is not None
    assert sure.recoloured_points.sum() > 30
    assert found.recoloured_points.sum() == 0


def test_two_measurements_of_one_state_are_the_same(before: Path, tmp_path: Path) -> None:
    found = compared(before, made(tmp_path / "again", 3, painted=False, u_kd=0.01))
    assert found.recoloured_points is not None
    assert found.recoloured_points.sum() + found.moved_points.sum() <= 3


def test_covariances_of_lab_are_those_of_many_draws() -> None:
    import colour

    rng = np.random.default_rng(0)
    u_alone, u_common = np.array([[0.02, 0.01, 0.03]]), np.array([0.02])
    lab, covariance = lab_of_kd(KD[None], u_alone, u_common)
    draws = KD * (1 + u_alone * rng.standard_normal((40_000, 3)) + u_common * rng.standard_normal((40_000, 1)))
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    drawn = colour.XYZ_to_Lab(colour.RGB_to_XYZ(np.pi * draws, "sRGB", apply_cctf_decoding=False), white)
    assert lab[0] == pytest.approx(drawn.mean(axis=0), abs=0.05)
    assert covariance[0] == pytest.approx(np.cov(drawn.T), rel=0.05, abs=0.01)


def test_a_folder_that_is_no_result_is_refused(before: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"result\.json"):
        compared(before, tmp_path)
