"""A dose ledger that vanishes while a real cell gives light, and one that lacks the light of a run."""

import shutil
from pathlib import Path

import cells
import pytest
from real_cells import HOME, real_cell, true_dose_lux_h

from coupole.storage.ledger import Ledger


def test_a_ledger_that_vanishes_in_the_first_burst_ends_the_run_which_is_resumed_when_its_light_is_entered(
    tmp_path: Path,
) -> None:
    with real_cell(tmp_path) as (cell, world):
        relief = {"id": "relief", "mesh": str(cells.COARSE_RELIEF)}
        exposure = {"kind": "bracket", "exposures_us": [2000, 8000]}
        cell.write(views=[HOME], lights=cells.SOME_LIGHTS, exposure=exposure, object=relief)
        folder = Path(cell.rig_data["ledger"])
        process = cell.start_acquire()
        cells.wait_until(lambda: world.ask("light")["leds_s"], "the first light")
        shutil.rmtree(folder)
        ended = cells.finish(process)
        assert ended.code == 6, ended
        assert "while light was given" in ended.err
        assert cells.safe(world)
        run, true_lux_h = cell.run_folder, float(true_dose_lux_h(cell, world).max())
        entered_lux_h = Ledger(folder, "relief").read_history().total_lux_h
        assert entered_lux_h == pytest.approx(true_lux_h, rel=1e-3)
        assert ended.document["dose_lux_h"] == pytest.approx(entered_lux_h, abs=1e-5)
        assert cells.here("status", run, "--json").document["dose_lux_h"] == pytest.approx(entered_lux_h, abs=1e-5)

        shutil.rmtree(folder)  # what was entered afterwards too
        lit = world.ask("light")
        again = cell.acquire("--resume", run)
        assert again.code == 6
        assert "its dose ledger has only 0.000000 lux.h in all" in again.err
        assert world.ask("light") == lit

        by_hand = ("dose", "relief", "--rig", cell.rig, "--add", f"{entered_lux_h:.6f}", "--note", "it was lost")
        assert cells.here(*by_hand).code == 0
        assert cell.acquire("--resume", run).code == 0
        cells.assert_each_shot_proven_once(run)
