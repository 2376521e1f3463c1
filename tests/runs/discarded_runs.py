"""Runs whose frames are discarded when their samples are safe, and what must be true of them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import cells
import h5py
import numpy as np
import xxhash
from beside_runs import beside, cell_of_three_views, hurry
from cells import CellFolder

from coupole.storage import sample_proofs

KEPT_LEDS = (96, 384, 672, 960)  # every twelfth of the plan's LEDs, from the fifth on
DISCARDED = 45 - len(KEPT_LEDS)


def discarding_cell(folder: Path, relief: Path = cells.COARSE_RELIEF, **plan: object) -> CellFolder:
    return cell_of_three_views(folder, relief, discard="after_fit", **plan)


def frames(run: Path) -> Iterator[tuple[str, bool, bool]]:
    """Shot, whether its pixels are what was proven, and whether its slot is marked as discarded."""
    for line in cells.events(run, "frame"):
        with h5py.File(run / line["file"]) as file:
            pixels = file["entry/instrument/detector/data"][line["index"]]
            state = file["entry/instrument/detector/frames"][line["index"]]["state"]
        is_there = f"{xxhash.xxh3_64_intdigest(np.ascontiguousarray(pixels).data.cast('B')):016x}" == line["xxh3"]
        yield line["shot"], is_there, state == 3


def everything_is_there(run: Path) -> None:
    assert all(is_there and not is_marked for _, is_there, is_marked in frames(run))


def nothing_is_lost(run: Path, result: Path) -> int:
    """Every frame is there, or the journal says that it was discarded and its samples are what was read back.
    Returns the number of frames whose pixels are gone."""
    discarded: dict[str, tuple[str, str, str]] = {}
    for line in cells.events(run, "discard"):
        discarded |= {shot: (line["view"], line["digest"], xxh3) for shot, xxh3 in line["frames"]}
    proven = {line["shot"]: line["xxh3"] for line in cells.events(run, "frame")}
    gone = 0
    for shot, is_there, _ in frames(run):
        if not is_there:
            gone += 1
            view, digest, xxh3 = discarded[shot]
            assert xxh3 == proven[shot]
            assert sample_proofs.problem_of(result, view, digest) == ""
    assert cells.here("verify", run).code == 0
    return gone


def all_discarded(run: Path, result: Path, *, views: int = 3) -> None:
    """What is kept is what the check needs, and the space of all else is free."""
    assert nothing_is_lost(run, result) == views * DISCARDED
    for shot, is_there, is_marked in frames(run):
        label = shot.split("/")[1]
        is_kept = not label.startswith("led") or int(label[3:7]) in KEPT_LEDS
        assert (is_there, is_marked) == (is_kept, not is_kept), shot
    for path in (run / "views").glob("*.h5"):
        kept = (57 - DISCARDED) * 512 * 384 * 2
        assert kept <= path.stat().st_blocks * 512 < kept + 2**20


def resume(run: Path) -> None:
    """Resume a run to its result."""
    process = cells.start("acquire", "--resume", run, "--yes", "--json")
    worker = beside(process.pid)
    cells.wait_until(lambda: os.sched_getscheduler(worker) == os.SCHED_IDLE, "the lowest priority")
    hurry(worker)
    ended = cells.finish(process)
    assert ended.code == 0, ended.err
    assert ended.document["reflectance"]["is_whole"], ended.err
