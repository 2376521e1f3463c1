"""What records say to the budget, and our accuracies beside the paper's."""

from __future__ import annotations

import hashlib
import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from cells import CellFolder
from domes import dome
from photographed import BOARD_YAML
from raw_runs import write_hand_eye
from sticker_scenes import scene
from test_led_record import found as leds_found

from coupole.calibration.budget.accuracy import Case, accuracies
from coupole.calibration.budget.budget import Known
from coupole.calibration.budget.records import doubts, known_from, ray_mm, read_records
from coupole.calibration.optics import project
from coupole.calibration.record import Input, Limit, Parameter, Validity, seal_record, step_names, write_record
from coupole.calibration.report import Outcome, write_outcome
from coupole.errors import InputError
from coupole.plan.base_model import Pose

NOW = datetime(2026, 5, 2, tzinfo=UTC)


def write(path: Path, kind: str, **content: Any) -> Path:
    """A record with little in it but what a test asks for."""
    basic = {
        "kind": kind,
        "name": f"{kind}-1",
        "created": NOW - timedelta(days=1),
        "software": "coupole",
        "simulated": True,
        "validity": Validity(expires=NOW + timedelta(days=1)),
        "transforms": {},
        "parameters": (Parameter(name="a", value=1.0, u=0.1, degrees_of_freedom=9.0, dominated_by="x"),),
        "fixed": {},
        "covariance": ((0.01,),),
        "noise": (),
        "images": (),
        "limits": (),
        "remarks": (),
        "inputs": (Input(name="run/run.json", sha256="0" * 64),),
    }
    write_record(path, seal_record(**basic | content))
    return path


def limit(what: str, found: float, most: float = 1.0) -> tuple[Limit]:
    return (Limit(what=what, found=found, limit=most, unit=""),)


