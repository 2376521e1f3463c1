"""Many runs in one world, and rehearsals with random faults: nothing grows, nothing is lost or mislabelled."""

from __future__ import annotations

import os
import resource
from collections.abc import Mapping
from pathlib import Path

import cells
import pytest
from cells import SIDE, TOP, CellFolder
from soaking import WARM_UP_SHOTS, CheckedRecorder, figures_of, growths, soak

from coupole.plan.shot_id import ShotId

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


@pytest.mark.full
def test_thousands_of_rehearsed_shots_with_faults_are_labelled_truly_and_none_is_lost(tmp_path: Path) -> None:
    with soak(tmp_path, seed=3, faults_per_shot=2e-3, speed=30.0) as soaking:
        found = soaking.rehearse(0)
    assert found.faults.total() >= 3
    assert (found.proven, found.told_missing) == (found.frames, [])
    assert (found.mislabelled, found.twice, found.lost) == ([], [], [])
    assert found.shots == 3240


class _Liar(CheckedRecorder):
    """Takes LED 90 of each view for LED 45 and the other way round, counts LED 180 twice and LED 225 never."""

    def prove(self, slot: int, shot: ShotId, fields: Mapping[str, int]) -> None:
        words = str(shot)
        if "led0225" in words:
            self._proven.add(shot)
            return
        for mine, other in (("led0045", "led0090"), ("led0090", "led0045")):
            if mine in words:
                return super().prove(slot, ShotId.parse(words.replace(mine, other)), fields)
        super().prove(slot, shot, fields)
        if "led0180" in words:
            super().prove(slot, shot, fields)


def test_a_recorder_that_errs_is_found_out(tmp_path: Path) -> None:
    with soak(tmp_path, seed=0, faults_per_shot=0.0, speed=5.0, leds=24) as soaking:
        found = soaking.rehearse(0, _Liar)
    swapped = [f"{view}/led{led}/e0" for view in ("low", "side", "top") for led in ("0045", "0090")]
    assert sorted(line.split(":")[0] for line in found.mislabelled) == swapped
    assert sorted(found.twice) == [f"{view}/led0180/e0" for view in ("low", "side", "top")]
    assert {shot.split(",")[0] for shot in found.lost} == {f"{view}/led0225/e0" for view in ("low", "side", "top")}


def test_growth_is_counted_from_the_end_of_the_warm_up() -> None:
    def after(thousands: int) -> dict[str, int]:
        return {"pid": 7, "bytes": 100 + thousands, "files": 5, "threads": 3}

    (growth,) = growths([after(n) for n in range(30)], 1000)
    assert (growth.bytes, growth.files, growth.rehearsals) == (29 - WARM_UP_SHOTS // 1000, 0, 20)
    assert growths([after(n) for n in range(5)], 1000) == []


def test_an_open_file_and_a_thread_are_seen() -> None:
    before = figures_of(os.getpid())
    with Path("/dev/null").open():
        assert figures_of(os.getpid())["files"] == before["files"] + 1
