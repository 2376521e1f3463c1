"""The generated dome and object: the committed files are what the tools write, with the shape promised."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from places import REPO

from coupole.geometry import inverse, transform

ROOT = REPO
DOME, RELIEF = ROOT / "configs/domes/coupole.csv", ROOT / "configs/objects/relief.ply"
BASE_FROM_SUPPORT = transform((200.0, 0.0, 1450.0), (0.0, 0.0, 180.0))


def tool(name: str) -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "tools" / name))


@pytest.fixture(scope="module")
def table() -> NDArray[np.float64]:
    return np.loadtxt(DOME, delimiter=",", comments="#", skiprows=3)


@pytest.fixture(scope="module")
def positions_mm(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions of the LEDs in the support frame."""
    support_from_base = inverse(BASE_FROM_SUPPORT)
    return np.asarray(table[:, 2:5] @ support_from_base[:3, :3].T + support_from_base[:3, 3])


@pytest.fixture(scope="module")
def relief() -> Any:
    return trimesh.load_mesh(RELIEF)


def test_the_committed_dome_is_what_the_tool_writes(tmp_path: Path) -> None:
    tool("make_dome.py")["main"](["--output", str(tmp_path / "dome.csv")])
    assert (tmp_path / "dome.csv").read_bytes() == DOME.read_bytes()


def test_the_committed_small_dome_is_what_the_tool_writes(tmp_path: Path) -> None:
    made = tmp_path / "dome.csv"
    tool("make_dome.py")["main"](["--output", str(made), "--boards", "64", "--rows", "1", "--columns", "1"])
    assert made.read_bytes() == (ROOT / "configs/domes/text-dome.csv").read_bytes()


def test_the_committed_relief_is_what_the_tool_writes(tmp_path: Path) -> None:
    tool("make_relief.py")["main"](["--output", str(tmp_path / "relief.ply")])
    assert (tmp_path / "relief.ply").read_bytes() == RELIEF.read_bytes()
    assert tool("make_relief.py")["relief_ply"](28, 21) == (ROOT / "tests/data/relief.ply").read_bytes()


def test_the_dome_has_1080_leds_on_boards_of_6(table: NDArray[np.float64]) -> None:
    assert table[:, 0].tolist() == list(range(1080))
    assert table[:, 1].tolist() == [led // 6 for led in range(1080)]


def test_each_led_is_1500_mm_from_the_centre_of_the_support(positions_mm: NDArray[np.float64]) -> None:
    assert np.linalg.norm(positions_mm, axis=1) == pytest.approx(1500.0, abs=5.0)


def test_each_led_is_above_the_disk_and_faces_its_centre(
    table: NDArray[np.float64], positions_mm: NDArray[np.float64]
) -> None:
    normals = table[:, 5:8] @ BASE_FROM_SUPPORT[:3, :3]
    to_centre = -positions_mm / np.linalg.norm(positions_mm, axis=1, keepdims=True)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-5)
    assert np.sum(normals * to_centre, axis=1).min() > 0.998
    assert positions_mm[:, 2].min() > 50.0


def test_no_two_leds_are_closer_than_40_mm(positions_mm: NDArray[np.float64]) -> None:
    distances_mm = np.linalg.norm(positions_mm[:, None] - positions_mm[None], axis=2)
    assert distances_mm[np.triu_indices(1080, k=1)].min() > 40.0


def test_fluxes_spread_by_2_percent_about_1800_lm(table: NDArray[np.float64]) -> None:
    assert table[:, 8].mean() == pytest.approx(1800.0, rel=0.005)
    assert table[:, 8].std() / 1800.0 == pytest.approx(0.02, rel=0.2)


def test_the_relief_is_one_closed_body(relief: Any) -> None:
    assert relief.is_watertight
    assert relief.is_winding_consistent
    assert relief.volume > 0
    assert relief.body_count == 1


def test_the_relief_is_160_by_120_by_60_mm_and_stands_on_z_0(relief: Any) -> None:
    assert relief.bounds == pytest.approx(np.array([[-80.0, -60.0, 0.0], [80.0, 60.0, 60.0]]), abs=0.05)


def test_the_relief_is_small_enough_for_quick_rendering(relief: Any) -> None:
    assert 15_000 < len(relief.faces) < 25_000
    assert RELIEF.stat().st_size < 1.5e6


def test_the_relief_shows_its_orientation() -> None:
    height_mm = tool("make_relief.py")["height_mm"]
    x, y = np.meshgrid(np.linspace(-59.0, 59.0, 60), np.linspace(-59.0, 59.0, 60))
    seen = height_mm(x, y)
    for other in (seen[::-1], seen[:, ::-1], seen.T, *(np.rot90(seen, turns) for turns in (1, 2, 3))):
        assert np.mean(np.abs(seen - other) > 5.0) > 0.2
