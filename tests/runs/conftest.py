"""What modules of this folder share: a result with texels, which `tests/conftest.py` gives to one worker; a share
of the machine for processing beside a run."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator

import cells
import pytest
from beside_runs import hurry, is_beside
from relief_cells import Made, detailed_result


@pytest.fixture(scope="session")
def detailed(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return detailed_result(tmp_path_factory.mktemp("detailed"))


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
