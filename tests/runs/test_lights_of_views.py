"""Views with lights of their own."""

from __future__ import annotations

import cells
from cells import SIDE, TOP, CellFolder
from expected_pictures import mislabelled


def test_a_run_whose_views_have_lights_of_their_own_is_whole_and_labelled_right(cell: CellFolder) -> None:
    few = {**TOP, "lights": {"kind": "ids", "ids": [5, 400, 730]}}
    cell.write(views=[few, SIDE], lights={"kind": "every", "every": 40})
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    assert ended.document["shots"] == 3 + 27
    cells.assert_each_shot_proven_once(cell.run_folder)
    assert mislabelled(cell, cell.run_folder) == []
