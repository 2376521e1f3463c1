"""From photographs of stickers to the record of where a mesh lies."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sticker_scenes import Scene, scene, write_scan

from coupole.calibration.calibrated_arm import CarriedCamera
from coupole.calibration.record import read_record
from coupole.calibration.report import Outcome, write_outcome
from coupole.calibration.request import Request
from coupole.calibration.stickers.drawing import draw_mesh
from coupole.calibration.stickers.mesh_to_robot import Stated
from coupole.calibration.stickers.sources import find_all_stickers, read_scan
from coupole.calibration.stickers.workflow import MeshFound, mesh_from
from coupole.errors import InputError
from coupole.geometry import transform

REQUEST = Request("mesh-test", datetime(2026, 5, 1, tzinfo=UTC))
DEPTH_MM = (250.0, 600.0)
BASE_FROM_SUPPORT = transform((200.0, 0.0, 1450.0), (0.0, 0.0, 180.0))


def found(made: Scene, folder: Path) -> MeshFound:
    images = find_all_stickers(made.sources, made.prior.lens, diameter_mm=6.0, depth_mm=DEPTH_MM)
    scan = read_scan(write_scan(folder, made))
    return mesh_from(
        images,
        made.sources,
        scan,
        CarriedCamera(made.prior),
        REQUEST,
        stated_noise=Stated(robot_mm=0.03, robot_deg=0.003),
        base_from_support=BASE_FROM_SUPPORT,
    )


def test_the_mesh_is_found_to_sixty_micrometres_and_its_record_is_whole(tmp_path: Path) -> None:
    made = scene(1)
    result = found(made, tmp_path / "scan")
    path = tmp_path / "mesh-test.yaml"
    write_outcome(path, Outcome(result.record, partial(draw_mesh, result)))
    record = read_record(path)
    assert record.is_accepted
    assert len(result.pose.recognised_names) >= 12
    assert sum(image.corners + image.rejected for image in record.images) == sum(result.pose.views_of.values())
    rms_px = [image.rms_px for image in record.images]
    assert 0.0 < min(rms_px) < max(rms_px) < 1.0
    middle = made.targets_mm.mean(axis=0)
    off = (result.pose.base_from_mesh - made.base_from_mesh) @ np.append(middle, 1.0)
    assert np.linalg.norm(off) < 0.06
    on_support = record.transforms["support_from_object"]
    place = BASE_FROM_SUPPORT @ transform(on_support.translation_mm, on_support.abc_deg)
    assert np.allclose(place, result.pose.base_from_mesh, atol=1e-6)


def test_stickers_that_fell_off_are_named(tmp_path: Path) -> None:
    result = found(scene(2, missing=4), tmp_path / "scan")
    assert {"T10", "T11", "T12", "T13"} <= set(result.pose.missing)
    assert any("were not found: T10" in remark for remark in result.record.remarks)


@pytest.mark.full
@pytest.mark.timeout(1200)  # 100 scenes of 8 photographs with --full
def test_intervals_of_the_mesh_hold_from_photographs_on(scale: Callable[[int, int], int], tmp_path: Path) -> None:
    normalised = []
    scenes = scale(5, 100)
    for seed in range(scenes):
        made = scene(100 + seed)
        pose = found(made, tmp_path / f"scan{seed}").pose
        turn = Rotation.from_matrix(pose.base_from_mesh[:3, :3].T @ made.base_from_mesh[:3, :3])
        shift = made.base_from_mesh[:3, 3] - pose.base_from_mesh[:3, 3]
        step = np.concatenate([shift, turn.as_rotvec(degrees=True)])
        normalised.append(np.linalg.solve(np.linalg.cholesky(pose.covariance), step))
    z = np.concatenate(normalised)
    slack = 0.0 if scenes >= 100 else 0.3
    assert 0.90 - slack / 2 <= np.mean(np.abs(z) < 1.98) <= 0.99 + slack
    assert 0.8 - slack < np.sqrt(np.mean(z**2)) < 1.25 + slack


def test_a_folder_that_is_no_scan_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="as `coupole scan MESH --targets TABLE` writes it"):
        read_scan(tmp_path)


def test_images_without_stickers_are_refused(tmp_path: Path) -> None:
    made = scene(3, stickers=14, missing=14)
    with pytest.raises(InputError, match="are in none of 8 images"):
        find_all_stickers(made.sources, made.prior.lens, diameter_mm=6.0, depth_mm=DEPTH_MM)
