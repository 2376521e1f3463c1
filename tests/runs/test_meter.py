"""`coupole meter`: what it proposes, taken as a run, is exposed as was wished; nothing is kept of the metering."""

from __future__ import annotations

import cells
import numpy as np
from cells import SIDE, TOP, CellFolder


def test_a_plan_metered_and_run_is_exposed_as_wished(cell: CellFolder) -> None:
    cell.write(views=[TOP, SIDE], exposure={"kind": "fixed", "exposure_us": 4000})
    metered = cell.folder / "metered.yaml"
    ended = cells.here("meter", cell.plan, "--write", metered, "--saturated", "0.002", "--snr", "20", "--json")
    assert ended.code == 0, ended.err
    advice = ended.document
    assert advice["remarks"] == []
    assert not (cell.folder / "storage").exists()
    assert cells.here("acquire", metered, "--yes", "--json").code == 0
    frames = cells.stored(cell.run_folder)
    shortest = [frame for shot, frame in frames.items() if shot.endswith("/e0") and cells.is_light(shot)]
    assert max(np.mean(frame.pixels >= 4095) for frame in shortest) <= 0.002
    noise = advice["noise"]
    last = f"/e{len(advice['exposure'].get('exposures_us', [0])) - 1}"
    for view in ("top", "side"):
        lit = [f.pixels for shot, f in frames.items() if shot.startswith(f"{view}/led") and shot.endswith(last)]
        best = np.max(lit, axis=0).astype(float) - cells.BLACK_DN
        best = best[best > 8 * noise["read_dn"]]
        snr = best / np.sqrt(noise["read_dn"] ** 2 + noise["gain_dn"] * best)
        assert np.mean(snr >= 0.9 * 20) >= 0.9  # asked for on a few lights, met on all within a tenth


def test_a_plan_that_preflight_refuses_is_not_metered(cell: CellFolder) -> None:
    cell.write(views=[{**TOP, "distance_mm": 60}])
    ended = cells.here("meter", cell.plan, "--json")
    assert ended.code == 3
    assert "view top" in ended.document["error"]
