"""Signals while Python still loads the command line's modules."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

ALWAYS_FIRST = """
import os, time
os.write(int(os.environ["LOADING"]), b"x")
time.sleep(60.0)
"""
"""A module that takes a minute to load, in place of one that the command line loads first."""


@contextmanager
def loading(folder: Path, *command: str) -> Iterator[subprocess.Popen[str]]:
    """A process that has begun to load the modules of the command line, and does not get on."""
    (folder / "typer.py").write_text(ALWAYS_FIRST)
    begun, told = os.pipe()
    environment = {**os.environ, "LOADING": str(told)}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(folder), environment.get("PYTHONPATH", ""))))
    with subprocess.Popen(
        [*command, "doctor"], env=environment, pass_fds=[told], stderr=subprocess.PIPE, text=True
    ) as process:
        os.close(told)
        assert os.read(begun, 1) == b"x"
        os.close(begun)
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_in_the_first_moment_ends_the_command_without_a_traceback(tmp_path: Path, name: str) -> None:
    with loading(tmp_path, sys.executable, "-m", "coupole") as process:
        process.send_signal(signal.Signals[name])
        _, err = process.communicate(timeout=60.0)
    assert process.returncode == -signal.Signals[name]  # a shell says 130, 143 or 129
    assert err == ""


def test_ctrl_c_that_is_ignored_from_outside_is_ignored_in_the_first_moment(tmp_path: Path) -> None:
    """As in the background of a script; `coupole` itself heeds it once it can make a cell safe."""
    with loading(tmp_path, "sh", "-c", 'trap "" INT; exec "$@"', "sh", sys.executable, "-m", "coupole") as process:
        process.send_signal(signal.SIGINT)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.3)
