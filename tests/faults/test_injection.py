"""Faults drawn at random, several in a run: no frame is mislabelled, and the run can be completed."""

from __future__ import annotations

from typing import Any

import cells
import numpy as np
import pytest
from cells import SIDE, TOP, CellFolder
from expected_pictures import mislabelled

EDGES = 130
"""Of two views' bursts, about."""
ENDING = ("mute_box", "cut_wire", "unplug_camera", "camera_control_loss", "emergency_stop", "late_rsi")


def drawn(random: np.random.Generator) -> list[dict[str, Any]]:
    """One to five faults that cost frames and, in half of the runs, one that ends the session."""
    faults: list[dict[str, Any]] = []
    for _ in range(random.integers(1, 6)):
        edge = int(random.integers(0, EDGES))
        faults.append(
            [
                {"kind": "drop_trigger", "edge": edge},
                {"kind": "lost_transfer", "frame": edge},
                {"kind": "double_trigger", "edge": edge, "delay_us": int(random.integers(200, 9_900))},
            ][random.integers(3)]
        )
    if random.random() < 0.5:
        faults.append({"kind": str(random.choice(ENDING)), "at_edge": int(random.integers(0, EDGES))})
    return faults


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(1, 60))])
def test_whatever_goes_wrong_labels_are_true_and_the_run_can_be_completed(cell: CellFolder, seed: int) -> None:
    cell.join()
    cell.write(views=[TOP, SIDE])
    faults = drawn(np.random.default_rng(seed))
    with cell.world(*faults) as world:
        ended = cell.acquire()
        cells.wait_until(lambda: cells.safe(world), "a safe cell")
    assert ended.code in (0, 4, 5), (faults, ended)
    run = cell.run_folder
    assert mislabelled(cell, run) == [], faults
    if ended.code != 0:
        assert cells.events(run, "stop")[-1]["outcome"] == "failed", faults
        cell.confirm()
        with cell.world():
            ended = cell.acquire("--resume", run)
        assert ended.code == 0, (faults, ended)
    cells.assert_each_shot_proven_once(run)
    assert mislabelled(cell, run) == [], faults
