"""Blocks of work by a real scheduler and workers that are processes, held against the same blocks done here."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cluster_blocks
import numpy as np
import pytest
from dask_cluster import cluster
from triangle_cases import COUNT

from coupole.errors import InputError
from coupole.reflectance.block_work import Here, workshop

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
