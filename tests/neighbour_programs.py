"""bluesky, ophyd-async, Tiled, napari and pyright, which `prepare_tests` of tools/bootstrap.sh installs."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
from places import REPO

NEIGHBOURS_FAILED = "bluesky, Tiled and napari could not be installed"
_REASON = NEIGHBOURS_FAILED if (REPO / ".tools/tried-neighbours").exists() else "tools/test installs napari first"
needs_neighbours = pytest.mark.skipif(
    not all(map(find_spec, ("basedpyright", "bluesky", "napari", "npe2", "ophyd_async", "tiled"))), reason=_REASON
)
