"""The figures of a run's report, against what is known of pictures and solids without it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from archives import make_run
from places import REPO

from coupole.geometry import Transform
from coupole.plan.cell import read_cell
from coupole.plan.rig import Rig
from coupole.storage.run import Run
from coupole.viewing import report
from coupole.viewing.raw_preview import Coding
from coupole.viewing.run_coverage import coverage
from coupole.viewing.run_sample import SampledExposure, SampledView

CODING = Coding("GBRG", black_dn=64, white_dn=4095)
SIDE_MM = 40.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    return read_cell(REPO / "configs/rigs/sim.yaml").rig


def picture(level: float, saturated_pixels: int = 0) -> np.ndarray:
    """[40, 50] pixels at a share of full scale above black, some of them at full scale."""
    pixels = np.full(2000, round(64 + level * (4095 - 64)), np.uint16)
    pixels[:saturated_pixels] = 4095
    return pixels.reshape(40, 50)


def exposure(exposure_us: int, *pictures: np.ndarray) -> SampledExposure:
    found = SampledExposure(exposure_us, len(pictures))
    for number, pixels in enumerate(pictures):
        found.add(f"top/led{number:04d}/e0", pixels, CODING)
    return found


def test_the_worst_picture_of_an_exposure_is_named_with_its_share() -> None:
    found = exposure(8000, picture(0.5), picture(0.5, 20), picture(0.5, 4))
    assert found.sample.saturated_share == 0.01
    assert found.worst == "top/led0001/e0"
    assert {name: counts.sum() for name, counts in found.histograms.items()} == {"R": 1500, "G": 3000, "B": 1500}
    assert sum(int(counts[-1]) for counts in found.histograms.values()) == 24
    assert found.black_share == 64 / 4095


@pytest.mark.parametrize(
    ("exposures", "verdict"),
    [
        ([(8000, picture(0.5))], "well exposed"),
        ([(8000, picture(0.5, 4))], "over-exposed"),
        ([(8000, picture(0.03))], "under-exposed"),
        ([(2000, picture(0.03)), (8000, picture(0.5, 4))], "well exposed"),
        ([(2000, picture(0.5, 4)), (8000, picture(0.5, 400))], "over-exposed"),
        ([(2000, picture(0.01)), (8000, picture(0.03))], "under-exposed"),
        ([], ""),
    ],
)
def test_a_bracket_is_judged_by_both_its_ends(exposures: list[tuple[int, np.ndarray]], verdict: str) -> None:
    assert SampledView("top", exposures=[exposure(us, pixels) for us, pixels in exposures]).verdict() == verdict


def cube_mm() -> np.ndarray:
    """[12, 3, 3] triangles of a cube on the disk's centre, counter-clockwise seen from outside."""
    faces = []
    for axis in range(3):
        for side in (0, 1):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            corners = np.full((4, 3), float(side))
            corners[:, u], corners[:, v] = [0, 1, 1, 0], [0, 0, 1, 1]
            faces += [corners[[0, 1, 2]], corners[[0, 2, 3]]] if side else [corners[[0, 2, 1]], corners[[0, 3, 2]]]
    return SIDE_MM * (np.array(faces) - (0.5, 0.5, 0))


def camera(rig: Rig, elevation_deg: float) -> Transform:
    """`base_from_camera` of a camera 335 mm from the cube's middle, towards x, that looks at it."""
    elevation = np.deg2rad(elevation_deg)
    back = np.array([np.cos(elevation), 0.0, np.sin(elevation)])
    right = np.cross((0.0, 1.0, 0.0), back)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(right, back), -back], axis=1)
    pose[:3, 3] = (0, 0, SIDE_MM / 2) + 335 * back
    return np.asarray(rig.support.base_from_support.matrix() @ pose)


def test_of_a_cube_each_face_is_a_fifth_of_what_can_be_seen(rig: Rig) -> None:
    above, oblique = camera(rig, 90), camera(rig, 45)
    one = coverage(rig, cube_mm(), {"above": above})
    assert one.shares == pytest.approx((0.2,), abs=0.01)
    assert one.reachable == pytest.approx(5 / 6, abs=0.01)
    two = coverage(rig, cube_mm(), {"above": above, "oblique": oblique})
    assert two.shares == pytest.approx((0.4, 0.2), abs=0.01)
    assert [seen.in_field for seen in two.views] == [1.0, 1.0]


def test_a_report_of_a_run_without_mesh_says_that_coverage_is_not_known(tmp_path: Path) -> None:
    run: Run = make_run(tmp_path, shots=2).run
    page = report.write(run).read_text()
    assert "<dt>coverage</dt><dd>not known" in page
    assert "Coverage of the object" not in page
    assert page.count('src="data:image/jpeg') == 2 + 4, "a mean of each view at the top, and the pictures"
