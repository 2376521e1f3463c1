"""The rehearsal: a whole plan on the rig's twin, faster than life, with nothing written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import LOW, SIDE, TOP, CellFolder, Ended

WHITE_RESPONSE = {"dn_per_lux_s": 2270.0, "f_number": 8.0}
"""White reaches about 60 % of full scale in 8 ms under the median LED of the dome (133 lux)."""


@pytest.fixture(scope="module")
def rehearsed(
    tmp_path_factory: pytest.TempPathFactory, scale: Callable[[int, int], int]
) -> tuple[CellFolder, Ended]:
    """Three views under every fourth LED (at full scale under all 1080) of a rig whose real devices are not
    there."""
    cell = CellFolder(tmp_path_factory.mktemp("dry"))
    cell.rig_data["ledbox"] = {"driver": "drivers.ledbox:LedBox", "settings": {"port": "/dev/ttyNOPE"}}
    cell.rig_data["camera"]["settings"] = {"address": "/nowhere"}
    cell.rig_data["robot"] = {
        "driver": "drivers.kuka.rsi:KukaRsi",
        "settings": {"listen": "192.0.2.1:49152", "controller": "192.0.2.2"},
    }
    cell.rig_data["world"] = {"serves": "dry_run"}
    cell.rig_data["white_response"] = WHITE_RESPONSE
    cell.write(views=[TOP, SIDE, LOW], lights={"kind": "every", "every": scale(4, 1)})
    return cell, cell.acquire("--dry-run", "--speed", "10")


def test_a_dry_run_needs_no_real_device(rehearsed: tuple[CellFolder, Ended]) -> None:
    assert rehearsed[1].code == 0, rehearsed[1].err


def test_a_dry_run_takes_and_proves_every_shot(
    rehearsed: tuple[CellFolder, Ended], scale: Callable[[int, int], int]
) -> None:
    found, shots = rehearsed[1].document, 3 * scale(270, 1080)
    assert (found["shots"], found["proven"], found["missing"], found["reshot"]) == (shots, shots, 0, 0)


def test_a_dry_run_is_never_faster_than_preflight_says(rehearsed: tuple[CellFolder, Ended]) -> None:
    found = rehearsed[1].document
    assert found["duration_s"] >= 0.95 * found["preflight_s"]


@pytest.mark.full  # ten times as fast as life, each delay of a busy machine is ten times as long
def test_a_dry_run_takes_the_time_that_preflight_says(rehearsed: tuple[CellFolder, Ended]) -> None:
    found = rehearsed[1].document
    assert found["duration_s"] == pytest.approx(found["preflight_s"], rel=0.1)


def test_a_dry_run_says_how_fast_it_was(rehearsed: tuple[CellFolder, Ended]) -> None:
    found = rehearsed[1].document
    assert found["speed_asked"] == 10
    assert found["speed"] == pytest.approx(found["duration_s"] / found["machine_s"], rel=0.01)


def test_a_dry_run_judges_the_exposure_of_every_view_on_a_sample(rehearsed: tuple[CellFolder, Ended]) -> None:
    exposure: dict[str, Any] = rehearsed[1].document["exposure"]
    assert set(exposure) == {"top", "side", "low"}
    assert all(40 <= seen["pictures"] <= 60 and seen["verdict"] == "well exposed" for seen in exposure.values())


def test_a_dry_run_writes_nothing(rehearsed: tuple[CellFolder, Ended]) -> None:
    left = {path.name for path in rehearsed[0].folder.iterdir()}
    assert left == {"rig.yaml", "plan.yaml"}


def test_a_dry_run_leaves_the_ledger_alone(cell: CellFolder) -> None:
    ledger = cell.folder / "ledger/relief.jsonl"
    ledger.parent.mkdir(parents=True)
    before = '{"event": "dose", "run": "earlier", "dose_lux_h": 1.0, "t": "2026-01-01T00:00:00Z"}\n'
    ledger.write_text(before)
    assert cell.acquire("--dry-run").code == 0
    assert ledger.read_text() == before
    assert [path.name for path in ledger.parent.iterdir()] == [ledger.name]
    assert not (cell.folder / "storage").exists()


@pytest.mark.parametrize(
    ("exposure_us", "verdict"),
    [(200, "under-exposed"), (8000, "well exposed"), (80_000, "over-exposed")],
    ids=["too-short", "right", "too-long"],
)
def test_a_dry_run_judges_an_exposure_by_the_rigs_own_light(
    cell: CellFolder, exposure_us: int, verdict: str
) -> None:
    cell.rig_data["white_response"] = WHITE_RESPONSE
    cell.write(exposure={"kind": "fixed", "exposure_us": exposure_us}, lights={"kind": "every", "every": 60})
    ended = cell.acquire("--dry-run")
    assert ended.code == 0, ended.err
    assert ended.document["exposure"]["top"]["verdict"] == verdict


def test_a_dry_run_does_not_judge_what_it_does_not_know(cell: CellFolder) -> None:
    """The world scales its light to the plan: without a figure of the rig's own, its brightness says nothing."""
    cell.write(lights={"kind": "every", "every": 120})
    ended = cell.acquire("--dry-run")
    assert ended.code == 0, ended.err
    seen = ended.document["exposure"]["top"]
    assert (seen["verdict"], seen["brightest"], seen["saturated"]) == ("not known", None, None)
    assert ended.document["exposure_scale"] is None


def test_a_dry_run_of_a_refused_plan_ends_with_three(cell: CellFolder) -> None:
    cell.write(views=[{**TOP, "target_mm": [0, 0, 900]}])
    assert cell.acquire("--dry-run").code == 3


@pytest.mark.parametrize("option", ["--resume", "--output"])
def test_a_dry_run_does_not_go_with_options_that_keep_something(cell: CellFolder, option: str) -> None:
    assert cell.acquire("--dry-run", option, str(Path("/nowhere"))).code == 2


def test_the_real_cells_rig_is_rehearsed_without_its_devices(cell: CellFolder) -> None:
    rig = cells.REPO / "configs/rigs/la-coupole.yaml"
    ended = cells.here("acquire", cell.plan, "--rig", rig, "--dry-run", "--speed", "20", "--json")
    assert ended.code == 0, ended.err
    assert ended.document["missing"] == 0


def test_a_box_that_waits_for_the_cameras_ready_line_loses_nothing(cell: CellFolder) -> None:
    cell.rig_data["ledbox"]["settings"]["wait_for_ready"] = True
    cell.write()
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    assert ended.document["reshot"] == 0
    cells.assert_each_shot_proven_once(cell.run_folder)
