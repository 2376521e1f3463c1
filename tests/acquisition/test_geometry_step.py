"""The geometry of a rig is compared with the cell: by sights of a board, and by ruler."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cells import CellFolder, here
from commissioned_cells import ABOVE_THE_BALL_DEG, Onlooker, board_cell, opened_bench
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coupole.acquisition.commissioning import geometry_step
from coupole.acquisition.commissioning.bench import Bench, Findings, StepFailedError
from coupole.acquisition.commissioning.sights import Sight, deviations
from coupole.calibration.optics import Intrinsics
from coupole.plan.cell import read_cell
from coupole.plan.rig import Rig
from coupole.preflight.simulated_world import world_config
from sim.world.client import World


@pytest.fixture(scope="module")
def cell_and_bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[CellFolder, Bench]]:
    cell = board_cell(tmp_path_factory.mktemp("board"), speed=8.0)
    with opened_bench(cell) as bench:
        yield cell, replace(bench, board=cell.folder / "board.yaml")


@pytest.fixture
def bench(cell_and_bench: tuple[CellFolder, Bench]) -> Iterator[Bench]:
    """A cell with a board, and a person whose ruler measures the simulated cell. The arm is back at the end."""
    bench = cell_and_bench[1]
    endpoints: Any = bench.opened.world_endpoints
    person = Onlooker(lengths_mm=World(endpoints).ask("ruler"))
    yield replace(bench, findings=Findings(), person=person)
    if np.abs(bench.joints_deg() - ABOVE_THE_BALL_DEG).max() > 0.01:
        bench.opened.robot.move_to(np.array(ABOVE_THE_BALL_DEG))
        bench.opened.robot.wait_settled()


def with_rig(bench: Bench, **changes: Any) -> Bench:
    """The same cell, of which the rig says something else."""
    plain = bench.cell.rig.model_dump()
    for key, value in changes.items():
        plain[key] = {**plain[key], **value} if isinstance(value, dict) else value
    return replace(bench, cell=replace(bench.cell, rig=Rig.model_validate(plain)))


def missed(bench: Bench) -> list[str]:
    return [one.what for one in bench.findings.limits if not one.is_met]


HIGHER = {"base_from_support": {"translation_mm": [200, 0, 1400], "abc_deg": [0, 0, 180]}}
LOWER = {"base_from_support": {"translation_mm": [200, 0, 1500], "abc_deg": [0, 0, 180]}}
SHORTER = {"translation_mm": [0, 0, 60]}
"""Of the rig; the cell's is at 120 mm."""


def test_a_right_rig_passes_and_the_arm_is_back(bench: Bench) -> None:
    geometry_step.geometry(bench)
    assert missed(bench) == []
    assert bench.findings.has_passed
    assert np.abs(bench.joints_deg() - ABOVE_THE_BALL_DEG).max() < 0.01
    (said,) = [remark for remark in bench.findings.remarks if "sights" in remark]
    assert said.startswith("5 sights"), said
    found = {one.what: one.found for one in bench.findings.limits}
    assert found["height of the board"] < 1.5
    assert found["disagreement of the sights"] < 1.5


def test_a_rig_whose_support_is_too_high_is_refused_by_the_camera_and_the_cause_is_named(bench: Bench) -> None:
    wrong = with_rig(bench, support=HIGHER)
    geometry_step.geometry(wrong)
    assert missed(wrong) == ["height of the board"]
    assert "a support that is 50 mm lower than the rig says" in wrong.findings.remarks[-1]


def test_a_rig_whose_support_is_too_low_is_refused_by_the_ruler_and_the_arm_does_not_move(bench: Bench) -> None:
    wrong = with_rig(bench, support=LOWER)
    geometry_step.geometry(wrong)
    assert "room above the disk: rig minus ruler" in missed(wrong)
    assert not [one for one in wrong.person.heard if "Stand back" in one]  # type: ignore[attr-defined]


def test_a_rig_whose_camera_is_too_short_is_refused_and_the_cause_is_named(bench: Bench) -> None:
    wrong = with_rig(bench, flange_from_camera=SHORTER)
    geometry_step.geometry(wrong)
    assert missed(wrong) == ["tilt of the board", "disagreement of the sights"]
    assert re.search(r"projection centre is (59|60|61) mm farther from the flange", wrong.findings.remarks[-1])


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"tool": []}, "tool_reach_mm: beyond the bodies of `tool`"),
        ({"dome": {"radius": 1.0}}, "room inside the dome: rig minus ruler"),
        ({"support": {"diameter_mm": 1400}}, "diameter of the disk: ruler minus rig"),
    ],
)
def test_what_the_ruler_finds_outside_the_rigs_bodies_is_refused(
    bench: Bench, change: dict[str, Any], what: str
) -> None:
    if "dome" in change:
        leds = bench.cell.leds
        wrong = replace(bench, cell=replace(bench.cell, leds=replace(leds, positions_mm=leds.positions_mm * 1.2)))
    else:
        wrong = with_rig(bench, **change)
    geometry_step.geometry(wrong)
    assert what in missed(wrong)