def write_mesh(path: Path) -> Path:
    u = (0.01, 0.02, 0.02, 0.003, 0.004, 0.0)
    return write(
        path,
        "mesh",
        transforms={"base_from_mesh": Pose()},
        parameters=tuple(
            Parameter(name=name, value=None, u=value, degrees_of_freedom=50.0, dominated_by="stickers")
            for name, value in zip(step_names("base_from_mesh"), u, strict=True)
        ),
        covariance=tuple(map(tuple, np.diag(np.square(u)).tolist())),
        limits=limit("place of the worst sticker", 0.04),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Records of six kinds."""
    place = tmp_path_factory.mktemp("records")
    write_hand_eye(place / "hand-eye.yaml", scene(1, stickers=1, views=1).prior)
    write(place / "flat.yaml", "flat-field", limits=limit("uncertainty in the field's corners", 0.004))
    write(place / "drift.yaml", "drift", limits=limit("uncertainty of the factor", 0.0015))
    write(place / "dark.yaml", "dark")
    write_mesh(place / "mesh.yaml")
    result = leds_found(dome(1, views=24))
    write_outcome(place / "leds.yaml", Outcome(result.record, lambda figure: None, result.files))
    (place / "board.yaml").write_text(BOARD_YAML)
    return place


def test_each_record_takes_the_place_of_what_is_stated(folder: Path) -> None:
    known = known_from(read_records([folder]), Known())
    assert known.flat_field == 0.004
    assert known.drift == 0.0015
    assert known.mesh_mm == 0.04
    assert known.mesh_deg == pytest.approx(0.005)
    assert 0.01 < known.led_mm < 0.3
    assert known.camera_mm < 0.3
    assert known.lens_px == 0.0, "rays use the hand-eye record's lens, and their uncertainty has it"
    assert known.source("flat field") == "flat-field-1"
    assert known.source("LED normal") == "leds-test"
    assert known.source("vertices") == "Lucat et al. 2025"
    assert known.source("response") == "assumed"


def test_a_camera_alone_says_how_well_its_lens_is_known(tmp_path: Path) -> None:
    path = write(
        tmp_path / "camera.yaml",
        "camera",
        validity=Validity(expires=NOW + timedelta(days=1), focus_distance_mm=335.0),
        parameters=tuple(
            Parameter(name=name, value=7000.0, u=0.1, degrees_of_freedom=9.0, dominated_by="corners")
            for name in ("fx_px", "fy_px")
        ),
        covariance=((0.01, 0.0), (0.0, 0.01)),
        limits=limit("uncertainty at the field's corners", 0.12),
    )
    known = known_from(read_records([path]), Known())
    assert known.lens_px == 0.12
    assert known.pixel_mm == pytest.approx(335.0 / 7000.0)
    assert known.source("camera") == "Lucat et al. 2025"


def test_led_power_is_split_into_each_leds_own_and_what_all_share(tmp_path: Path) -> None:
    table = "# power\nid,power_G,u_own_G,u_G\n0,10.0,0.003,0.005\n1,11.0,0.003,0.005\n2,0,0.5,0.5\n3,nan,nan,nan\n"
    (tmp_path / "power.csv").write_text(table)
    digest = hashlib.sha256(table.encode()).hexdigest()
    path = write(tmp_path / "power.yaml", "led-power", files=(Input(name="power.csv", sha256=digest),))
    known = known_from(read_records([path]), Known())
    assert known.power_own == pytest.approx(0.003)
    assert known.power_common == pytest.approx(0.004), "0.005 is 0.003 and 0.004 together; dead LEDs do not count"


def test_of_a_folder_only_records_of_use_are_taken(folder: Path) -> None:
    assert {item.record.kind for item in read_records([folder])} == {
        "hand-eye", "flat-field", "drift", "mesh", "leds",
    }  # fmt: skip


def test_a_record_of_no_use_and_two_of_one_kind_are_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"dark.yaml: a record of the kind `dark` is not used by a budget"):
        read_records([folder / "dark.yaml"])
    with pytest.raises(InputError, match=r"a second record of the kind `drift`"):
        read_records([folder, folder / "drift.yaml"])
    with pytest.raises(InputError, match="expected records of the kinds camera, hand-eye"):
        read_records([tmp_path])


def test_what_speaks_against_a_record_is_said(tmp_path: Path) -> None:
    path = write(tmp_path / "drift.yaml", "drift", limits=limit("uncertainty of the factor", 0.02, 0.01))
    items = read_records([path])
    (missed,) = doubts(items, NOW)
    assert "not accepted: uncertainty of the factor is 0.02 , at most 0.01" in missed
    assert "expired on 2026-05-03" in doubts(items, NOW + timedelta(days=3))[1]


def test_a_rays_uncertainty_is_that_of_points_seen_through_random_records(tmp_path: Path) -> None:
    """Against Monte Carlo: lens and hand-eye drawn from their covariance."""
    prior = scene(1, stickers=1, views=1).prior
    (item,) = read_records([write_hand_eye(tmp_path / "he.yaml", prior)])
    random = np.random.default_rng(1)
    half, distance_mm = np.array([256.0, 192.0]), 335.0
    field = np.array([(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)]) * half
    points = distance_mm * np.column_stack([field / (prior.lens.fx, prior.lens.fy), np.ones(9)])
    seen = project(points, prior.lens.vector()).pixels
    square = []
    for step in random.multivariate_normal(np.zeros(14), prior.covariance, 3000):
        lens = prior.lens.vector()
        lens[:8] += step[:8]
        turn = prior.flange_from_camera[:3, :3]
        there = points - step[8:11] @ turn - np.cross(step[11:], points)
        square.append(np.sum((project(there, lens).pixels - seen) ** 2, axis=1).mean())
    expected_mm = np.sqrt(np.mean(square)) * distance_mm / prior.lens.fx
    assert ray_mm(item.record, distance_mm) == pytest.approx(expected_mm, rel=0.03)


def test_accuracies_come_from_records_and_say_where_there_is_none(folder: Path) -> None:
    lines = accuracies([Case("sound", read_records([folder])), Case("empty", ())])
    cells_of = {line.quantity: (line.cell(0), line.cell(1)) for line in lines}
    assert cells_of["mesh, worst sticker"] == ("0.04 mm", "no record")
    assert all(cell[1] == "no record" for cell in cells_of.values())
    (median,) = next(line for line in lines if line.quantity == "LED centre, median").our_figures[0] or (0.0,)
    (worst,) = next(line for line in lines if line.quantity == "LED centre, worst").our_figures[0] or (0.0,)
    record = next(item.record for item in read_records([folder]) if item.record.kind == "leds")
    assert median == pytest.approx(record.value("led_centre_median_u_mm"))
    assert worst >= median


def test_a_table_that_was_changed_beside_its_record_is_refused(folder: Path, tmp_path: Path) -> None:
    for name in ("leds.yaml", "leds-test.csv", "leds-test.h5"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "leds-test.h5").write_bytes(b"other")
    with pytest.raises(InputError, match=r"leds-test.h5 beside the record was changed"):
        read_records([tmp_path / "leds.yaml"])


def test_the_command_prints_sources_intervals_and_both_cells_beside_the_paper(
    folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "budget.png"
    ended = cells.here("budget", folder, "--beside", folder / "mesh.yaml", "--out", out)
    assert ended.code == 0, ended.err
    words = " ".join(ended.err.split())
    given = ("mesh-1", "drift-1", "Lucat et al. 2025")
    for text in (*given, "68%: [", "95%: [", "to digit 1 of u", "0.21 deg, at worst"):
        assert text in words
    assert "expired on 2026-05-03" in words
    document = json.loads(out.with_suffix(".json").read_text())
    assert [case["name"] for case in document["cases"]] == [folder.name, folder.name]
    page = out.with_suffix(".html").read_text()
    assert "All inputs" in page
    assert page.count("no record") >= 6
    assert out.stat().st_size > 10_000


def test_the_records_in_force_for_a_plan_are_taken(cell: CellFolder, folder: Path) -> None:
    for name in ("drift.yaml", "flat.yaml"):
        (cell.folder / name).write_bytes((folder / name).read_bytes())
    cell.write(calibrations=["drift.yaml", "flat.yaml"])
    other = write(cell.folder / "other.yaml", "drift", name="other-drift", limits=limit("uncertainty", 0.009))
    ended = cells.here("budget", other, "--plan", cell.plan, "--json")
    said_by = {source["source"]: source["said_by"] for source in ended.document["sources"]}
    assert said_by["flat field"] == "flat-field-1"
    assert said_by["drift"] == "other-drift", "a record that is given comes before that of the plan"
