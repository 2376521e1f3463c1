"""Blocks of work by a real scheduler and workers that are processes, held against the same blocks done here."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cluster_blocks
import numpy as np
import pytest
from dask_cluster import cluster
from triangle_cases import COUNT

from coupole.errors import InputError
from coupole.reflectance.block_work import Cluster, Here, workshop
from coupole.reflectance.run_result import RunResult

BLOCKS = [(first, first + 3) for first in range(0, COUNT, 3)]


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, list]]:
    with cluster(tmp_path_factory.mktemp("dask"), 2) as (address, workers):
        yield address, workers


def test_a_folder_that_workers_do_not_see_is_refused(two: tuple[str, list], tmp_path: Path) -> None:
    (tmp_path / "settings.json").write_text("{}")
    with workshop(two[0]) as shop:
        shop.refuse_blind(tmp_path, "settings.json")
        with pytest.raises(InputError, match=r"does not see .* as it is here"):
            shop.refuse_blind(Path("/proc/self"), "stat")  # each process sees its own


def test_what_a_block_raises_is_raised_here(two: tuple[str, list]) -> None:
    with workshop(two[0]) as shop, pytest.raises(InputError, match=r"^told by a worker$"):
        list(shop.map(cluster_blocks.refuse, [1]))


def test_a_worker_killed_in_the_middle_changes_nothing(two: tuple[str, list], tmp_path: Path) -> None:
    """To the bit: what it had done is kept or done again by the other."""
    address, workers = two
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    alone = list(Here().map(partial(cluster_blocks.materials, here), BLOCKS))
    with workshop(address) as shop:
        found = []
        for number, part in enumerate(shop.map(partial(cluster_blocks.materials, there), BLOCKS)):
            found.append(part)
            if number == 4:
                assert {path.name for path in there.iterdir()} == {str(worker.pid) for worker in workers}
                workers[0].send_signal(signal.SIGKILL)
                workers[0].wait()
    assert len(found) == len(BLOCKS)
    for mine, same in zip(found, alone, strict=True):
        np.testing.assert_array_equal(mine, same)


def test_a_scheduler_that_does_not_answer_is_told_with_the_remedy() -> None:
    with pytest.raises(InputError, match="`dask scheduler` starts one"), workshop("nonsense"):
        pass


def test_a_scheduler_without_workers_is_told_with_the_remedy(tmp_path: Path) -> None:
    with (
        cluster(tmp_path, 0) as (address, _),
        pytest.raises(InputError, match=r"`dask worker .* --nthreads 1` starts one"),
        workshop(address),
    ):
        pass


@pytest.mark.parametrize(("triangles", "most"), [(17_879, 1_118), (100, 256), (1_000_000, 4_096)])
def test_blocks_are_alike_and_enough_for_every_worker(triangles: int, most: int) -> None:
    """The demo has five blocks of 4,096 at most: the second of two workers would wait for the fifth."""
    shop = Cluster(SimpleNamespace(nthreads=lambda: {"one": 1, "other": 1}), "")
    assert shop.most_rows(triangles) == most
    result = RunResult(Path())
    result.__dict__.update(triangles=np.arange(triangles), views=())
    blocks = list(result.blocks(10**9, most))
    assert [place for block in blocks for place in range(block.start, block.stop)] == list(range(triangles))
    sizes = [block.stop - block.start for block in blocks]
    assert max(sizes) <= most
    assert sizes[0] - sizes[-1] < len(sizes)


def test_blocks_in_this_process_are_small_and_enough_for_every_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part of a thread has 256 triangles (`triangle_fit`). Arrays of a block are made anew for each block."""
    for cores in (1, 8):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cores=cores: set(range(cores)))
        most = Here().most_rows(1_000_000)
        assert 2 * 256 * cores <= most <= 2048 * cores
