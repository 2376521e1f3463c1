"""Things that the rig puts into the simulated scene beside the plan's object."""

from __future__ import annotations

from pathlib import Path

import cells
import numpy as np
import pytest
from cells import TOP, CellFolder

KINDS = [
    "spectralon_tile",
    "grey_card",
    "glare_target",
    "gilt_step_wedge",
    "paint_wedge",
    "makie_tile",
    "fabric",
    "chrome_ball",
]


def with_thing(tmp_path: Path, **thing: object) -> CellFolder:
    cell = CellFolder(tmp_path)
    cell.rig_data["sensor"] |= {"width_px": 1024, "height_px": 768, "pixel_pitch_um": 22.0}
    cell.world_settings["things"] = [thing]
    del cell.plan_data["object"]
    cell.write(views=[{**TOP, "distance_mm": 450, "target_mm": [0, 0, 4]}], lights={"kind": "ids", "ids": [900]})
    return cell


def test_a_charuco_board_of_the_world_is_found_by_opencv_in_an_acquired_frame(tmp_path: Path) -> None:
    import cv2

    cell = with_thing(tmp_path, kind="charuco_board", squares_x=8, squares_y=6, translation_mm=[10, 5, 0.5])
    assert cell.acquire().code == 0
    frame = cells.stored(cell.run_folder)["top/led0900/e0"].pixels
    green = np.clip(frame[::2, ::2].astype(float) / 12, 0, 255).astype(np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_250)
    board = cv2.aruco.CharucoBoard((8, 6), 16.0, 12.0, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(green)
    assert ids is not None
    assert len(corners) == len(ids) == 35


@pytest.mark.parametrize("kind", KINDS)
def test_every_sample_is_seen(tmp_path: Path, kind: str) -> None:
    cell = with_thing(tmp_path, kind=kind, translation_mm=[0, 0, 1])
    ended = cells.here(
        "simulate", cell.plan, "--frames", "1", "--width", "128", "--out", tmp_path / "out", "--json"
    )
    assert ended.code == 0, ended.err
    assert ended.document["frames"][0]["brightest"] > 0.01


def test_an_unknown_thing_is_refused_at_its_place(tmp_path: Path) -> None:
    cell = with_thing(tmp_path, kind="teapot")
    ended = cells.here("check", cell.plan)
    assert ended.code == 2
    assert "things" in ended.err
    assert "teapot" in ended.err
