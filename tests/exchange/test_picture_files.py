"""Pictures as files, on a disk that may be full."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pytest

from coupole.errors import StorageError
from coupole.exchange.picture_files import write_picture


@pytest.mark.parametrize("suffix", [".npy", ".exr", ".png"])
def test_a_picture_that_cannot_be_written_leaves_the_one_that_was_there(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    write_picture(path, np.zeros((8, 8, 3), np.float32))
    before = path.read_bytes()
    noise = np.random.default_rng(0).uniform(0, 1, (64, 64, 3)).astype(np.float32)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(StorageError, match=path.name):
            write_picture(path, noise)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
