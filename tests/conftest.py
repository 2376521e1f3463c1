"""Puts this folder on the path, so that tests in every room share `cells`; and the fixtures they begin with."""

from __future__ import annotations

from pathlib import Path

import pytest
from cells import CellFolder


@pytest.fixture
def cell(tmp_path: Path) -> CellFolder:
    """A small simulated cell, with a folder of its own."""
    return CellFolder(tmp_path)
