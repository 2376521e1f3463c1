"""A limit of the machine is told as such, and is not called a defect."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cells import CellFolder
from nursery import NURSERY

from coupole.commands.shortages import shortage_behind
from coupole.errors import DeviceError, DiskFull, ResourceShortage
from coupole.storage.disk_errors import disk_error


def _limited(limit: str, value: int, *arguments: str | Path) -> tuple[int, str, str]:
    process = NURSERY.function(
        "commands.limited_commands:run_limited",
        [limit, str(value), *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    out, err = process.communicate(timeout=120)
    return process.returncode, out, err


def test_too_few_open_files_are_told_with_the_limit(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    cell.write()
    code, out, err = _limited("RLIMIT_NOFILE", 20, "acquire", tmp_path / "plan.yaml", "--json", "--yes")
    assert code == 1, err
    assert "may not open more files at once (the limit is 20). Raise the limit (`ulimit -n 1024`)." in err
    assert "defect" not in err
    assert "Traceback" not in err
    document = json.loads(out)
    assert document["kind"] == "ResourceShortage"
    assert document["exit_code"] == 1


@pytest.mark.parametrize("command", ["check", "acquire"])
def test_a_limit_of_memory_at_which_libraries_crash_is_refused(tmp_path: Path, command: str) -> None:
    CellFolder(tmp_path)
    code, _, err = _limited("RLIMIT_AS", 1_500_000_000, command, tmp_path / "plan.yaml")
    assert code == 1, err
    assert "this process may have 1.50 GB of address space; a plan needs 2.5 GB" in " ".join(err.split())
    assert "(`ulimit -v unlimited`)" in " ".join(err.split())


def test_too_little_memory_is_told_though_another_error_hides_it() -> None:
    def frame_without_memory() -> None:
        try:
            np.empty(1 << 60, np.uint8)
        except MemoryError as error:
            raise DeviceError("camera", expected="a frame", happened="none", remedy="None.") from error

    with pytest.raises(DeviceError) as caught:
        frame_without_memory()
    shortage = shortage_behind(caught.value)
    assert isinstance(shortage, ResourceShortage)
    assert "this process was given no more memory (no limit is set)" in str(shortage)


_NO_MORE_THREADS = """
import resource, threading
from coupole.commands.shortages import shortage_behind
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
wait, threads = threading.Event(), []
try:
    while True:
        thread = threading.Thread(target=wait.wait)
        thread.start()
        threads.append(thread)
except RuntimeError as error:
    wait.set()
    print(shortage_behind(error))
"""


def test_too_few_threads_are_told() -> None:
    ended = subprocess.run([sys.executable, "-c", _NO_MORE_THREADS], capture_output=True, text=True, check=True)
    assert ended.stdout.startswith("this user may not start more processes or threads")


def test_a_full_disk_that_nobody_expected_is_told() -> None:
    full = OSError(errno.ENOSPC, "No space left on device", "/srv/out.png")
    shortage = shortage_behind(full)
    assert isinstance(shortage, DiskFull)
    assert str(shortage).startswith("/srv/out.png: the disk is full.")


def test_a_defect_stays_one() -> None:
    assert shortage_behind(ValueError("a defect")) is None
    assert shortage_behind(RuntimeError("another")) is None
    assert shortage_behind(BlockingIOError(errno.EAGAIN, "a socket is not ready")) is None
    assert shortage_behind(OSError(errno.EIO, "input/output error")) is None


def test_what_was_dealt_with_is_not_blamed() -> None:
    def read() -> None:
        try:
            raise OSError(errno.EMFILE, "Too many open files")
        except OSError:
            raise ValueError("a defect") from None

    with pytest.raises(ValueError, match="a defect") as caught:
        read()
    assert shortage_behind(caught.value) is None


def test_a_run_without_free_file_numbers_does_not_blame_the_disk() -> None:
    told = str(disk_error(Path("view.h5"), OSError(errno.EMFILE, "Too many open files")))
    assert "no more files may be open at once" in told
    assert "Check the disk" not in told
