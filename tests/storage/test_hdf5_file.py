"""HDF5 files on a disk that fills up: an error, and never a crash, which HDF5's own files end in."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cells
import h5py
import numpy as np
import pytest
from small_disks import small_disk_at

from coupole.storage.hdf5_file import hdf5_file

WRITES = """
import sys
from pathlib import Path
import numpy as np
from coupole.storage.hdf5_file import hdf5_file
try:
    with hdf5_file(Path(sys.argv[1]), "w") as file:
        for number in range(12):
            values = file.create_dataset(f"group{number}/values", data=np.arange(2000.0), chunks=(500,))
            values.attrs["unit"] = "mm"
except OSError as error:
    print(error.errno)
else:
    print("written")
"""


@pytest.fixture
def disk(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """A disk with so many kibibytes as are asked for."""
    with small_disk_at(tmp_path / "disk", kib=request.param) as disk:
        yield disk


@pytest.mark.parametrize("disk", [4, 8, 16, 40, 100, 160, 200], indirect=True)
def test_a_disk_that_is_full_at_any_moment_is_an_error_and_no_crash(disk: Path) -> None:
    command = [sys.executable, "-c", WRITES, str(disk / "file.h5")]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (0, f"{errno.ENOSPC}\n"), ended.stderr


def test_what_is_written_is_read_and_can_be_changed(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    with hdf5_file(path, "w", libver="latest") as file:
        file["values"] = np.arange(5)
    with hdf5_file(path, "r+") as file:
        file["values"][2] = 7
        file.attrs["unit"] = "mm"
    with h5py.File(path, "r") as file:
        assert file["values"][()].tolist() == [0, 1, 7, 3, 4]
        assert file.attrs["unit"] == "mm"
    assert h5py.is_hdf5(path)


def test_an_error_of_the_caller_is_raised_as_it_is(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a defect"), hdf5_file(tmp_path / "file.h5", "w"):
        raise ValueError("a defect")


@pytest.mark.parametrize("disk", [40], indirect=True)
def test_long_work_learns_of_the_error_before_its_end(disk: Path) -> None:
    blocks: list[int] = []

    def work() -> None:
        with hdf5_file(disk / "file.h5", "w") as file:
            for block in range(100):
                file.create_dataset(f"block{block}", data=np.arange(2000.0))
                file.sync()
                blocks.append(block)

    with pytest.raises(OSError, match="No space left"):
        work()
    assert 0 < len(blocks) < 10


def test_the_error_is_told_and_not_what_follows_from_it(tmp_path: Path) -> None:
    """HDF5 then reads what was never written."""

    def work() -> None:
        with hdf5_file(tmp_path / "file.h5", "w") as file:
            file._disk_file.error = OSError(errno.EIO, os.strerror(errno.EIO))
            raise KeyError("not what was written")

    with pytest.raises(OSError, match="Input/output error"):
        work()


def test_no_module_lets_hdf5_write_to_a_disk_by_itself() -> None:
    """Files in memory (`buffer`) cannot be full."""
    opened = re.compile(r"h5py\.File\((?!buffer)[^)]*\"(w|r\+|a)\"")
    writers = [path for path in (cells.REPO / "coupole").rglob("*.py") if opened.search(path.read_text())]
    assert writers == []
