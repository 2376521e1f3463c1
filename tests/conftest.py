"""Puts this folder on the path, so that tests in every room share `cells`; and the fixtures they begin with."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy comes: the tests' own workers are enough

import pytest
from cells import CellFolder
from hypothesis import settings

settings.register_profile("coupole", deadline=None)  # no test asserts wall-clock speed
settings.load_profile("coupole")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--full", action="store_true", help="full scale: minutes to an hour instead of seconds")


@pytest.fixture(scope="session")
def scale(request: pytest.FixtureRequest) -> Callable[[int, int], int]:
    """`scale(small, full)`: how many of something to test, with `--full` or without."""
    full = bool(request.config.getoption("--full"))
    return lambda small, whole: whole if full else small


@pytest.fixture
def cell(tmp_path: Path) -> CellFolder:
    """A small simulated cell, with a folder of its own."""
    return CellFolder(tmp_path)
