"""Names of views that would make shot ids longer than the frame table's field are refused in the plan."""

from __future__ import annotations

import json
from pathlib import Path

import cells
import numpy as np
import pytest
from cells import CellFolder
from hypothesis import given
from hypothesis import strategies as st
from places import REPO

from coupole.plan.bursts import DeviceTimes
from coupole.plan.led_table import read_led_table
from coupole.plan.plan import Plan
from coupole.plan.schedule import build_schedule, names_too_long
from coupole.plan.shot_id import MAX_CHARACTERS, ShotId
from coupole.storage.frame_file import FRAME_DTYPE

DOME = read_led_table(REPO / "configs/domes/coupole.csv")
GRID = {
    "kind": "grid",
    "target_mm": [0, 0, 60],
    "distance_mm": 335,
    "azimuths_deg": [-120],
    "elevations_deg": [45],
}


def plan_of(name: str, **changes: object) -> Plan:
    asked = {
        "schema_version": 1,
        "name": "p",
        "rig": "rig.yaml",
        "views": [{**GRID, "name": name}],
        "lights": {"kind": "ids", "ids": [0, 1079]},
        "exposure": {"kind": "bracket", "exposures_us": [1000 + k for k in range(12)]},
        "repeats": 3,
    }
    return Plan.model_validate(asked | changes)


def test_the_frame_table_has_room_for_the_longest_id() -> None:
    assert FRAME_DTYPE["shot"].itemsize == MAX_CHARACTERS


def test_a_grid_whose_views_get_too_long_names_is_refused_at_its_name() -> None:
    ((key, message),) = names_too_long(plan_of("n" * 60), DOME)
    assert key == ("views", 0, "name")
    assert message.startswith("n" * 60 + "-az-120-el45: a view's name may have ")


@given(
    st.integers(1, 64), st.sampled_from([{"kind": "ids", "ids": [1079]}, {"kind": "panels"}]), st.integers(1, 1000)
)
def test_of_a_name_that_is_accepted_every_shot_id_fits(
    length: int, lights: dict[str, object], repeats: int
) -> None:
    plan = plan_of("n" * length, lights=lights, repeats=min(repeats, 4))
    if names_too_long(plan, DOME):
        return
    for burst in build_schedule(plan, DOME, np.eye(4), DeviceTimes(1000, 10_000.0, 100)).bursts[0]:
        for shot in burst.shots:
            assert shot is None or ShotId.parse(str(shot)) == shot


@pytest.fixture
def long_names(cell: CellFolder) -> CellFolder:
    cell.write(views=[{**GRID, "name": "n" * 60}])
    return cell


def test_check_and_acquire_end_with_two_and_name_file_line_and_column(long_names: CellFolder) -> None:
    for ended in (cells.here("check", long_names.plan), long_names.acquire()):
        assert ended.code == 2
        assert f"{long_names.plan}:" in ended.err
        assert "views[0].name: " in ended.err
    assert not list(Path(long_names.folder).rglob("journal.jsonl"))


def test_a_name_of_sixty_letters_is_proven_as_any_other(cell: CellFolder) -> None:
    view = json.loads(json.dumps(cells.TOP)) | {"name": "n" * 60}
    cell.write(views=[view])
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    cells.assert_each_shot_proven_once(cell.run_folder)
