"""What the header says of a run's object is so at this moment."""

from __future__ import annotations

import json
from pathlib import Path

from cells import CellFolder

from coupole.console.cell import state_now
from coupole.plan.cell import read_cell
from coupole.storage.ledger import Ledger
from coupole.storage.run import Run
from coupole.storage.run_inputs import Inputs
from coupole.storage.run_json import RUN_JSON


def test_light_between_two_sessions_of_a_run_counts_and_a_failed_read_is_tried_again(tmp_path: Path) -> None:
    folder = CellFolder(tmp_path)
    cell = read_cell(folder.rig)
    about = {"simulated": True, "views": ["top"], "labels": ["led0000/e0"], "object": "vase"}
    run = Run.create(tmp_path / "runs", "r", Inputs(folder.plan, folder.rig, ()), about).folder
    whole = (run / RUN_JSON).read_text()
    (run / RUN_JSON).write_text(json.dumps({}))
    assert state_now._object_of(cell, str(run))["object"] == ""
    (run / RUN_JSON).write_text(whole)
    assert state_now._object_of(cell, str(run))["dose_before"] == 0.0
    Ledger(cell.ledger_folder, "vase").enter(2.5, "photographed")
    state_now._forget_runs()
    assert state_now._object_of(cell, str(run))["dose_before"] == 2.5
