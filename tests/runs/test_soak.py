"""Many runs in one world: nothing grows, nothing is lost."""

from __future__ import annotations

import resource
from pathlib import Path

import cells
import pytest
from cells import SIDE, TOP, CellFolder

RUNS, WARM = 60, 10


@pytest.mark.full
def test_sixty_runs_in_one_world_leave_no_memory_files_or_threads_behind(cell: CellFolder) -> None:
    import threading

    cell.join()
    cell.write(views=[TOP, SIDE])
    seen: list[tuple[int, int, int]] = []
    with cell.world() as world:
        for _ in range(RUNS):
            ended = cell.acquire()
            assert ended.code == 0, ended.err
            assert cells.safe(world)
            run = Path(ended.document["run"])
            cells.assert_each_shot_proven_once(run)
            resident_pages = int(Path("/proc/self/statm").read_text().split()[1])
            files = len(list(Path("/proc/self/fd").iterdir()))
            seen.append((resident_pages * resource.getpagesize(), files, threading.active_count()))
    memory, files, threads = zip(*seen[WARM:], strict=True)
    assert max(files) <= files[0] + 2
    assert max(threads) <= threads[0]
    assert memory[-1] - memory[0] < 100e6