def test_volumes_are_described_one_by_one_and_a_no_ends_the_step(bench: Bench) -> None:
    heard: list[str] = []

    class Doubter(Onlooker):
        def confirms(self, question: str) -> bool:
            heard.append(question)
            return "nothing else" not in question

    geometry_step.geometry(replace(bench, person=Doubter(lengths_mm=bench.person.lengths_mm)))  # type: ignore[attr-defined]
    assert "x from -740 to 740, y from -740 to 740, z from -50 to 20 mm" in heard[0]
    assert "these volumes: support" in heard[1]
    assert [one.yes for one in bench.findings.answers] == [True, False]
    assert not bench.findings.has_passed


def test_what_was_not_measured_is_no_measure(bench: Bench) -> None:
    with pytest.raises(StepFailedError, match="not measured: x of the board's middle"):
        geometry_step.geometry(replace(bench, person=Onlooker()))


def test_a_support_without_board_is_told(bench: Bench) -> None:
    with pytest.raises(StepFailedError, match=r"the board is not seen: .* corners seen"):
        geometry_step.geometry(replace(bench, board=None))


def test_the_command_refuses_a_cell_whose_support_is_higher_than_its_rig_says(tmp_path: Path) -> None:
    """End to end: the rig joins a world that is built otherwise."""
    cell = board_cell(tmp_path, speed=8.0)
    built = json.loads(cell.rig.read_text())
    read = read_cell(cell.rig)
    world = World.start(world_config(read, None, read.rig.sensor, speed=8.0))
    (tmp_path / "world.json").write_text(json.dumps(world.endpoints) + "\n")
    cell.rig_data["world"] = {"serves": "always", "join": str(tmp_path / "world.json")}
    command = ("--name", "A", "--yes", "--json", "--board", tmp_path / "board.yaml", "--only", "geometry")
    with closing(world):
        cell.rig_data["support"] |= LOWER
        cell.write()
        ended = here("commission", cell.rig, *command)
        assert ended.code == 3, ended.err
        assert "room above the disk: rig minus ruler" in ended.err
        assert ended.document["steps"] == {"geometry": False}
        cell.rig_data["support"] |= built["support"]
        cell.write()
        ended = here("commission", cell.rig, *command)
        assert ended.code == 0, ended.err
        assert ended.document["steps"] == {"geometry": True}


@given(st.integers(0, 2**32 - 1), st.floats(5, 80) | st.floats(-80, -5), st.sampled_from(["support", "camera"]))
@settings(max_examples=8, deadline=None)
def test_errors_of_support_and_camera_are_told_apart(seed: int, error_mm: float, wrong: str) -> None:
    """Sights of a board by a camera in true places, with noise, described by a rig that has one of two errors."""
    random = np.random.default_rng(seed)
    across, down = np.meshgrid(np.arange(7) * 10.0, np.arange(5) * 10.0)
    board_mm = np.stack([across.ravel(), down.ravel(), np.zeros(35)], axis=1)
    middle_mm, place_mm = board_mm.mean(axis=0), np.array([10.0, 20.0, 4.0])
    true_from_board = np.eye(4)
    true_from_board[:3, :3] = Rotation.from_euler("xz", [180.0, 30.0], degrees=True).as_matrix()
    true_from_board[:3, 3] = place_mm - true_from_board[:3, :3] @ middle_mm
    sights = []
    for tilt in [(0, 0), (12, 0), (-12, 0), (0, 12), (0, -12)]:
        camera = np.eye(4)
        camera[:3, :3] = Rotation.from_euler("xyz", [180 + tilt[0], tilt[1], 10], degrees=True).as_matrix()
        camera[:3, 3] = place_mm - 335.0 * camera[:3, 2] + random.normal(0, 5, 3)
        points = np.c_[board_mm, np.ones(35)] @ (np.linalg.inv(camera) @ true_from_board).T
        pixels = 900.0 * points[:, :2] / points[:, 2:3] + [255.5, 191.5] + random.normal(0, 0.1, (35, 2))
        said = camera.copy()
        said[:3, 3] += [0, 0, error_mm] if wrong == "support" else -error_mm * camera[:3, 2]
        sights.append(Sight(said, board_mm, pixels))
    start = sights[0].support_from_camera @ np.linalg.inv(camera) @ true_from_board
    found = deviations(sights, Intrinsics(900.0, 900.0, 255.5, 191.5), middle_mm, place_mm, start)
    said_mm = float(re.search(r"(\d+) mm", found.cause)[1])  # type: ignore[index]
    assert said_mm == pytest.approx(abs(error_mm), abs=2.0)
    if wrong == "support":
        assert found.height_mm == pytest.approx(error_mm, abs=1.0)
        assert found.disagreement_mm < 0.2
        assert f"mm {'higher' if error_mm > 0 else 'lower'} than the rig says" in found.cause
    else:
        assert f"{'farther from' if error_mm > 0 else 'nearer to'} the flange" in found.cause
