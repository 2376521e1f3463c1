"""Which camera and hand-eye records LEDs and meshes may be found with."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from photographed import BOARD, SIZE_PX, write_run

from coupole.calibration.lens.bundle import RobotNoise
from coupole.calibration.lens.images import find_board
from coupole.calibration.lens.workflow import CameraArm, hand_eye_from
from coupole.calibration.posed_camera import read_posed_camera
from coupole.calibration.record import write_record
from coupole.calibration.request import Request
from coupole.calibration.sources import Sources, open_sources
from coupole.errors import InputError

NOW = datetime.now(UTC)


@cache
def sources_in(folder: Path) -> Sources:
    return open_sources([write_run(folder).folder], None)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Sources]:
    """A hand-eye record, and the images that it was made from."""
    folder = tmp_path_factory.mktemp("recorded")
    sources = sources_in(folder / "run")
    found = find_board(BOARD, sources)
    shown = hand_eye_from(found, sources, BOARD, "brown4", Request("he", NOW), arm=CameraArm(RobotNoise()))[2]
    write_record(folder / "he.yaml", shown.record)
    return folder / "he.yaml", sources


def test_lens_and_hand_eye_come_with_their_common_covariance(recorded: tuple[Path, Sources]) -> None:
    path, sources = recorded
    prior = read_posed_camera(path, None, sources.about, SIZE_PX)
    assert prior.covariance.shape == (len(prior.free) + 6, len(prior.free) + 6)
    assert (np.linalg.eigvalsh(prior.covariance) > 0).all()
    assert np.abs(prior.flange_from_camera[:3, 3] - [31.0, -42.0, 118.0]).max() < 2.0
    assert np.sqrt(np.diag(prior.hand_eye_covariance))[3:].max() < np.radians(0.5)


def test_a_record_of_another_focus_is_refused(recorded: tuple[Path, Sources]) -> None:
    path, sources = recorded
    about = replace(sources.about, focus_distance_mm=500.0)
    with pytest.raises(
        InputError, match="is valid for a focus of 335 mm, within 2 mm; the images were taken at 500 mm"
    ):
        read_posed_camera(path, None, about, SIZE_PX)


def test_a_record_of_other_frames_is_refused(recorded: tuple[Path, Sources]) -> None:
    path, sources = recorded
    with pytest.raises(InputError, match="is valid for frames of 480 x 360 pixels"):
        read_posed_camera(path, None, sources.about, (4096, 3072))


def test_a_hand_eye_record_in_a_cameras_place_is_refused(recorded: tuple[Path, Sources]) -> None:
    path, sources = recorded
    with pytest.raises(InputError, match="expected a record of the kind `camera`"):
        read_posed_camera(path, path, sources.about, SIZE_PX)


def test_a_record_that_had_expired_when_the_images_were_taken_is_refused(recorded: tuple[Path, Sources]) -> None:
    path, sources = recorded
    about = replace(sources.about, begun=NOW + timedelta(days=400))
    with pytest.raises(InputError, match=r"expired on .* UTC, before these images were taken"):
        read_posed_camera(path, None, about, SIZE_PX)
