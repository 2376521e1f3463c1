"""The showpiece's plan, small: its frames are proven, and show the true surface of the scanned object."""

from __future__ import annotations

from pathlib import Path

import cells
import h5py
import numpy as np
from cells import CellFolder


def test_frames_of_the_scanned_plaque_show_its_true_surface(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.world_settings["true_surface"] = "plaque"
    above = {**cells.TOP, "target_mm": [0, 0, 10], "elevation_deg": 84}
    mesh = {"id": "plaque", "mesh": str(cells.REPO / "configs/objects/plaque.ply")}
    cell.write(views=[above], object=mesh, lights={"kind": "ids", "ids": [640, 900]})
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    assert ended.document["proven"] == 2
    (view,) = (cell.run_folder / "views").glob("*.h5")
    with h5py.File(view) as file:
        frames = file["entry/instrument/detector/data"][...].astype(float) - cells.BLACK_DN
    # GBRG: blue right of green in even rows, red below it. The scan alone is stone: redder than blue everywhere.
    brightest = frames[frames.mean(axis=(1, 2)).argmax()]
    blue, red = brightest[::2, 1::2], brightest[1::2, ::2]
    lit = blue > 40.0
    assert np.mean(blue[lit] > 1.5 * red[lit]) > 0.05
    assert np.mean(red[lit] > 1.2 * blue[lit]) > 0.1
