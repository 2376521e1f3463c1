"""What modules of this folder share: the result of the glossy relief; one with texels, which `tests/conftest.py`
gives to one worker; a share of the machine for processing beside a run."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator

import cells
import pytest
from beside_runs import hurry, is_beside
from made_once import copy_of_cell, made_once
from relief_cells import Made, detailed_result, glossy_result


@pytest.fixture(scope="session")
def detailed(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return detailed_result(tmp_path_factory.mktemp("detailed"))


@pytest.fixture(scope="module")
def glossy(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """The run of the glossy relief and its result, made once for all workers; a copy, which may be changed."""
    cell, _, document = made_once(tmp_path_factory, "glossy", glossy_result)
    copy = copy_of_cell(cell, tmp_path_factory.mktemp("glossy"))
    return copy, copy.folder / "result", document


@pytest.fixture
def hurried() -> Iterator[None]:
    """Processing beside runs that this process acquires has a share of the machine: alone with the lowest priority
    it starves for minutes among other workers."""
    over = threading.Event()

    def look() -> None:
        hurried_pids: set[int] = set()
        while not over.wait(0.5):
            for pid in set(cells.children(os.getpid())) - hurried_pids:
                with contextlib.suppress(OSError):  # it has just ended
                    if is_beside(pid):
                        hurry(pid)
                        hurried_pids.add(pid)

    looking = threading.Thread(target=look, daemon=True)
    looking.start()
    yield
    over.set()
    looking.join()
