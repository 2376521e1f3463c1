"""Tests with a GigE Vision camera on loopback: where they can run, and that they take turns."""

from __future__ import annotations

import fcntl
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.camera.aravis import library

needs_aravis = pytest.mark.skipif(
    library.load() is None, reason="libaravis-0.8 is not installed (see tools/bootstrap.sh)"
)


@contextmanager
def gige_port() -> Iterator[None]:
    """The GigE Vision port of 127.0.0.1 (3956, fixed), for one test of all processes at a time."""
    with (Path(tempfile.gettempdir()) / "coupole-gige-port.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
