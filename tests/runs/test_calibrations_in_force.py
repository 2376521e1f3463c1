"""Plans that name calibrations: stamped into the run where they hold, refused with the reason where not."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import cells
import pytest
from cells import CellFolder

from coupole.calibration.record import Input, Limit, Parameter, Record, Validity, seal_record, write_record


def record(
    kind: str,
    *,
    focus_distance_mm: float = 335.0,
    days: float = 30.0,
    camera: str | None = None,
    temperature_c: tuple[float, float] | None = None,
) -> Record:
    now = datetime.now(UTC)
    return seal_record(
        kind=kind,
        name=f"{kind}-1",
        created=now - timedelta(days=60),
        software="coupole 0.1.0",
        simulated=True,
        validity=Validity(
            expires=now + timedelta(days=days),
            camera=camera,
            size_px=(128, 96),
            focal_length_mm=35.0,
            focus_distance_mm=focus_distance_mm,
            f_number=8.0,
            temperature_c=temperature_c,
        ),
        transforms={},
        parameters=(
            Parameter(name="fx_px", value=400.0, u=0.1, degrees_of_freedom=100.0, dominated_by="corners"),
        ),
        fixed={},
        covariance=((0.01,),),
        noise=(),
        images=(),
        limits=(Limit(what="noise of corners", found=0.1, limit=0.3, unit="px"),),
        remarks=(),
        inputs=(Input(name="run/run.json", sha256="0" * 64),),
    )


@pytest.fixture
def calibrated(cell: CellFolder) -> CellFolder:
    for kind in ("camera", "hand-eye"):
        write_record(cell.folder / f"{kind}.yaml", record(kind))
    cell.write(calibrations=["camera.yaml", "hand-eye.yaml"])
    return cell


def refused(cell: CellFolder) -> str:
    ended = cells.here("check", cell.plan, "--no-paths", "--json")
    assert ended.code == 3, ended
    return " ".join(ended.document["refusals"])


def test_records_in_force_are_stamped_into_the_run(calibrated: CellFolder) -> None:
    assert calibrated.acquire().code == 0
    stamped = cells.about(calibrated.run_folder)["calibrations"]
    assert set(stamped) == {"camera", "hand-eye"}
    text = (calibrated.folder / "camera.yaml").read_text()
    assert stamped["camera"] in text


def test_a_run_is_not_resumed_with_another_calibration(calibrated: CellFolder) -> None:
    assert calibrated.acquire().code == 0
    write_record(calibrated.folder / "camera.yaml", record("camera", days=31.0))
    ended = calibrated.acquire("--resume", calibrated.run_folder)
    assert ended.code == 2
    assert "camera.yaml" in ended.err


def test_a_record_of_another_focus_is_refused(calibrated: CellFolder) -> None:
    write_record(calibrated.folder / "camera.yaml", record("camera", focus_distance_mm=400.0))
    assert "is valid for a focus of 400 mm" in refused(calibrated)


def test_an_expired_record_is_refused(calibrated: CellFolder) -> None:
    write_record(calibrated.folder / "hand-eye.yaml", record("hand-eye", days=-1.0))
    assert "hand-eye.yaml: expired on" in refused(calibrated)


def test_a_kind_that_the_plan_does_not_name_is_missed(calibrated: CellFolder) -> None:
    calibrated.write(calibrations=["camera.yaml"])
    assert "no record of the kind `hand-eye` is named" in refused(calibrated)


def test_a_record_that_was_edited_by_hand_is_an_input_error(calibrated: CellFolder) -> None:
    path: Path = calibrated.folder / "camera.yaml"
    path.write_text(path.read_text().replace("400.0", "401.0"))
    ended = cells.here("check", calibrated.plan)
    assert ended.code == 2
    assert "camera.yaml" in ended.err


def test_a_record_of_another_camera_is_refused_once_the_camera_is_open(calibrated: CellFolder) -> None:
    write_record(calibrated.folder / "camera.yaml", record("camera", camera="Other 12"))
    ended = calibrated.acquire()
    assert ended.code == 3
    assert "camera.yaml: is valid for the camera Other 12; this one is" in ended.err
    assert not list((calibrated.folder / "storage").glob("2*"))


def test_a_cell_that_is_warmer_than_its_calibration_is_refused(calibrated: CellFolder) -> None:
    write_record(calibrated.folder / "camera.yaml", record("camera", temperature_c=(10.0, 15.0)))
    ended = calibrated.acquire()
    assert ended.code == 3
    assert "camera.yaml: is valid from 10 to 15 C; the cell's coolest LED board has" in ended.err


def test_the_temperature_of_the_room_stands_in_the_journal(calibrated: CellFolder) -> None:
    write_record(calibrated.folder / "camera.yaml", record("camera", temperature_c=(10.0, 40.0)))
    assert calibrated.acquire().code == 0
    start = cells.events(calibrated.run_folder, "start")[0]
    assert 10.0 < start["room_c"] < 40.0


def test_the_records_that_a_rig_names_are_in_force_for_plans_that_name_none(calibrated: CellFolder) -> None:
    calibrated.rig_data["calibrations"] = calibrated.plan_data.pop("calibrations")
    calibrated.write()
    assert calibrated.acquire().code == 0
    assert set(cells.about(calibrated.run_folder)["calibrations"]) == {"camera", "hand-eye"}
    write_record(calibrated.folder / "hand-eye.yaml", record("hand-eye", days=-1.0))
    assert "hand-eye.yaml: expired on" in refused(calibrated)
    calibrated.write(calibrations="none")
    assert cells.here("check", calibrated.plan, "--no-paths", "--json").code == 0


def test_a_record_that_a_rig_names_and_is_not_there_is_shown_by_its_line(calibrated: CellFolder) -> None:
    calibrated.plan_data.pop("calibrations")
    calibrated.rig_data["calibrations"] = ["camera.yaml", "gone.yaml"]
    calibrated.write()
    ended = cells.here("check", calibrated.plan)
    assert ended.code == 2
    assert "rig.yaml" in ended.err
    assert "gone.yaml" in ended.err
